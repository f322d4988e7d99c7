"""Remarks on data before a run, and warnings in its manifest for tables."""

from types import SimpleNamespace
from unittest import mock

from memmlp.motion.preparing.amass_names import S2_TEST, S2_TRAIN
from memmlp.training import request


def warnings(clips: list[SimpleNamespace], name: str = "mine", part: dict | None = None, **facts) -> dict:
    whole = {"coverage": SimpleNamespace(is_complete=True), "listed": {"CMU": 1}, "split": {}, "unusual": {}}
    manifest = SimpleNamespace(clips=clips, **(whole | facts))
    return request.collect_data_warnings(
        {"data": {"name": name, "split": part or {}}}, SimpleNamespace(manifest=manifest)
    )


def test_a_part_of_the_data_or_of_a_protocol_is_told():
    """A protocol with a part of its training clips is not the protocol, and says so."""
    for whole, fraction, words in (
        (True, None, None),
        (True, 1.0, None),
        (True, 0.125, "s1, 12.5 % of its training groups"),
        (False, None, "s1, 7 of 8"),
        (False, 0.5, "s1, 7 of 8, 50 % of its training groups"),
    ):
        part = {} if fraction is None else {"train_fraction": fraction}
        coverage = mock.MagicMock(is_complete=whole, __str__=lambda _: "7 of 8")
        found = warnings([], "s1", part, coverage=coverage, interpolation="lines")
        assert found["partial"] == words
    for name, listed, clips, words in (
        ("amass_s1", ["CMU", "BMLrub", "HDM05"], ["CMU/1/a"], None),
        ("amass_s1", ["CMU"], ["CMU/1/a"], "1 of 3 subsets (without BioMotionLab_NTroje, MPI_HDM05)"),
        ("amass_s3", [], [f"{name}/1/a" for name in (*S2_TRAIN, *S2_TEST, "DanceDB")], None),
        ("amass_s3", [], ["x/KIT/1/a", "CMU/1/a"], "2 of 14 subsets (without MPI_Limits, "),
        ("amass_s2", ["CMU"], ["CMU/1/a"], None),
        ("mocap", [], ["CMU/1/a"], None),
    ):
        facts = {"listed": dict.fromkeys(listed, 1), "left_out": {}, "groups": {one: one for one in clips}}
        found = warnings([], name, interpolation="lines", **facts)["partial"]
        assert found.startswith(f"{name}, {words}") if words else found is None
