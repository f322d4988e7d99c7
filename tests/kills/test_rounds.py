"""Rounds of seeds under a SIGKILL: started again, they end with every run made once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from command_line import TINY, in_folder, run
from processes import forked, until

from memmlp.motion.formats.npz import write_clip
from memmlp.motion.synthetic import synthesize_clip
from memmlp.runs.lookup import list_runs

SETTINGS = [
    "data=mocap",
    "data.root=clips",
    "data.split.test=0.5",
    "evaluation.modes=[stream]",
    "executor=debug",
    "export.graph=off",
]
WORDS = ["sweep", "trial.yaml", *(word for word in TINY if "synth" not in word), *SETTINGS]


@pytest.mark.slow
def test_rounds_go_on_after_a_kill(tmp_path: Path):
    """Of two variants that hardly differ, which three seeds show."""
    hardly = ["memory=none", "optim.weight_decay=1.001e-4"]
    content = {"metrics": ["MPJPE"], "variants": {"one": ["memory=none"], "other": hardly}}
    for activity in ("walking", "squatting", "reaching", "waving"):
        write_clip(tmp_path / f"clips/{activity}.npz", synthesize_clip(activity, 0, seconds=1))
    (tmp_path / "trial.yaml").write_text(yaml.safe_dump(content))
    with forked(in_folder, tmp_path, *WORDS, "--until-decided") as killed:
        until(
            lambda: any(one.done for one in list_runs(tmp_path / "outputs")), "the first run is done", killed
        )
    assert not list(tmp_path.glob("outputs/sweeps/*/rounds.json"))
    said = run(tmp_path, *WORDS, "--until-decided")
    assert "all verdicts are decided" in said
    runs = list_runs(tmp_path / "outputs")
    assert len(runs) == 6
    assert all(one.done for one in runs)
    path = next(tmp_path.glob("outputs/sweeps/*/rounds.json"))
    (analysis,) = json.loads(path.read_text())["analyses"]
    assert {finding["verdict"] for finding in analysis["findings"]} == {"equivalent"}
    before = [one.marker.stat().st_mtime_ns for one in runs]
    assert "6 of 6 runs done" in run(tmp_path, *WORDS, "--until-decided")
    assert [one.marker.stat().st_mtime_ns for one in runs] == before
