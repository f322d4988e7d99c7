"""docs/architecture.md has the checked layers, and names the files that there are."""

from __future__ import annotations

import ast
import re
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest

from memmlp.runs.environment import NOT_NUMBERS, PACKAGE, WIRING, code_digests

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "architecture.md"
AS_A_WHOLE = ("schema", "synthetic", "memory", "baselines", "streaming")
SUFFIXES = ("json", "jsonl", "npy", "onnx", "patch", "py", "safetensors", "toml", "yaml")
FENCE = re.compile(r"^```\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def blocks() -> list[str]:
    return FENCE.findall(PAGE.read_text(encoding="utf-8"))


def test_layers_are_those_of_the_contract(blocks: list[str]):
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = [layer.replace("memmlp.", "") for layer in contracts[0]["layers"]]
    assert [block.split("\n")[:-1] for block in blocks].count(layers) == 1


def test_page_names_files_that_exist():
    real = {path.name for path in [*PACKAGE.rglob("*.py"), *ROOT.joinpath("docs").glob("*.py")]}
    real |= {path.name for path in ROOT.joinpath("tests").rglob("*.py")}
    named = set(re.findall(r"\b\w+\.py\b", PAGE.read_text(encoding="utf-8")))
    assert named - real == set()


def test_page_names_parts_of_modules_that_exist():
    """Such as `tracker_resampling.GAP` and `tables.statistics`; keys of the config have the same form."""
    parts: dict[str, set[str]] = defaultdict(set)
    for path in [*PACKAGE.rglob("*.py"), *(path for path in PACKAGE.rglob("*") if path.is_dir())]:
        parts[path.parent.name].add(path.stem)
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                parts[path.stem].add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                parts[path.stem].add(node.id)
    groups = {path.stem for path in (ROOT / "conf").iterdir()}
    named = set(re.findall(r"`([a-z_]+)\.([A-Za-z_]+)`", PAGE.read_text(encoding="utf-8")))
    asked = [(owner, name) for owner, name in named if name not in SUFFIXES and owner not in groups]
    assert [f"{owner}.{name}" for owner, name in asked if name not in parts[owner]] == []


def test_layout_has_every_file_of_the_package():
    """Commands' files are called like their commands; some folders' lines stand for all of their files."""
    text = PAGE.read_text(encoding="utf-8")
    files = [path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"]
    told = [path for path in files if path.parts[0] != "cli" and path.parent.name not in AS_A_WHOLE]
    assert [str(path) for path in told if not re.search(rf"\b{path.stem}\.py\b", text)] == []


def test_rooms_that_make_no_numbers_are_there():
    """A renamed room must not begin to count, so that a logger's new code would flag finished runs."""
    assert [room for room in NOT_NUMBERS if not (PACKAGE / room).exists()] == []


def test_wiring_counts_among_the_sources_of_a_run():
    """A renamed file must not drop out of what a run's numbers come from."""
    assert set(WIRING) <= set(code_digests())


def test_refusals_are_asserted():
    """`one_line` only returns whether a command refused its input: alone in a line it checks nothing."""
    lost = [
        f"{path.name}:{statement.lineno}"
        for path in Path(__file__).parent.rglob("*.py")
        for statement in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(statement, ast.Expr) and ast.unparse(statement).startswith("one_line(")
    ]
    assert lost == []
