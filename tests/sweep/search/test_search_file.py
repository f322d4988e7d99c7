"""Searches from configs: what is refused, and what objectives and ranges mean."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from fake_search import SPACE, finish, open_study, search, seeded

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.common.text_formats import parse_csv
from memmlp.sweep.search.results import write_trials
from memmlp.sweep.search.search_file import Range, parse_search, read_best_trial

GOOD: dict[str, Any] = {
    "name": "mine", "base": ["loss=manual"],
    "space": {"loss": {"rotation_all": {"low": 0.1, "high": 10.0, "log": True, "first": 1.0}}},
    "objectives": ["MPJPE"], "n_trials": 3, "seeds": 1, "sampler": "tpe", "startup": 2, "seed": 0,
    "pruner": "median", "prune_after": 2, "tflop": None, "after": None, "storage": None,
}  # fmt: skip


def made(**changes: Any):
    return parse_search({**GOOD, **changes})


def space(**leaf: Any) -> dict[str, Any]:
    return {"optim": {"lr": leaf}}


def test_a_tree_of_keys_becomes_ranges():
    found = made(
        space={"loss": {"hand": {"low": 0.1, "high": 1.0}}, "hand": {"choices": ["off", "fk"], "first": "fk"}}
    )
    assert found.space == (Range("loss.hand", 0.1, 1.0), Range("hand", choices=("off", "fk"), first="fk"))
    assert found.list_first_trials() == [{"hand": "fk"}]
    assert found.space[1].list_corners() == ("off", "fk")


@pytest.mark.parametrize(("text", "value"), [
    ("MPJPE", 6.0), ("rotation MPJPE", 6.0), ("position MPJPE", 5.0), ("MPJPE + 0.1*Jitter", 7.0),
    ("0.5 * MPJPE + 2*position Hand PE", 5.0), ("1e-1*Hand PE", 0.2),
])  # fmt: skip
def test_an_objective_is_a_weighted_sum(text: str, value: float):
    metrics = {
        "rotation MPJPE": 6.0, "rotation Jitter": 10.0, "rotation Hand PE": 2.0,
        "position MPJPE": 5.0, "position Hand PE": 1.0,
    }  # fmt: skip
    assert made(objectives=[text]).objectives[0].value(metrics) == pytest.approx(value)
    with pytest.raises(InputError, match="'position MPJRE' is not validated"):
        made(objectives=["position MPJRE"]).objectives[0].value(metrics)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"space": {}}, "search.space: empty"), ({"space": {"loss": 3}}, "search.space.loss: 3"),
    ({"space": space(low=0.0, high=1.0, log=True)}, "optim.lr.low=0.0"),
    ({"space": space(low=1.0, high=2.0, log=True, step=0.1)}, "optim.lr.step=0.1"),
    ({"space": space(low=1.0, high=2.0, first=3.0)}, "optim.lr.first=3.0"),
    ({"space": space(low=1.0, high=2.0, hihg=3.0)}, "optim.lr.hihg: no such key"),
    ({"space": space(choices="ab")}, "optim.lr.choices"), ({"space": space(choices=[1])}, "optim.lr.choices"),
    ({"space": space(choices=[1, 1])}, "optim.lr.choices"),
    ({"space": space(low=4, high=8, step=1.5)}, "optim.lr.step=1.5"),
    ({"objectives": ["MPJPE", "Jitter"]}, "search.pruner=median"), ({"objectives": ["Jitters"]}, "'Jitters'"),
    ({"objectives": ["MPJPE - Jitter"]}, "'MPJPE - Jitter'"),
    ({"objectives": "MPJPE"}, "search.objectives=MPJPE"), ({"base": [1]}, "search.base="),
    ({"seeds": 0}, "search.seeds=0"),
    ({"seeds": 3, "space": {"seed": {"low": 0, "high": 9}}}, "search.seeds=3"),
    ({"sampler": "grid"}, "search.space.loss.rotation_all"),
    ({"sampler": "grid", "space": space(choices=[1, 2], first=1)}, "optim.lr"),
    ({"sampler": "grid", "space": space(choices=[1, 2, 3]), "n_trials": 2}, "search.n_trials=2: must be 3"),
]  # fmt: skip


def test_what_is_wrong_is_named():
    for changes, words in WRONG:
        with pytest.raises(InputError) as caught:
            made(**changes)
        assert words in str(caught.value), changes
    with pytest.raises(InputError, match=r"search\.n_trials: has no value"):
        parse_search({key: value for key, value in GOOD.items() if key != "n_trials"})


def finished(home: Path, command_line: list[str], **changes) -> Path:
    """A finished search below a folder of outputs."""
    folder = home / "tune" / command_line[0].replace("=", "-")
    folder.mkdir(parents=True)
    study = open_study(folder, **changes)
    director = seeded(study, home)
    while (plan := director.update(2)).tasks:
        finish(plan)
    write_trials(study, folder / "trials.csv")
    write_json(folder / "search.json", {**asdict(study.search), "command_line": command_line})
    return folder


def test_the_best_trial_with_all_its_overrides(tmp_path: Path):
    folder = finished(tmp_path, ["model=rpm", "profile=tiny"], tflop=5)
    rows = parse_csv((folder / "trials.csv").read_text())
    best = min(rows, key=lambda row: float(row["MPJPE"]))
    expected = {key: float(best[key]) for key in ("loss.rotation_all", "loss.hand")}
    assert read_best_trial(folder) == (("loss=manual", "model=rpm", "profile=tiny"), expected)


def test_a_folder_without_a_finished_search_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="must be"):
        read_best_trial(tmp_path)


def test_a_range_around_the_best_value():
    ranges = {"loss": {**SPACE, "rotation_all": {"factor": 2}}}
    made = search(space=ranges, best={"loss.rotation_all": 3.0})
    one = next(one for one in made.space if one.key == "loss.rotation_all")
    assert (one.low, one.high, one.log, one.first) == (1.5, 6.0, True, 3.0)
    with pytest.raises(InputError, match="factor: needs search"):
        search(space=ranges)


def test_choices_of_a_group_beside_its_keys_and_choices_of_several_overrides():
    many = "kinematic predictor=rotation_only hand=off"
    ranges = {"optim": {"choices": ["adamw", "muon"], "lr": {"low": 0.1, "high": 1.0}}}
    made = search(space=ranges | {"loss": {"choices": ["default", many]}})
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
        read_best_trial(folder)
