"""What a kept plan depends on. (What it is used for is in tests/cli/test_sweep.)"""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.config.compose_plan import _stamp
from memmlp.sweep.sweep_file import parse_sweep


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["optim.lr=1e-3"], True),
        (["optim.lr=${oc.env:MYLR}"], False),
        (["hydra.searchpath=[file://own]", "experiment=mine"], False),
    ],
    ids=str,
)
def test_a_plan_that_depends_on_the_environment_or_on_other_folders_is_made_anew(
    words: list[str], kept: bool, tmp_path: Path
):
    for sweep in (
        parse_sweep("s", {"arms": {"a": words}}),
        parse_sweep("s", {"base": words, "arms": {"a": []}}),
    ):
        assert (_stamp(sweep, tmp_path) == _stamp(sweep, tmp_path)) == kept
