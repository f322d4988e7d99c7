"""Conditions on runs: what they mean, and one line where they mean nothing."""

import contextlib
from pathlib import Path
from typing import Any

import pytest
from begun_runs import begun
from hypothesis import given
from hypothesis import strategies as st

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.runs.lookup import add_tags
from memmlp.runs.query import build_record, list_differing_keys, parse_query

ONE = {
    "memory": "gru", "seed": 1, "optim.lr": 1e-3, "memory.layers": [2, 4], "stream.MPJPE": 6.25,
    "tag": ("good",), "note": "two words", "force": False, "vqvae.epochs": None,
    "started": "2026-01-02T03:04:05+00:00",
}  # fmt: skip


def holds(text: str) -> bool:
    return parse_query(text).match_records([ONE])[0]


HOLDING = [
    "memory=gru", "memory==gru", "memory!=vq", "memory=gru and stream.MPJPE<6.3", "seed=1", "seed=1.0",
    "optim.lr=1e-3", "optim.lr<=0.001", "memory.layers=[2,4]", 'memory.layers="[2, 4]"', "tag=good",
    "tag!=bad", 'note="two words"', "force=false", "force=False", "vqvae.epochs=null", "memory=vq or seed=1",
    "memory=vq and seed=2 or seed=1", "seed=1 or memory=vq and seed=2", "started>2026-01-01",
    "seed>0 and seed<2", "stream.MPJPE>=6.25",
]  # fmt: skip


NOT_HOLDING = [
    "memory=vq", "memory!=gru", "seed=2", "force!=False", "force=True", "seed<1", "tag=bad", "tag!=good",
    "memory=vq and seed=1 or seed=2", "vqvae.epochs<5", "vqvae.epochs>=0", "force>0", "note=two",
]  # fmt: skip


def test_conditions_hold_or_not():
    assert [text for text in HOLDING if not holds(text)] == []
    assert [text for text in NOT_HOLDING if holds(text)] == []


def test_what_a_run_does_not_have_is_neither_smaller_nor_larger():
    assert parse_query("a<1 or a>=1").match_records([{"a": 0}, {"b": 0}]) == [True, False]


WRONG = [
    ("", "a comparison, but found the end"), ("memory", "a comparison"), ("memory=", "a comparison"),
    ("memory=gru or or seed=1", "a comparison, but found 'or seed=1'"),
    ("memory gru", "but found 'memory gru'"), ("seed=1 and", "but found the end"),
    ("status=running", "training, evaluating"), ("seed<many", "expected a number"),
    ("seed=<", "but found 'seed=<'"), ('note="open', "expected a comparison"),
    ("memory=gru seed=1", "but found 'seed=1'"), ("or=1", "a comparison"),
]  # fmt: skip


def test_what_is_no_condition_is_one_line():
    for text, words in WRONG:
        with pytest.raises(InputError) as error:
            parse_query(text)
        assert words in str(error.value)
        assert str(error.value).startswith("--where '")


@given(st.text(alphabet='ab1.<>=!()" andort', max_size=30))
def test_any_text_is_a_condition_or_one_line(text: str):
    with contextlib.suppress(InputError):
        parse_query(text).condition(ONE)


@pytest.mark.parametrize("own", [float("nan"), "nan"])
def test_a_network_that_diverged_fulfils_no_comparison(own: float | str, tmp_path: Path):
    """Files hold NaN as a word, which as a text is larger than any number."""
    one = measured(tmp_path, own)
    for text in ("<1", "<=1", ">1", ">=1", "=1", "=nan", "<nan", ">nan"):
        assert parse_query(f"stream.MPJPE{text}").match_records([one]) == [False]
    assert parse_query("stream.MPJPE!=1").match_records([one]) == [True]
    infinite = measured(tmp_path / "other", float("inf"))
    assert parse_query("stream.MPJPE>1e300").match_records([infinite]) == [True]
    assert parse_query("stream.MPJPE<6").match_records([infinite]) == [False]


def measured(folder: Path, value: float | str) -> dict[str, Any]:
    run = begun(folder, {"seed": 0})
    write_json(run.results_path, {"stream": {"rotation": {"MPJPE": value}}})
    return dict(build_record(run))


def test_a_run_may_be_asked_for_slots_results_and_facts(tmp_path: Path):
    run = begun(tmp_path, {"seed": 3, "memory": {"name": "gru", "layers": [2]}})
    write_json(run.results_path, {"stream": {"rotation": {"MPJPE": 6.5}, "position": {"MPJPE": 7.0}}})
    add_tags(run, ["good"])
    for text in (
        "memory=gru", "memory.layers=[2]", "stream.MPJPE=6.5", "stream.position.MPJPE=7", "tag=good",
        "status=interrupted", f"id={run.id}", "stream.rotation.MPJPE<7",
    ):  # fmt: skip
        assert parse_query(text).match_records([build_record(run)]) == [True], text


def test_the_keys_that_differ_without_neutral_ones():
    """One option's keys are told by its name, until two runs have that option with other values."""
    first = {"seed": 0, "paths": {"outputs": "a"}, "memory": {"name": "vq", "width": 5, "codes": 3}}
    second = {"seed": 0, "paths": {"outputs": "b"}, "memory": {"name": "gru", "width": 6}}
    assert list_differing_keys([first, second]) == ["memory", "memory.width"]
    assert list_differing_keys([first, first]) == []
    vq, none, other = ({"memory": one} for one in (
        {"name": "vq", "layers": [2]}, {"name": "none"}, {"name": "vq", "layers": [2, 4]}
    ))  # fmt: skip
    assert list_differing_keys([vq, none]) == ["memory"]
    assert list_differing_keys([vq, none, other]) == ["memory", "memory.layers"]
    roots = [{"data": {"name": "mine", "root": root}, "force": root == "a"} for root in "ab"]
    assert list_differing_keys(roots, ["0", "1"]) == ["data.root"]
