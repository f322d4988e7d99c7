"""What a search leaves: trials as CSV, experiments, Table 5, plots."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fake_search
import numpy as np
import optuna
import pytest
import yaml
from optuna.distributions import FloatDistribution
from optuna.trial import create_trial

from memmlp.config.compose import is_any_group
from memmlp.sweep.search import results
from memmlp.sweep.search.search_file import Range
from memmlp.sweep.search.study import Study, suggest_value


def read_rows(study: Study, folder: Path) -> list[dict[str, str]]:
    results.write_trials(study, folder / "trials.csv")
    with open(folder / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_trials_of_several_seeds_as_csv(tmp_path: Path):
    study = fake_search.open_study(tmp_path, seeds=2, n_trials=2, objectives=["MPJPE", "Jitter"])
    one = fake_search.seeded(study, tmp_path)
    fake_search.finish(one.update(1))
    fake_search.finish(one.update(1))
    fake_search.begun(one.update(1)).fail("the loss is nan")
    one.update(1)
    row, failed = read_rows(study, tmp_path)
    first = fake_search.error({"values": study.trials[0].params, "seed": 0})
    found = [float(row[key]) for key in ("MPJPE", "MPJPE sd", "MPJPE, run 1", "Jitter, run 2")]
    assert found == pytest.approx([first + 0.15, 0.3 / 2**0.5, first, 20 - first - 0.3])
    assert len(row["run"].split()) == 2
    assert (failed["state"], failed["MPJPE sd"], failed["reason"]) == ("fail", "", "the loss is nan")
    (path,) = results.write_experiments(study, tmp_path, is_any_group)
    assert row["run"] in path.read_text()


def test_a_pruned_trial_has_no_value_in_the_csv(tmp_path: Path):
    """Optuna gives it that of its last step, which is none of a trained network."""
    first, second, _ = read_rows(fake_search.with_a_pruned_trial(tmp_path), tmp_path)
    assert (first["state"], first["MPJPE"], first["reason"]) == ("complete", "5.0", "")
    assert (second["state"], second["MPJPE"], second["reason"]) == ("pruned", "", "9 at step 10")


@pytest.mark.slow
def test_what_a_search_leaves(tmp_path: Path):
    study = fake_search.open_study(tmp_path)
    fake_search.to_the_end(study, tmp_path)
    rows = read_rows(study, tmp_path)
    assert [row["trial"] for row in rows] == list("012345")
    assert [float(row["MPJPE"]) for row in rows] == [trial.value for trial in study.trials]
    (path,) = results.write_experiments(study, tmp_path, is_any_group)
    best = study.list_best()[0]
    content = yaml.safe_load(path.read_text())
    assert content["defaults"] == [{"override /loss": "manual"}, "_self_"]
    assert {f"loss.{key}": value for key, value in content["loss"].items()} == best.params
    assert path.read_text().startswith("# @package _global_\n")


def write_best(folder: Path, space: dict, base: list[str]) -> dict[str, Any]:
    study = fake_search.open_study(folder, space=space, n_trials=1, base=base)
    one = fake_search.director(study, folder)
    run = fake_search.begun(one.update(1))
    fake_search.log(run, fake_search.STEPS, 1.0)
    run.finish([])
    one.update(1)
    (path,) = results.write_experiments(study, folder, is_any_group)
    return yaml.safe_load(path.read_text())


def test_a_best_trial_of_groups_lists_and_plain_keys_is_a_config(tmp_path: Path):
    space = {"hand": {"choices": ["off", "fk"]}, "memory": {"layers": {"choices": [[2], [2, 4]]}}}
    content = write_best(tmp_path, space | {"seed": {"low": 3, "high": 9}}, [])
    assert content["defaults"][0]["override /hand"] in ("off", "fk")
    assert content["memory"]["layers"] in ([2], [2, 4])
    assert content["seed"] in range(3, 10)


def test_of_a_key_in_the_base_and_the_trial_the_trials_value_is_written(tmp_path: Path):
    """And no experiment, since none can choose another."""
    space, base = {"hand": {"choices": ["fk", "position"]}}, ["hand=off", "experiment=manual_weights"]
    hand, itself = write_best(tmp_path, space, base)["defaults"]
    assert (hand["override /hand"] in ("fk", "position"), itself) == (True, "_self_")


@pytest.mark.parametrize(("tried", "values", "said"), [
    ({"choices": (0.001, 0.002, 0.008)}, [0.001, 0.002, 0.008], "0.008, is the largest"),
    ({"choices": (0.008, 0.016, 0.004)}, [0.016, 0.008, 0.004], "0.004, is the smallest"),
    ({"choices": (0.0, 0.1, 0.2)}, [0.2, 0.1, 0.0], None),  # nothing lies beyond zero
    ({"choices": (False, True)}, [True, False], None),
    ({"low": 1e-4, "high": 1e-2, "log": True}, [1e-3, 9.5e-3], "0.0095, is the largest"),
    ({"low": 1e-4, "high": 1e-2}, [9.5e-3, 2.9e-4], "0.00029, is the smallest"),
])  # fmt: skip
def test_a_best_value_boundary_warnings_of_what_was_tried_is_told(tried, values, said):
    """The last value is the best: so is a network tuned that is not, and looks it."""
    study = optuna.create_study()
    for number, value in enumerate(values):
        study.enqueue_trial({"optim.lr": value})
        trial = study.ask()
        suggest_value(trial, Range("optim.lr", **tried))
        study.tell(trial, -number)
    found = results.find_boundary_warnings(study)
    assert [line.startswith(f"optim.lr: the best value, {said}") for line in found] == [True] * bool(said)


def add_random_trials(study, number: int, names: Sequence[str] = ("acts", "inert", "also inert")):
    """Add complete trials of random values, of which the first alone decides."""
    between = dict.fromkeys(names, FloatDistribution(0.0, 1.0))
    for values in np.random.default_rng(0).random((number, len(names))):
        params = dict(zip(names, map(float, values), strict=True))
        study.add_trial(create_trial(params=params, distributions=between, value=(values[0] - 0.5) ** 2))


def test_importance_needs_trials_and_is_of_the_key_that_acts():
    """Of few it would be chance: an inert key ranks first in most random searches of ten trials."""
    study = optuna.create_study()
    assert results.explain_missing_importances(study) is None
    add_random_trials(study, 24)
    assert results.compute_importances(study) == []
    assert results.explain_missing_importances(study).startswith("needs 25 complete trials; with 24")
    study = optuna.create_study()
    add_random_trials(study, results.ENOUGH_TRIALS)
    (first, share), *rest = results.compute_importances(study)
    assert (first, len(rest), share > 0.5) == ("acts", 2, True)
    assert results.explain_missing_importances(study) is None


def test_keys_of_a_chosen_component_are_below_its_group(tmp_path: Path):
    space = {"optim": {"choices": ["muon", "adamw"], "lr": {"low": 0.1, "high": 0.2}}}
    content = write_best(tmp_path, space | {"model": {"depth": {"low": 2, "high": 6}}}, ["model=agrol_mlp"])
    chosen = {key: value for one in content["defaults"][:-1] for key, value in one.items()}
    assert chosen["override /model"] == "agrol_mlp"
    assert chosen["override /optim"] in ("muon", "adamw")
    assert content["model"]["depth"] in range(2, 7)
    assert 0.1 <= content["optim"]["lr"] <= 0.2
