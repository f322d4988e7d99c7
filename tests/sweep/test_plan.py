"""Plans: what variants need of one."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.sweep.plan import Entry, Forecast, Plan, RunTask, estimate_time, order_tasks


def a_plan() -> Plan:
    """Two variants on one VQ-VAE, the second behind a network that is a variant too, and one on nothing."""
    tasks = (
        RunTask("vqvae", "vqvae", {}),
        RunTask("net", "memmlp", {}, "vqvae", ("stream",)),
        RunTask("net", "memmlp", {}, "vqvae"),
        RunTask("refined", "memmlp", {}, "net", ("stream",)),
        RunTask("plain", "memmlp", {}, None, ("stream",)),
    )
    entries = [Entry(label, 0, run, ("stream",)) for label, run in VARIANTS.items()]
    return Plan("s", Path("outputs"), tuple(entries), order_tasks(tasks))


VARIANTS = {"network": "net", "refined": "refined", "plain": "plain"}


def needed(*labels: str) -> list[str]:
    part = a_plan().select_variants(labels)
    assert {entry.label for entry in part.entries} == set(labels)
    return [task.key for task in part.tasks]


def test_variants_need_their_runs_and_their_prerequisites():
    assert needed("plain") == ["plain stream"]
    assert needed("network") == ["vqvae", "net stream"]
    assert needed("refined") == ["vqvae", "net", "refined stream"]
    assert needed() == []
    assert a_plan().select_variants(VARIANTS) == a_plan()


CODES, QUICK, SLOW = ("c" * 16,), ("a" * 16, "b" * 16), ("d" * 16, "e" * 16)


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    """Two variants of two seeds each, and what is prerequisite of them."""
    variants = {"quick": QUICK, "slow": SLOW}
    entries = [
        Entry(variant, seed, name) for variant, names in variants.items() for seed, name in enumerate(names)
    ]
    tasks = [RunTask(CODES[0], "vqvae", {})]
    tasks += [RunTask(entry.id, "memmlp", {}, CODES[0]) for entry in entries]
    return Plan("trial", tmp_path, tuple(entries), tuple(tasks))


def finish(plan: Plan, name: str, seconds: object) -> None:
    """End a run that took so long."""
    task = next(task for task in plan.tasks if task.id == name)
    run = plan.get_run(task)
    run.begin(task.kind, {}, data="d", prerequisite=task.prerequisite)
    run.write_manifest({"seconds": seconds})
    run.results_path.write_text("{}")
    run.finish(["results.json"])


def test_nothing_is_foretold_of_a_kind_of_which_nothing_has_finished(plan: Plan):
    assert estimate_time(plan) is None
    finish(plan, CODES[0], 10.0)
    assert estimate_time(plan) is None


def test_a_run_is_judged_by_its_variant(plan: Plan):
    finish(plan, CODES[0], 10.0)
    finish(plan, QUICK[0], {"train": 50.0, "evaluate": 10.0})
    finish(plan, SLOW[0], {"train": 1000.0, "evaluate": 200.0})
    assert estimate_time(plan) == Forecast(60.0 + 1200.0, finished=2)


def test_an_variant_without_a_finished_run_is_judged_by_the_others_and_counted(plan: Plan):
    finish(plan, CODES[0], 10.0)
    finish(plan, QUICK[0], 60.0)
    assert estimate_time(plan) == Forecast(60.0 + 2 * 60.0, finished=1)
