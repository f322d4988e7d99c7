"""Plans: what arms need of one."""

from __future__ import annotations

from pathlib import Path

from memmlp.sweep.plan import Entry, Plan, RunTask, unique


def a_plan() -> Plan:
    """Two arms on one VQ-VAE, the second behind a network that is an arm of its own, and one on nothing."""
    tasks = (
        RunTask("vqvae", "vqvae", {}),
        RunTask("net", "memmlp", {}, "vqvae", ("stream",)),
        RunTask("net", "memmlp", {}, "vqvae"),
        RunTask("refined", "memmlp", {}, "net", ("stream",)),
        RunTask("plain", "memmlp", {}, None, ("stream",)),
    )
    entries = [Entry(label, 0, run, ("stream",)) for label, run in ARMS.items()]
    return Plan("s", Path("outputs"), tuple(entries), unique(tasks))


ARMS = {"network": "net", "refined": "refined", "plain": "plain"}


def needed(*labels: str) -> list[str]:
    part = a_plan().of_arms(labels)
    assert {entry.label for entry in part.entries} == set(labels)
    return [task.key for task in part.tasks]


def test_arms_need_their_runs_and_those_upstream():
    assert needed("plain") == ["plain stream"]
    assert needed("network") == ["vqvae", "net stream"]
    assert needed("refined") == ["vqvae", "net", "refined stream"]
    assert needed() == []
    assert a_plan().of_arms(ARMS) == a_plan()
