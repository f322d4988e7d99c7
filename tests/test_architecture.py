"""The sources that make up a run's code version, and asserted refusals."""

from __future__ import annotations

import ast
from pathlib import Path

from memmlp.runs.environment import NOT_NUMBERS, PACKAGE, WIRING, code_digests


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
