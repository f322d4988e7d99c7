"""The example package of docs/examples through every command, at the smallest sizes; and without it."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from command_line import MAIN, in_folder, run, run_apart
from own_package import EXAMPLE, KILLED, PACKAGE, TINY
from processes import finished, forked, until

from memmlp.runs.lookup import list_runs

OWN = [f"plugins=[{PACKAGE}]", "experiment=feet"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:unclosed file .*DEBUG:ResourceWarning")  # submitit leaves its logs open
def test_components_of_ones_own_go_through_everything(
    on_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    home = tmp_path
    # trained, killed, resumed
    words = ["train", *OWN, *KILLED]
    with forked(in_folder, home, *words, **os.environ) as process:
        found = until(lambda: [*home.glob("outputs/runs/*/checkpoint.safetensors")], "a checkpoint", process)
        process.kill()
    said = run(home, *words)
    (made,) = list_runs(home / "outputs")
    assert made.folder == found[0].parent
    assert made.done
    assert [one["stage"] for one in made.manifest["attempts"]][:2] == ["training", "training"]
    assert "FootSkate" in said
    assert made.results["latency"]["graph"] == "naive"
    record = made.manifest["plugins"][PACKAGE]
    assert record["version"] == "0.1.0"
    assert f"{PACKAGE}:memory.py" in made.manifest["sources"]
    assert "skate" in made.metrics_path.read_text()

    # evaluated and exported
    assert "measured before" in run(home, "eval", made.id, "--plugins", PACKAGE)
    run(home, "export", made.id, "--out", "step.onnx", "--plugins", PACKAGE)
    assert (home / "step.onnx").exists()

    # swept in this process, shown in a table and a page: one arm is the run that there is
    sweep = shutil.copy(EXAMPLE / "feet.yaml", home)
    quick = [sweep, *KILLED, "export.graph=off"]
    shown = run(home, "sweep", *quick, "executor=debug")
    assert "2 of 2 runs done" in shown
    assert len(list_runs(home / "outputs")) == 2
    table = json.loads(run(home, "table", *quick, "--format", "json"))
    assert "FootSkate" in json.dumps(table)
    run(home, "report", *quick, "--out", "page.html")
    assert "FootSkate" in (home / "page.html").read_text()

    # searched by workers: by its metric, over the weight of its term
    space = "+search.space.term.weight={low: 0.01, high: 1.0, log: true}"
    search = ["search.objectives=[FootSkate]", space, "search.n_trials=1"]
    tuned = run_apart(home, "tune", *OWN, *TINY, "optim.steps=6", *search, "--workers", "1")
    assert "1 of 1 trials: 1 complete" in tuned

    # somewhere else, without the package
    paths = os.environ["PYTHONPATH"].split(":")
    monkeypatch.setenv("PYTHONPATH", ":".join(path for path in paths if path != str(EXAMPLE)))
    ran = finished([*MAIN, "eval", made.id], cwd=home)
    assert ran.returncode == 2
    assert ran.stderr == (
        f"memmlp: run {made.id}: made with the package {PACKAGE} 0.1.0, which is not found; install it, or "
        "put its folder on PYTHONPATH\n"
    )
