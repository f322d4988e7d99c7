"""Results kept with the code: what is written, read again, merged and refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Memmlp
from fake_table import cell as find_cell

from memmlp.cli.results import make_kept_table
from memmlp.common.errors import InputError
from memmlp.report.joined_results import join_results
from memmlp.report.kept_results import (
    KeptResults,
    format_results,
    load_kept_results,
    save_results,
    shorten_paths,
)
from memmlp.report.tables.build_table import make_table
from memmlp.sweep.definition import Sweep


def test_kept_results_make_the_runs_table(sweep: Sweep, kept: KeptResults, tmp_path: Path):
    save_results(tmp_path / "kept.json", kept)
    read = load_kept_results(tmp_path / "kept.json")
    assert (read.sweep, read.overrides, read.command) == (
        "table14", ("data=mocap",), "memmlp sweep table14 data=mocap",
    )  # fmt: skip
    tables = [make_table(sweep, one.select_runs(sweep)) for one in (kept, read)]
    assert tables[0].flags == tables[1].flags
    for before, after in zip(tables[0].rows, tables[1].rows, strict=True):
        for mode in tables[0].modes:
            for metric, cell in before.cells[mode].items():
                again = after.cells[mode][metric]
                assert again.mean == pytest.approx(cell.mean, rel=1e-5)
                if cell.effect:
                    assert again.effect.low == pytest.approx(cell.effect.low, rel=1e-4, abs=1e-4)
                    assert (again.effect.verdict, again.effect.groups) == (cell.effect.verdict, 6)
    assert [run.origin for run in read.all_runs] == [run.origin for run in kept.all_runs]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_run_that_diverged_is_kept(sweep: Sweep, kept: KeptResults, tmp_path: Path, number: float):
    """It is no run less: its variant has no mean, and no other variant's looks better for it."""
    run = kept.runs["2"][1]
    for errors in (run.means, *run.clips.values()):
        errors["stream"]["combined"]["MPJPE"] = number
    save_results(tmp_path / "kept.json", kept)
    for one in (kept, load_kept_results(tmp_path / "kept.json")):
        cell = find_cell(make_table(sweep, one.select_runs(sweep)), "2", "MPJPE")
        assert sorted(cell.values) == [0, 1, 2]
        assert not np.isfinite(cell.mean)


def test_kept_results_that_were_edited_are_rejected(kept: KeptResults, tmp_path: Path):
    text = format_results(kept)
    number = re.search(r'"MPJPE": \[(\S+),', text)
    edited = text.replace(number[1], "9.99", 1)
    for content in (edited, re.sub(r',\n "digest": "\w+"', "", edited)):
        (tmp_path / "kept.json").write_text(content)
        with pytest.raises(InputError, match="edited by hand"):
            load_kept_results(tmp_path / "kept.json")


def test_kept_results_have_the_same_bytes(kept: KeptResults, tmp_path: Path):
    """The bytes don't depend on the order of the runs, or on being read and written again."""
    turned = {label: dict(reversed(runs.items())) for label, runs in reversed(kept.runs.items())}
    assert format_results(replace(kept, runs=turned)) == format_results(kept)
    save_results(tmp_path / "kept.json", kept)
    assert format_results(load_kept_results(tmp_path / "kept.json")) == format_results(kept)
    assert max(map(len, format_results(kept).splitlines())) < 1000  # changes can be read


def test_results_with_further_runs_are_not_replaced(kept: KeptResults):
    fewer = replace(kept, runs={label: {0: runs[0]} for label, runs in kept.runs.items()})
    kept.check_can_replace(fewer)
    with pytest.raises(InputError, match=r"not found: '2' seed 1 \(run \w+\), '2' seed 2 \(run"):
        fewer.check_can_replace(kept)
    other = replace(kept.runs["2"][1], id="other")  # of other data, or trained before an edit
    changed = replace(kept, runs={**kept.runs, "2": {**kept.runs["2"], 1: other}})
    with pytest.raises(InputError, match=r"not found: '2' seed 1 \(run other\)$"):
        kept.check_can_replace(changed)
    costs = replace(other, means={}, clips={})
    kept.check_can_replace(replace(kept, runs={**kept.runs, "2": {**kept.runs["2"], 1: costs}}))
    split = replace(kept, splits=("", "data.split.seed=7"))
    with pytest.raises(InputError, match=r"again with data\.split\.seed=7"):
        kept.check_can_replace(split)
    with pytest.raises(InputError, match="data=synthetic"):
        kept.check_can_replace(replace(kept, overrides=("data=synthetic",)))


def test_kept_results_hold_no_path_of_a_machine():
    for word, kept in {
        "hydra.searchpath=[file:///me/conf, file://near, file:///x/b]":
            "hydra.searchpath=[file://.../conf, file://near, file://.../b]",
        "data.root=/home/me/data/cmu": "data.root=.../cmu",
        "data.root=outputs/data/cmu": "data.root=outputs/data/cmu",
        "+data.body=/x/model.npz": "+data.body=.../model.npz",
    }.items():  # fmt: skip
        assert shorten_paths([word]) == (kept,)


