"""Remarks on data before a run, and warnings in its manifest for tables."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from memmlp.motion.clip import Skipped
from memmlp.motion.preparing.amass_names import S2_TEST, S2_TRAIN
from memmlp.training import data_remarks


def test_remarks_count_the_clips_and_name_the_first():
    bad = Skipped("b.npz", "NaN in frame 3")
    assert data_remarks.skipped_remark([]) is data_remarks.unusual_remark({}) is None
    for word in ("2 files", "b.npz (NaN in frame 3)", "data.strict"):
        assert word in str(data_remarks.skipped_remark([bad, replace(bad, file="c.npz")]))
    odd = {"a/1": "Z is not up", "a/2": "Z is not up", "b": "the pelvis is at z = 20 m", "c": "Z is not up"}
    for word in ("4 clips", "a/1 (Z is not up), a/2, b", "memmlp data inspect"):
        assert word in str(data_remarks.unusual_remark(odd))


@pytest.mark.parametrize(
    ("groups", "remark"),
    [("abb", "test clips: 3, in groups: 2"), ("aa", "test clips: 2, in groups: 1, too")],
)
def test_a_single_group_of_test_clips_is_too_few(groups: str, remark: str):
    clips = [SimpleNamespace(split="test", group=group) for group in groups]
    found = data_remarks.tested_clips_remark([SimpleNamespace(split="train", group="c"), *clips])
    assert found.startswith(remark)
    assert ("data.split.test" in found) == ("too" in remark)


def test_unusual_test_clips_are_a_fact_of_the_run():
    parts = {"a": "test", "b": "test", "c": "train"}
    clips = [SimpleNamespace(name=name, split=part, fps=60.0, group="tied") for name, part in parts.items()]
    odd = {"b": "Z is not up", "c": "knees bend backwards"}
    said = "1 of 2 test clips are unusual, first b (Z is not up)"
    assert data_remarks.unusual_tests_remark(odd, clips[:2]) == said
    assert data_remarks.unusual_tests_remark(odd, clips[:1]) is None
    known = {"coverage": SimpleNamespace(whole=True), "listed": {"CMU": 1}, "split": {}}
    data = SimpleNamespace(manifest=SimpleNamespace(clips=clips, unusual=odd, **known))
    config = {"data": {"name": "mine", "split": {}}}
    assert data_remarks.data_warnings(config, data)["unusual"] == said


def test_people_in_training_and_in_test_are_a_fact_of_the_run():
    parts = {"CMU/01/a": "train", "CMU/01/b": "test"}
    clips = [SimpleNamespace(name=name, split=part, fps=60.0, group="tied") for name, part in parts.items()]
    known = {"coverage": SimpleNamespace(whole=True), "listed": {"CMU": 1}, "unusual": {}}
    config = {"data": {"name": "mine", "split": {}}}
    for split, said in (({}, "clips of CMU/01 are in training and in test"), ({"kind": "lists"}, "")):
        data = SimpleNamespace(manifest=SimpleNamespace(clips=clips, split=split, **known))
        found = data_remarks.data_warnings(config, data)
        assert (found["divided"] or "").startswith(said)
        assert bool(found["divided"]) == bool(said)
        assert found["partial"] is found["resampled"] is found["unusual"] is None


def test_clips_that_were_recorded_at_a_lower_rate_are_said():
    rates = {"a": 30.0, "b": 30.0, "c": 60.0, "d": 59.94, "e": 120.0, "f": 100.0}
    clips = [SimpleNamespace(name=name, split="test", fps=fps) for name, fps in rates.items()]
    clips.append(SimpleNamespace(name="g", split="train", fps=25.0))
    lines, splines = SimpleNamespace(interpolation="lines"), SimpleNamespace(interpolation="splines")
    said = data_remarks.low_rates_remark(lines, clips, "clips")
    assert said.startswith("3 of 7 clips were recorded at 25 to 30 Hz and are interpolated linearly")
    assert data_remarks.low_rates_remark(lines, clips[2:6], "clips") is None
    assert data_remarks.low_rates_remark(splines, clips, "clips") is None
    whole = SimpleNamespace(whole=True)
    known = {"coverage": whole, "interpolation": "lines", "listed": {"CMU": 1}, "unusual": {}, "split": {}}
    for clip in clips:
        clip.group = "tied"
    manifest = SimpleNamespace(clips=clips, **known)
    config = {"data": {"name": "mine", "split": {}}}
    said = data_remarks.data_warnings(config, SimpleNamespace(manifest=manifest))["resampled"]
    assert said.startswith("2 of 6 test clips were recorded at 30 Hz and are interpolated linearly")


@pytest.mark.parametrize(
    ("whole", "fraction", "words"),
    [
        (True, {}, None),
        (True, {"train_fraction": 1.0}, None),
        (True, {"train_fraction": 0.125}, "s1, 12.5 % of its training groups"),
        (False, {}, "s1, 7 of 8"),
        (False, {"train_fraction": 0.5}, "s1, 7 of 8, 50 % of its training groups"),
    ],
)
def test_a_part_of_the_data_is_told(whole, fraction, words):
    """A protocol with a part of its training clips is not the protocol, and says so."""

    class Coverage(SimpleNamespace):
        __str__ = lambda self: "7 of 8"  # noqa: E731

    data = SimpleNamespace(manifest=SimpleNamespace(coverage=Coverage(whole=whole), listed={"CMU": 8}))
    config = {"data": {"name": "s1", "split": fraction}}
    assert data_remarks.partial_words(config, data) == words


@pytest.mark.parametrize(
    ("name", "listed", "clips", "words"),
    [
        ("amass_s1", ["CMU", "BMLrub", "HDM05"], ["CMU/1/a"], None),
        ("amass_s1", ["CMU"], ["CMU/1/a"], "1 of 3 subsets (without BioMotionLab_NTroje, MPI_HDM05)"),
        ("amass_s3", [], [f"{name}/1/a" for name in (*S2_TRAIN, *S2_TEST, "DanceDB")], None),
        ("amass_s3", [], ["x/KIT/1/a", "CMU/1/a"], "2 of 14 subsets (without MPI_Limits, "),
        ("amass_s2", ["CMU"], ["CMU/1/a"], None),
        ("mocap", [], ["CMU/1/a"], None),
    ],
)
def test_a_protocol_without_some_of_its_subsets_is_told(name, listed, clips, words):
    """Lists of one subset, or its folder alone, are whole in themselves, and no protocol."""
    every = {"coverage": SimpleNamespace(whole=True), "listed": dict.fromkeys(listed, 1)}
    every |= {"left_out": {}, "groups": {clip: clip for clip in clips}}
    data = SimpleNamespace(manifest=SimpleNamespace(**every))
    found = data_remarks.partial_words({"data": {"name": name, "split": {}}}, data)
    assert found.startswith(f"{name}, {words}") if words else found is None
