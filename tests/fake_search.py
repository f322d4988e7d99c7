"""Searches with simulated runs: a trial's error is a function of its values."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from memmlp.runs.identity import Identity
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask
from memmlp.sweep.search.director import Director
from memmlp.sweep.search.search_file import Search, Value, parse_search
from memmlp.sweep.search.study import Study

STEPS = 30
SPACE = {
    "rotation_all": {"low": 0.1, "high": 10.0, "log": True, "first": 1.0},
    "hand": {"low": 0.01, "high": 1.0, "log": True, "first": 0.1},
}


def search(best: Mapping[str, Value] | None = None, **changes: Any) -> Search:
    content: dict[str, Any] = {
        "name": "mine", "base": ["loss=manual"], "space": {"loss": SPACE}, "objectives": ["MPJPE"],
        "n_trials": 6, "seeds": 1, "sampler": "tpe", "startup": 3, "seed": 0, "pruner": "none",
        "tflop": None, "after": None,
        "prune_after": 2, "storage": None,
    }  # fmt: skip
    return parse_search({**content, **changes}, best)


def open_study(folder: Path, **changes: Any) -> Study:
    return Study.open(search(**changes), "mine", folder)


def compose(values: Mapping[str, Value], seeds: int = 1) -> list[list[RunTask]]:
    configs = [{"optim": {"steps": STEPS}, "values": dict(values), "seed": seed} for seed in range(seeds)]
    return [[RunTask(Identity("memmlp", config, "d").id, "memmlp", config)] for config in configs]


def director(study: Study, folder: Path, composed: Callable = compose) -> Director:
    return Director(study, composed, Plan("mine", folder, (), (), open=True))


def error(config: Mapping[str, Any]) -> float:
    """Return a trial's error: lowest at weights of 2 and 0.2, and 0.3 higher with each further seed."""
    values = config["values"]
    return 5 + abs(values["loss.rotation_all"] - 2) + abs(values["loss.hand"] - 0.2) + 0.3 * config["seed"]


def log(run: Run, step: int, value: float) -> None:
    run.log(step, {"rotation MPJPE": value, "rotation Jitter": 20 - value}, "val")


def finish(plan: Plan) -> None:
    for task in plan.list_remaining():
        run = plan.get_run(task)
        run.begin("memmlp", task.config, data="d", prerequisite=None)
        log(run, STEPS, error(task.config))
        run.finish([])


def to_the_end(study: Study, folder: Path, capacity: int = 2) -> None:
    one = director(study, folder)
    while (plan := one.update(capacity)).tasks:
        finish(plan)


def begun(plan: Plan) -> Run:
    (task,) = plan.tasks
    run = plan.get_run(task)
    run.begin("memmlp", task.config, data="d", prerequisite=None)
    return run


def seeded(study: Study, folder: Path) -> Director:
    return director(study, folder, partial(compose, seeds=study.search.seeds))


def with_a_pruned_trial(folder: Path) -> Study:
    """Return a search in a folder with a trial that ended at 5, one that was pruned at 9, and one begun."""
    study = open_study(folder, pruner="median", prune_after=1)
    one = director(study, folder)
    finished = begun(one.update(1))
    for step in (10, STEPS):
        log(finished, step, 5.0)
    finished.finish([])
    log(begun(one.update(1)), 10, 9.0)
    one.update(1)
    return study
