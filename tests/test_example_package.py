"""The example package of docs/examples through every command, at the smallest sizes."""

import json
import os
import shutil
from pathlib import Path

import pytest
from command_line import MAIN, run, run_apart
from own_package import EXAMPLE, PACKAGE, TINY
from processes import finished

from memmlp.runs.lookup import list_runs

QUICK = [*TINY, "optim.steps=6"]
OWN = [f"plugins=[{PACKAGE}]", "experiment=feet"]


@pytest.mark.long
def test_commands_take_custom_components(on_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert "FootSkate" in run(tmp_path, "train", *OWN, *QUICK)
    (made,) = list_runs(tmp_path / "outputs")
    assert made.results["latency"]["graph"] == "naive"
    assert made.manifest["plugins"][PACKAGE]["version"] == "0.1.0"
    assert f"{PACKAGE}:memory.py" in made.manifest["sources"]
    assert "skate" in made.metrics_path.read_text()
    assert "measured before" in run(tmp_path, "eval", made.id, "--plugins", PACKAGE)

    # one variant of the sweep is the run above
    sweep = [shutil.copy(EXAMPLE / "feet.yaml", tmp_path), *QUICK, "export.graph=off"]
    assert "2 of 2 runs done" in run(tmp_path, "sweep", *sweep, "executor=debug")
    assert len(list_runs(tmp_path / "outputs")) == 2
    assert "FootSkate" in json.dumps(json.loads(run(tmp_path, "table", *sweep, "--format", "json")))
    run(tmp_path, "report", "--out", "page.html")
    assert "FootSkate" in (tmp_path / "page.html").read_text()

    # workers import the package, too
    space = "+search.space.term.weight={low: 0.01, high: 1.0, log: true}"
    search = ["search.objectives=[FootSkate]", space, "search.n_trials=1", "export.graph=off"]
    tuned = run_apart(tmp_path, "tune", *OWN, *QUICK, *search, "--workers", "1")
    assert "1 of 1 trials: 1 complete" in tuned

    # without the package
    paths = os.environ["PYTHONPATH"].split(":")
    monkeypatch.setenv("PYTHONPATH", ":".join(path for path in paths if path != str(EXAMPLE)))
    ran = finished([*MAIN, "eval", made.id], cwd=tmp_path)
    assert ran.returncode == 2
    assert ran.stderr.startswith(f"memmlp: run {made.id}: needs the package {PACKAGE} 0.1.0, which was not")
