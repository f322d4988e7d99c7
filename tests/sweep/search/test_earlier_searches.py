"""What a later search and the summary read from the folders of finished searches."""

from __future__ import annotations

import csv
from dataclasses import asdict
from pathlib import Path

import pytest
from fake_search import SPACE, finish, open_study, search, seeded

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.runs.run import Run
from memmlp.sweep.search.earlier_searches import FinishedSearch, format_summary, format_trials
from memmlp.sweep.search.results import write_trials


def finished(home: Path, command_line: list[str], **changes) -> Path:
    """A finished search below a folder of outputs; its runs have the compute of its budget."""
    folder = home / "tune" / command_line[0].replace("=", "-")
    folder.mkdir(parents=True)
    study = open_study(folder, **changes)
    director = seeded(study, home)
    while (plan := director.update(2)).tasks:
        finish(plan)
    write_trials(study, folder / "trials.csv")
    write_json(folder / "search.json", {**asdict(study.search), "command_line": command_line})
    for trial in study.trials:
        for name in trial.user_attrs["runs"]:
            Run.from_id(home, name).write_manifest({"tflop": 5.1})
    return folder


def test_the_best_trial_with_all_its_overrides(tmp_path: Path):
    folder = finished(tmp_path, ["model=rpm", "profile=tiny"], tflop=5)
    rows = list(csv.DictReader((folder / "trials.csv").read_text().splitlines()))
    best = min(rows, key=lambda row: float(row["MPJPE"]))
    found = FinishedSearch(folder)
    expected = {key: float(best[key]) for key in ("loss.rotation_all", "loss.hand")}
    assert found.best_values == expected
    assert found.overrides == ("loss=manual", "model=rpm", "profile=tiny")


def test_the_summary_has_budgets_and_best_trials(tmp_path: Path):
    folders = [finished(tmp_path, ["model=rpm"], tflop=5), finished(tmp_path, ["seed=3"], seeds=2, seed=1)]
    searches = list(map(FinishedSearch, folders))
    *_, first, second = format_summary(searches)
    assert first.startswith("| model-rpm | model=rpm | 5 | 5.1 to 5.1 | 6 of 6 | MPJPE ")
    assert second.startswith("| seed-3 | model=mem_mlp | - | 5.1 to 5.1 | 6 of 6 | MPJPE ")
    assert " ± " in second
    rows = list(csv.DictReader(format_trials(searches).splitlines()))
    assert (len(rows), {row["network"] for row in rows[:6]}) == (12, {"model=rpm"})
    assert all(float(row["loss.hand"]) > 0 for row in rows)
    assert rows[-1]["tflop"] == "5.1 5.1"


def test_a_folder_without_a_finished_search_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="must be the folder of a finished search"):
        FinishedSearch(tmp_path)


def test_a_range_around_the_best_value():
    space = {"loss": {**SPACE, "rotation_all": {"factor": 2}}}
    made = search(space=space, best={"loss.rotation_all": 3.0})
    one = next(one for one in made.space if one.key == "loss.rotation_all")
    assert (one.low, one.high, one.log, one.first) == (1.5, 6.0, True, 3.0)
    with pytest.raises(InputError, match="factor: needs search"):
        search(space=space)


def test_choices_of_a_group_beside_its_keys_and_choices_of_several_overrides():
    many = "kinematic predictor=rotation_only hand=off"
    space = {"optim": {"choices": ["adamw", "muon"], "lr": {"low": 0.1, "high": 1.0}}}
    made = search(space=space | {"loss": {"choices": ["default", many]}})
    assert [one.key for one in made.space] == ["optim.lr", "optim", "loss"]
    assert made.overrides({"optim": "muon", "loss": "default"}) == ("optim=muon",)
    assert made.overrides({"loss": many}) == ("loss=kinematic", "predictor=rotation_only", "hand=off")


@pytest.mark.parametrize(("file", "old", "new"), [
    ("search.json", '"objectives"', '"other"'), ("search.json", '"text": "', '"text": 5, "x": "'),
    ("search.json", "{", "["), ("trials.csv", "state", "other"), ("trials.csv", "complete,", "complete,x"),
])  # fmt: skip
def test_a_damaged_search_is_one_line(tmp_path: Path, file: str, old: str, new: str):
    folder = finished(tmp_path, ["model=rpm"], tflop=5)
    path = folder / file
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=file):
        FinishedSearch(folder)
