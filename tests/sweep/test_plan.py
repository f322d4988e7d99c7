"""Plans: what variants need of one."""

from __future__ import annotations

from pathlib import Path

from memmlp.sweep.plan import Entry, Plan, RunTask, unique


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
    return Plan("s", Path("outputs"), tuple(entries), unique(tasks))


VARIANTS = {"network": "net", "refined": "refined", "plain": "plain"}


def needed(*labels: str) -> list[str]:
    part = a_plan().of_variants(labels)
    assert {entry.label for entry in part.entries} == set(labels)
    return [task.key for task in part.tasks]


def test_variants_need_their_runs_and_those_upstream():
    assert needed("plain") == ["plain stream"]
    assert needed("network") == ["vqvae", "net stream"]
    assert needed("refined") == ["vqvae", "net", "refined stream"]
    assert needed() == []
    assert a_plan().of_variants(VARIANTS) == a_plan()
