"""The sources that make up a run's code version, and asserted refusals."""

import re
from pathlib import Path

from memmlp.runs.environment import NOT_NUMBERS, PACKAGE, WIRING, compute_code_digests


def test_lists_of_sources_name_existing_files():
    """A renamed folder must not begin to count, and a renamed file must not drop out."""
    assert [folder for folder in NOT_NUMBERS if not (PACKAGE / folder).exists()] == []
    assert set(WIRING) <= set(compute_code_digests())


def test_refusals_are_asserted():
    """`one_line` only returns whether a command refused its input, so alone in a line it checks nothing."""
    for path in Path(__file__).parent.rglob("*.py"):
        assert not re.search(r"^ *one_line\(", path.read_text(encoding="utf-8"), re.MULTILINE), path
