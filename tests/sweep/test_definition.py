"""Sweep files: what they mean, and the one-line errors about what they must not hold."""

from __future__ import annotations

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.sweep_file import parse_sweep

VARIANTS = {"full": [], "none": {"overrides": ["memory=none"], "paper": {"MPJPE": 4.13}}}


def test_jobs_are_variants_by_seeds_with_base_and_difference():
    sweep = parse_sweep("s", {"base": ["profile=tiny"], "seeds": [0, 2], "variants": VARIANTS})
    assert [(one.label, one.seed, one.overrides) for one in sweep.variant_seeds()] == [
        ("full", 0, ("profile=tiny", "seed=0")),
        ("full", 2, ("profile=tiny", "seed=2")),
        ("none", 0, ("profile=tiny", "memory=none", "seed=0")),
        ("none", 2, ("profile=tiny", "memory=none", "seed=2")),
    ]


def test_the_command_line_stands_over_the_base_and_beside_the_variant():
    content = {"base": ["model.depth=8"], "variants": {"wide": ["model.width=10"], "base": []}}
    sweep = parse_sweep("s", content).with_overrides(["model.depth=4", "optim.lr=1"])
    assert set(sweep.all_overrides(sweep.variants[0])) == {"model.width=10", "model.depth=4", "optim.lr=1"}
    assert set(sweep.all_overrides(sweep.variants[1])) == {"model.depth=4", "optim.lr=1"}


@pytest.mark.parametrize("word", ["memory.layers=[2]", "+memory.layers=[9]", "~hand"])
def test_a_key_that_an_variant_sets_is_refused_on_the_command_line(word: str):
    """The variant's own value would stand, and the override would be lost without a word."""
    content = {"variants": {"two": ["memory.layers=[2]"], "no hand": ["hand=off"], "all": []}}
    with pytest.raises(
        InputError, match=r"variant '(two|no hand)' of sweep s sets .* itself; allowed are keys"
    ):
        parse_sweep("s", content).with_overrides(["profile=tiny", word])
    content["variants"]["two"] = content["variants"]["no hand"] = {
        "overrides": None
    }  # rows of the paper alone
    assert parse_sweep("s", content).with_overrides([word]).command_line == (word,)


def test_seeds_of_the_command_line_replace_the_files():
    sweep = parse_sweep("s", {"seeds": [0, 1], "variants": VARIANTS}).with_overrides(
        ["seed=5,6,7", "profile=tiny"]
    )
    assert sweep.seeds == (5, 6, 7)
    assert sweep.command_line == ("profile=tiny",)


def test_the_outputs_folder_is_an_option_and_no_override():
    sweep = parse_sweep("s", {"seeds": [0], "variants": VARIANTS})
    with pytest.raises(InputError, match=r"paths\.outputs: allowed here is --outputs"):
        sweep.with_overrides(["profile=tiny", "paths.outputs=elsewhere"])


@pytest.mark.parametrize("word", ["++seed=7", "+seed=7"])
def test_a_seed_that_is_added_is_one(word: str):
    assert parse_sweep("s", {"seeds": [0, 1], "variants": VARIANTS}).with_overrides([word]).seeds == (7,)


def test_runs_of_a_sweep_do_not_write_predictions_over_each_other():
    sweep = parse_sweep("s", {"seeds": [0], "variants": VARIANTS})
    with pytest.raises(InputError, match="save_predictions: a sweep's runs would write over each other's"):
        sweep.with_overrides(["save_predictions=all"])


def test_an_axis_over_what_an_variant_sets_is_refused():
    """Its values would win, and the variant's label be wrong."""
    content = {"variants": {"slow": ["optim.lr=1e-4"], "none": []}, "axes": {"optim.lr": [1e-3, 2e-3]}}
    with pytest.raises(InputError, match=r"variant 'slow': sets optim\.lr, which is an axis; allowed is one"):
        parse_sweep("s", content)


def test_axes_are_a_grid_over_every_variant():
    axes = {"model.frames": [11, 21], "memory.layers": [[2], [2, 4]], "seed": [3, 4]}
    sweep = parse_sweep("s", {"variants": {"a": ["loss=manual"]}, "axes": axes})
    assert sweep.seeds == (3, 4)
    assert len(sweep.variants) == 4
    assert sweep.variants[1].label == "a, model.frames=11, memory.layers=[2,4]"
    assert sweep.variants[1].overrides == ("loss=manual", "model.frames=11", "memory.layers=[2,4]")
    printed = parse_sweep("s", {"variants": {"theirs": {"overrides": None}, "a": []}, "axes": axes})
    assert [variant.label for variant in printed.variants if variant.overrides is None] == ["theirs"]
    assert len(printed.runnable()) == 4
    seeds = parse_sweep("s", {"axes": {"seed": [5, 6]}})
    assert [(variant.label, variant.overrides) for variant in seeds.variants] == [("base", ())]
    assert seeds.seeds == (5, 6)
    alone = parse_sweep("s", {"axes": {"model.frames": [11, 21]}})
    assert [variant.label for variant in alone.variants] == ["model.frames=11", "model.frames=21"]


def test_a_list_of_grids_gives_each_of_their_cells_once():
    variants = {"full": [], "none": {"overrides": ["memory=none"], "against": "full"}}
    axes = [{"a": [1, 2, 2], "b": [3]}, {"b": [3, 4], "a": [1]}]
    sweep = parse_sweep("s", {"variants": variants, "axes": axes})
    assert [variant.cell for variant in sweep.variants[:3]] == [
        ("a=1", "b=3"),
        ("a=2", "b=3"),
        ("b=4", "a=1"),
    ]
    assert len(sweep.variants) == 6
    assert sweep.variants[4].label == "none, a=2, b=3"
    assert sweep.control_of(sweep.variants[4]) == "full, a=2, b=3"
    assert (sweep.variants[4].series, sweep.variants[4].own_overrides) == ("none", ("memory=none",))
    assert (
        parse_sweep("s", {"variants": variants, "axes": axes[0]}).variants
        == sweep.variants[:2] + sweep.variants[3:5]
    )
