"""What a kept plan depends on. (What it is used for is in tests/cli/test_sweep.)"""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.config.compose_plan import _stamp, find_sweep
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


@pytest.mark.parametrize(
    ("content", "words", "said"),
    [
        (
            "arms: {a: [], b: [experiment=no_memory]}",
            ["memory=gru"],
            "sweep s, arm 'b': experiment=no_memory sets memory, and memory=gru beside it would win",
        ),
        (
            "base: [memory=gru]\narms: {a: [], b: [experiment=no_memory]}",
            [],
            "memory=gru beside it would win",
        ),
        (
            "arms: {a: [], b: [experiment=paper]}",
            ["data.weighting=frames"],
            "sets data.weighting, and",
        ),
        (
            "base: [experiment=paper]\narms: {a: [], b: [experiment=no_memory]}",
            [],
            "experiment=no_memory would replace experiment=paper; allowed is experiment=[paper,no_memory]",
        ),
        ("arms: {a: [memory=gru]}\naxes: {experiment: [no_memory]}", [], "memory=gru beside it"),
        ("base: [experiment=paper]\narms: {a: [], b: ['experiment=[paper,no_memory]']}", [], None),
        ("base: [memory=gru]\narms: {a: [], b: [experiment=no_memory, memory=none]}", ["optim=muon"], None),
        ("base: [memory=gru]\narms: {a: [], b: [memory=none]}", ["experiment=paper"], None),
    ],
)
def test_nothing_undoes_the_experiment_of_an_arm(
    tmp_path: Path, content: str, words: list[str], said: str | None
):
    """Hydra lets a group on the command line win over an experiment's, and the arm's label would be wrong."""
    path = tmp_path / "s.yaml"
    path.write_text(content)
    if said is None:
        assert find_sweep(str(path), words).command_line == tuple(words)
        return
    with pytest.raises(InputError) as caught:
        find_sweep(str(path), words)
    assert said in str(caught.value)
