"""Sweep files: what they mean, and the one-line errors about what they must not hold."""

from dataclasses import replace
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.definition import load_sweep_copy, save_sweep_copy
from memmlp.sweep.sweep_file import parse_sweep

VARIANTS = {"full": [], "none": {"overrides": ["memory=none"], "paper": {"MPJPE": 4.13}}}


def test_runs_are_variants_by_seeds_with_base_and_difference():
    sweep = parse_sweep("s", {"base": ["profile=tiny"], "seeds": [0, 2], "variants": VARIANTS})
    assert [(one.label, sweep.get_seeds(one), sweep.merge_overrides(one)) for one in sweep.variants] == [
        ("full", (0, 2), ("profile=tiny",)),
        ("none", (0, 2), ("profile=tiny", "memory=none")),
    ]


def test_the_command_line_stands_over_the_base_and_beside_the_variant():
    content = {"base": ["model.depth=8"], "variants": {"wide": ["model.width=10"], "base": []}}
    sweep = parse_sweep("s", content).with_overrides(["model.depth=4", "optim.lr=1"])
    assert set(sweep.merge_overrides(sweep.variants[0])) == {"model.width=10", "model.depth=4", "optim.lr=1"}
    assert set(sweep.merge_overrides(sweep.variants[1])) == {"model.depth=4", "optim.lr=1"}


def test_a_key_that_a_variant_sets_is_refused_on_the_command_line():
    """The variant's own value would win, and the override would be lost silently."""
    content = {"variants": {"two": ["memory.layers=[2]"], "no hand": ["hand=off"], "all": []}}
    for override in ("memory.layers=[2]", "+memory.layers=[9]", "~hand"):
        with pytest.raises(InputError, match=r"variant '(two|no hand)' of sweep s already sets"):
            parse_sweep("s", content).with_overrides(["profile=tiny", override])
    content["variants"]["two"] = ["memory.layers=null"]
    sweep = parse_sweep("s", content).with_overrides(["memory.layers=[9]"])
    assert [sweep.merge_overrides(one)[-1] for one in sweep.variants[::2]] == [
        "memory.layers=null",
        "memory.layers=[9]",
    ]
    content["variants"]["two"] = content["variants"]["no hand"] = {"overrides": None}  # the paper's rows
    assert parse_sweep("s", content).with_overrides(["~hand"]).command_line == ("~hand",)


@pytest.mark.parametrize(
    ("words", "seeds"),
    [(["seed=5,6,7", "profile=tiny"], (5, 6, 7)), (["++seed=7"], (7,)), (["+seed=7"], (7,))],
)
def test_seeds_of_the_command_line_replace_the_files(words: list[str], seeds: tuple[int, ...]):
    sweep = parse_sweep("s", {"seeds": [0, 1], "variants": VARIANTS}).with_overrides(words)
    assert (sweep.seeds, sweep.command_line) == (seeds, tuple(words[1:]))


def test_keys_that_no_sweep_takes_are_refused():
    sweep = parse_sweep("s", {"seeds": [0], "variants": VARIANTS})
    for override in ("paths.outputs=elsewhere", "save_predictions=all"):
        with pytest.raises(InputError, match=override.partition("=")[0]):
            sweep.with_overrides(["profile=tiny", override])


def test_axes_are_a_grid_over_every_variant():
    axes = {"model.frames": [11, 21], "memory.layers": [[2], [2, 4]], "seed": [3, 4]}
    sweep = parse_sweep("s", {"variants": {"a": ["loss=manual"]}, "axes": axes})
    assert sweep.seeds == (3, 4)
    assert len(sweep.variants) == 4
    assert sweep.variants[1].label == "a, model.frames=11, memory.layers=[2,4]"
    assert sweep.variants[1].overrides == ("loss=manual", "model.frames=11", "memory.layers=[2,4]")
    printed = parse_sweep("s", {"variants": {"theirs": {"overrides": None}, "a": []}, "axes": axes})
    assert [variant.label for variant in printed.variants if variant.overrides is None] == ["theirs"]
    assert len(printed.list_runnable()) == 4
    seeds = parse_sweep("s", {"axes": {"seed": [5, 6]}})
    assert [(variant.label, variant.overrides) for variant in seeds.variants] == [("base", ())]
    assert seeds.seeds == (5, 6)
    alone = parse_sweep("s", {"axes": {"model.frames": [11, 21]}})
    assert [variant.label for variant in alone.variants] == ["model.frames=11", "model.frames=21"]


def test_a_list_of_grids_gives_each_of_their_cells_once():
    variants = {"full": [], "none": {"overrides": ["memory=none"], "against": "full"}}
    axes = [{"a": [1, 2, 2], "b": [3]}, {"b": [3, 4], "a": [1]}]
    sweep = parse_sweep("s", {"variants": variants, "axes": axes})
    cells = [variant.cell for variant in sweep.variants[:3]]
    assert (cells, len(sweep.variants)) == ([("a=1", "b=3"), ("a=2", "b=3"), ("b=4", "a=1")], 6)
    assert sweep.variants[4].label == "none, a=2, b=3"
    assert sweep.find_control(sweep.variants[4]) == "full, a=2, b=3"
    assert (sweep.variants[4].series, sweep.variants[4].own_overrides) == ("none", ("memory=none",))
    first = parse_sweep("s", {"variants": variants, "axes": axes[0]}).variants
    assert first == sweep.variants[:2] + sweep.variants[3:5]


CONTENT = {
    "title": "Mine", "notes": ["of two variants"], "base": ["data=synthetic"], "control": "none",
    "variants": {"none": ["memory=none"], "gru": ["memory=gru"]},
}  # fmt: skip


def test_what_is_read_is_what_was_kept(tmp_path: Path):
    sweep = parse_sweep("mine", CONTENT)
    changed = replace(
        sweep.with_overrides(["seed=4,5", "optim.lr=0.1"]),
        variants=(*sweep.variants[1:], replace(sweep.variants[0], series="a", cell=("b=1", "c=2"))),
    )
    assert load_sweep_copy(tmp_path) is None
    for each in (sweep, changed):
        save_sweep_copy(each, tmp_path)
        assert load_sweep_copy(tmp_path) == each