@pytest.mark.parametrize("text", ["{", "[]", '{"sweep": "a"}', '{"runs": {"a": {}}}'])
def test_damaged_results_are_one_line(tmp_path: Path, text: str):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match="memmlp results save"):
        load_kept_results(path)


def test_results_of_a_variant_with_other_overrides_are_rejected(sweep: Sweep, kept: KeptResults):
    """Otherwise its numbers would stand under a label that means something else now."""
    other = [replace(one, overrides=("memory=gru",)) if one.label == "2" else one for one in sweep.variants]
    with pytest.raises(InputError, match="variant '2': overrides changed from"):
        kept.select_runs(replace(sweep, variants=tuple(other)))


def select_seeds(kept: KeptResults, *seeds: int) -> KeptResults:
    runs = {label: {seed: runs[seed] for seed in seeds} for label, runs in kept.runs.items()}
    return replace(kept, runs=runs)


def test_results_of_several_seeds_are_joined(kept: KeptResults):
    joined = join_results([select_seeds(kept, 1, 2), select_seeds(kept, 0, 1)])
    assert format_results(joined) == format_results(kept)
    other = replace(kept.runs["2"][1], id="other")
    twice = replace(kept, runs={"2": {1: other}})
    with pytest.raises(InputError, match="'2' seed 1: has two runs"):
        join_results([kept, twice])
    with pytest.raises(InputError, match=f"must be '{kept.command}'"):
        join_results([kept, replace(kept, overrides=("data=synthetic",))])
    run = kept.runs["2"][1]
    other = replace(run, origin=replace(run.origin, data="other"))
    with pytest.raises(InputError, match=f"'2': run {run.id} has other data than run"):
        join_results([select_seeds(kept, 0), replace(kept, runs={"2": {1: other}})])


def test_splits_are_pooled_to_one_table_of_all_their_clips(kept: KeptResults, memmlp: Memmlp, tmp_path: Path):
    """Means are over all clips; a clip of two splits counts once, with its mean error."""
    save_results(tmp_path / "kept.json", select_seeds(kept, 0, 1))
    first = load_kept_results(tmp_path / "kept.json")
    moved = {label: {} for label in ("2", "2, 4", "2, 4, 6, 8")}
    for label, runs in moved.items():
        for seed, run in first.runs[label].items():
            clips = {
                f"new/{name}" if i else name: errors for i, (name, errors) in enumerate(run.clips.items())
            }
            shared = next(iter(clips))
            clips[shared] = {
                "stream": {"combined": dict.fromkeys(clips[shared]["stream"]["combined"], 100.0)}
            }
            means = {"stream": {"combined": run.means["stream"]["combined"]}}
            runs[seed] = replace(run, id=f"{run.id}b", clips=clips, means=means)
    del moved["2"][0]
    second = replace(first, overrides=(*first.overrides, "data.split.seed=7"), runs=moved)
    save_results(tmp_path / "data/pooled.json", join_results([first, second]))
    shown = " ".join(memmlp("results", "show", "pooled", "--folder", str(tmp_path)).out.split())
    assert "splits are pooled: the default split, data.split.seed=7" in shown
    pooled = load_kept_results(tmp_path / "data/pooled.json")
    assert (pooled.splits, pooled.run_count) == (("", "data.split.seed=7"), 10)
    assert pooled.command_for_all_splits == f"{first.command}, and again with data.split.seed=7"
    seeds = {label: [*runs] for label, runs in pooled.runs.items()}
    assert seeds == {"2": [1], "2, 4": [0, 1], "2, 4, 6, 8": [0, 1]}
    run, own = pooled.runs["2, 4"][0], first.runs["2, 4"][0]
    values = list(own.get_clip_values([*own.clips], "stream", "combined", "MPJPE"))
    expected = ((values[0] + 100) / 2 + 2 * sum(values[1:])) / (2 * len(values) - 1)
    assert run.get_value("stream", "combined", "MPJPE") == pytest.approx(expected, rel=1e-5)
    assert pooled.flags == (
        "left out, because runs of a split are missing: '2' seed 0, '2, 4, 6' seed 0, '2, 4, 6' seed 1",
    )
    with pytest.raises(InputError, match="two splits have the same test clips"):
        join_results([first, replace(first, overrides=second.overrides)])
    old = {"2, 4": {0: replace(run, origin=replace(run.origin, precision="bf16"))}}
    with pytest.raises(InputError, match="'2, 4' seed 0: component versions, precision"):
        join_results([first, replace(second, runs=old)])
    with pytest.raises(InputError, match="results that pool the same splits"):
        join_results([pooled, first])
    parts = [select_seeds(replace(pooled, runs={"2, 4": pooled.runs["2, 4"]}), seed) for seed in (0, 1)]
    joined = join_results(parts)
    assert joined.runs == {"2, 4": pooled.runs["2, 4"]}
    table = make_kept_table(replace(joined, variants={"2, 4": joined.variants["2, 4"]}))
    assert table.control == "2, 4"  # the first that is left, since the sweep's control is not
