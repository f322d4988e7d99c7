"""Plans: what variants need of one."""

from pathlib import Path

import pytest

from memmlp.sweep.plan import Entry, Forecast, Plan, RunTask, estimate_time, order_tasks


def test_variants_need_their_runs_and_their_prerequisites():
    """Two variants on one VQ-VAE, the second behind a network that is a variant too, and one on nothing."""
    above = {"vqvae": None, "net": "vqvae", "refined": "net", "plain": None}
    tasks = [RunTask(name, "memmlp", {}, one, ("stream",) * (name != "vqvae")) for name, one in above.items()]
    tasks.insert(2, RunTask("net", "memmlp", {}, "vqvae"))
    entries = tuple(Entry(f"{name}s", 0, name, ("stream",)) for name in above if name != "vqvae")
    plan = Plan("s", Path("outputs"), entries, order_tasks(tasks))
    needs = {
        "plains": ["plain stream"],
        "nets": ["vqvae", "net stream"],
        "refineds": ["vqvae", "net", "refined stream"],
    }
    for label, keys in needs.items():
        part = plan.select_variants([label])
        assert ([one.label for one in part.entries], [task.key for task in part.tasks]) == ([label], keys)
    assert plan.select_variants([]).tasks == ()
    assert plan.select_variants(needs) == plan


CODES, QUICK, SLOW = ("c" * 16,), ("a" * 16, "b" * 16), ("d" * 16, "e" * 16)


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    """Two variants of two seeds each, and what is prerequisite of them."""
    variants = {"quick": QUICK, "slow": SLOW}
    entries = [Entry(one, seed, name) for one, names in variants.items() for seed, name in enumerate(names)]
    tasks = [RunTask(CODES[0], "vqvae", {})]
    tasks += [RunTask(entry.id, "memmlp", {}, CODES[0]) for entry in entries]
    return Plan("trial", tmp_path, tuple(entries), tuple(tasks))


def finish(plan: Plan, name: str, seconds: object) -> None:
    task = next(task for task in plan.tasks if task.id == name)
    run = plan.get_run(task)
    run.begin(task.kind, {}, data="d", prerequisite=task.prerequisite)
    run.write_manifest({"seconds": {"train": seconds} if isinstance(seconds, float | int) else seconds})
    run.results_path.write_text("{}")
    run.finish(["results.json"])


def test_a_run_is_judged_by_its_variant_or_the_others(plan: Plan):
    for kind in ("nothing", "a VQ-VAE alone"):
        assert estimate_time(plan) is None, kind
        finish(plan, CODES[0], 10.0)
    finish(plan, QUICK[0], {"train": 50.0, "evaluate": 10.0})
    assert estimate_time(plan) == Forecast(60.0 + 2 * 60.0, finished=1)
    finish(plan, SLOW[0], {"train": 1000.0, "evaluate": 200.0})
    assert estimate_time(plan) == Forecast(60.0 + 1200.0, finished=2)
