"""Two sources at once, as a person trains on them and looks at each."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.conftest import write_random_clip
from command_line import run

from memmlp.runs.lookup import list_runs

TINY = ["profile=tiny", "loggers=none", "threads=1", "optim.steps=6", "memory=none", "export.graph=off"]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    for number, folder in enumerate(("one", "two")):
        rng = np.random.default_rng(number)
        for n in range(4):
            write_random_clip(tmp_path / folder / f"{n}.npz", rng)
    base = ["data=mocap", "data.root=[one,two]"]
    (tmp_path / "both.yaml").write_text(yaml.safe_dump({"variants": {"none": []}, "base": base}))
    return tmp_path


@pytest.mark.slow
def test_every_command_knows_where_a_clip_is_from(home):
    assert "none" in run(home, "sweep", "both.yaml", *TINY, "executor=debug")
    (made,) = list_runs(home / "outputs")
    (cache,) = (home / "outputs" / "cache").glob("*/manifest.json")
    said = run(home, "data", "inspect", str(cache.parent))
    assert "one: train 2 clips, 0.001 h; val 1 clips, 0.000 h; test 1 clips, 0.000 h" in said
    report = json.loads(next(made.evaluations.glob("stream*.json")).read_text())
    assert [row["source"] for row in report["clips"]] == ["one", "two"]
    for command in (["runs", "show"], ["eval"]):
        shown = run(home, *command, made.id)
        assert "of one" in shown or "on one" in shown
        assert "of two" in shown or "on two" in shown
    table = run(home, "table", "both.yaml", *TINY, "--source", "two", "--format", "json")
    shown = json.loads(table)
    assert shown["title"].endswith("(test clips of two alone)")
    (row,) = [row for row in report["clips"] if row["source"] == "two"]
    assert f"{row['rotation']['MPJPE']:.4f}"[:5] in table
    assert "must be one or two" in run(home, "table", "both.yaml", *TINY, "--source", "three", code=2)
    run(home, "results", "save", "both.yaml", *TINY, "--out", "pages/data")
    run(home, "results", "docs", "--folder", "pages")
    with (home / "pages" / "tables" / "both.csv").open() as file:
        assert {row["test clips"] for row in csv.DictReader(file)} == {"all", "one", "two"}
