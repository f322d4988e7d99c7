"""`memmlp table`: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from conftest import Memmlp, one_line
from fake_runs import CLIPS, fake_sweep

from memmlp.common.errors import InputError
from memmlp.sweep.definition import Sweep
from memmlp.sweep.plan import Entry, Plan


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Replace planning: every sweep's runs are there, except those of Table 1, which can't be planned."""

    def plan(sweep: Sweep, outputs: Path, prepare: bool = False) -> Plan:
        if sweep.table == 1 or "bad=1" in sweep.command_line:
            raise InputError("data.root: has no value")
        find = fake_sweep(tmp_path / sweep.name, sweep, clips=CLIPS[-4:])
        entries = [(variant, seed) for variant in sweep.list_runnable() for seed in sweep.seeds]
        found = [Entry(variant.label, seed, find(variant, seed).id) for variant, seed in entries]  # type: ignore[union-attr]
        return Plan(sweep.name, tmp_path / sweep.name, tuple(found), ())

    monkeypatch.setattr("memmlp.config.compose_plan.make_plan", plan)


def test_command_prints_a_table(memmlp: Memmlp, planned: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "100")
    ran = memmlp("table", "14")
    assert ran.code == 0
    assert "Table 14: Placement" in ran.out
    assert ran.out.count("3/3") == 8
    assert max(map(len, ran.out.splitlines())) <= 100
    assert memmlp("table", "13", "--mode", "window").out.count("3/3") == 3


def test_command_shows_another_branch(memmlp: Memmlp, planned: None):
    out = " ".join(memmlp("table", "14", "--branch", "position").out.split())
    assert "errors of the branch: position" in out
    assert out.count("± ") < " ".join(memmlp("table", "14").out.split()).count("± ")  # no rotations, no MPJRE


def test_command_puts_clips_together(memmlp: Memmlp, planned: None):
    out = " ".join(memmlp("table", "14", "--together", "(salsa)").out.split())
    assert "merged 4 groups of test clips into 3" in out
    assert one_line(
        memmlp("table", "14", "--together", "walk"), "--together walk: must match clips in different groups"
    )


def test_command_writes_the_format_of_the_ending(memmlp: Memmlp, planned: None, tmp_path: Path):
    for ending, word in (
        ("md", "| variant |"),
        ("tex", r"\toprule"),
        ("json", '"rows"'),
    ):
        ran = memmlp("table", "5", "--out", f"out/t.{ending}")
        assert (ran.code, ran.out) == (0, f"out/t.{ending}\n")
        assert word in Path(f"out/t.{ending}").read_text()
    assert json.loads(memmlp("table", "5", "--format", "json").out)["number"] == 5


@pytest.mark.slow
def test_command_prints_all_tables(memmlp: Memmlp, planned: None):
    out = memmlp("table", "all", "--mode", "stream").out
    assert [int(number) for number in re.findall(r"^Table (\d+):", out, re.MULTILINE)] == list(range(1, 18))
    assert "nothing measured: data.root: has no value" in " ".join(out.split())


def test_the_progress_of_many_tables_is_told(memmlp: Memmlp, planned: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("memmlp.common.progress.INTERVAL", 0.0)
    assert "tables: 1 of 17" in memmlp("table", "all", "bad=1").err


@pytest.mark.slow
def test_all_as_json_is_one_list(memmlp: Memmlp, planned: None):
    assert len(json.loads(memmlp("table", "all", "--format", "json").out)) == 17


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["99"], ("no such sweep", "a table's number from 1 to 17", "memory_control")),
        (["14", "bad=1"], ("data.root",)),
        (["all", "bad=1"], ("data.root",)),
        (["14", "--out", "table.pdf"], ("--out table.pdf", "md, tex, json")),
        (["14", "--out", "/proc/nothing/t.md"], ("--out /proc/nothing/t.md",)),
        (["14", "--mode", "both modes"], ("--mode",)),
        (["14", "--branch", "head"], ("--branch", "rotation", "combined")),
    ],
)
def test_bad_input_is_one_line(memmlp: Memmlp, planned: None, arguments: list[str], words: tuple[str, ...]):
    assert one_line(memmlp("table", *arguments), *words)
