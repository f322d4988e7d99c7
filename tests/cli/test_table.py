"""`memmlp table`: what it prints and writes, and what it refuses."""

import json
from pathlib import Path

import pytest
from cli.conftest import replace_planning
from conftest import Memmlp, one_line

from memmlp.sweep.plan import Plan


def test_command_prints_a_table(memmlp: Memmlp, planned: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "100")
    ran = memmlp("table", "14")
    assert ran.code == 0
    assert "Table 14: Placement" in ran.out
    assert ran.out.count("3/3") == 8
    assert max(map(len, ran.out.splitlines())) <= 100
    assert memmlp("table", "13", "--mode", "window").out.count("3/3") == 3
    assert "measured: data.root" in memmlp("table", "1").out


def test_command_shows_another_branch_and_puts_clips_together(memmlp: Memmlp, planned: None):
    def show(*words: str) -> str:
        return " ".join(memmlp("table", "14", *words).out.split())

    position = show("--branch", "position")
    assert "errors of the branch: position" in position
    assert position.count("± ") < show().count("± ")  # no rotations, no MPJRE
    assert "merged 4 groups of test clips into 3" in show("--together", "(salsa)")
    assert one_line(memmlp("table", "14", "--together", "(walk)"), "must match clips")


def test_command_writes_the_format_of_the_ending(memmlp: Memmlp, planned: None, tmp_path: Path):
    for ending, word in (("md", "| variant |"), ("tex", r"\toprule"), ("json", '"rows"')):
        ran = memmlp("table", "5", "--out", f"out/t.{ending}")
        assert (ran.code, ran.out) == (0, f"out/t.{ending}\n")
        assert word in Path(f"out/t.{ending}").read_text()
    assert json.loads(memmlp("table", "5", "--format", "json").out)["number"] == 5


def test_all_as_json_is_one_list(memmlp: Memmlp, planned: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("memmlp.common.progress.INTERVAL", 0.0)
    replace_planning(monkeypatch, lambda *_: Plan("", Path(), (), ()))
    ran = memmlp("table", "all", "--format", "json")
    assert len(json.loads(ran.out)) == 17
    assert "tables: 1 of 17" in ran.err


@pytest.mark.parametrize(("arguments", "words"), [
    (["99"], ("no such sweep", "a table's number from 1 to 17", "memory_control")),
    (["14", "bad=1"], ("data.root",)),
    (["all", "bad=1"], ("data.root",)),
    (["14", "--out", "table.pdf"], ("--out table.pdf", "md, tex, json")),
    (["14", "--out", "/proc/nothing/t.md"], ("--out /proc/nothing/t.md",)),
    (["14", "--mode", "both modes"], ("--mode",)),
    (["14", "--branch", "head"], ("--branch", "rotation", "combined")),
    (["14", "--together", "("], ("--together (: not a regular expression (missing )",)),
    (["all", "--untrained"], ("--untrained: sweep table01 shows MPJRE",)),
    (["5", "--untrained"], ("--untrained: sweep table05 shows MPJRE, MPJPE", "FLOPs, MACs")),
])  # fmt: skip
def test_bad_input_is_one_line(memmlp: Memmlp, planned: None, arguments: list[str], words: tuple[str, ...]):
    assert one_line(memmlp("table", *arguments), *words)
