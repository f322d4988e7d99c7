"""`data verify`: reads what an import keeps, goes on past bad files, names what is worst."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from bvh_samples import performed, refuse, tree, write

from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.importing.fidelity import Fidelity
from memmlp.motion.importing.skeleton_map import load_skeleton
from memmlp.motion.importing.verify_files import Unusable, verify, verify_folder
from memmlp.motion.synthetic import synthesize_clip


def walk(seconds: float = 1.0) -> str:
    chosen = load_skeleton("cmu_daz")
    return performed(chosen, synthesize_clip("walking", 1, seconds=seconds), sample=tree("cmu_daz")).text()


def test_a_right_file_has_no_fault(tmp_path: Path) -> None:
    fidelity = verify(write(tmp_path, walk()))
    assert (fidelity.name, fidelity.skeleton, fidelity.frames) == ("clip.bvh", "cmu_daz", 60)
    assert fidelity.faults == ()
    assert fidelity.mm.value < 0.01
    assert fidelity.degrees.value < 3


def test_verify_reads_the_npz(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def bent(path: Path, name: str) -> Clip:
        clip = read_clip(path, name)
        poses = clip.poses.copy()
        poses[17, 18] += 0.3  # the left elbow
        return replace(clip, poses=poses)

    monkeypatch.setattr("memmlp.motion.importing.verify_files.read_clip", bent)
    fidelity = verify(write(tmp_path, walk()))
    assert (fidelity.mm.where, fidelity.mm.frame) == ("left_wrist", 17)
    assert (fidelity.degrees.where, fidelity.degrees.frame) == ("left_elbow to left_wrist", 17)
    assert len(fidelity.faults) == 2


@pytest.mark.parametrize("told", [None, 30])
def test_the_rate_is_the_one_that_an_import_takes(
    told: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The floor is found from feet that are slow, and how slow they are is said by the rate."""
    kept = []

    def reading(path: Path, name: str) -> Clip:
        kept.append(read_clip(path, name))
        return kept[-1]

    monkeypatch.setattr("memmlp.motion.importing.verify_files.read_clip", reading)
    (tmp_path / "inner").mkdir()
    write(tmp_path / "inner", walk())
    if told:
        (tmp_path / "motion.yaml").write_text(f"fps: {told}")
    [fidelity] = verify_folder(tmp_path)
    assert isinstance(fidelity, Fidelity)
    assert [clip.fps for clip in kept] == [pytest.approx(told or 120)]


def test_verify_goes_on_past_bad_files(tmp_path: Path) -> None:
    for name in ("a", "c/1"):
        write(tmp_path, walk(), f"{name}.bvh")
    write(tmp_path, "HIERARCHY", "b.bvh")
    found = list(verify_folder(tmp_path, skeleton="cmu_daz"))
    assert [row.name for row in found] == ["a.bvh", "b.bvh", "c/1.bvh"]
    assert [type(row) for row in found] == [Fidelity, Unusable, Fidelity]
    assert isinstance(found[1], Unusable)
    assert found[1].reason.startswith("no MOTION")


def test_nothing_to_verify_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "empty", tmp_path / "missing", write(tmp_path, "", "clip.txt")):
        with refuse(source):
            list(verify_folder(source))
    path = write(tmp_path, walk())
    with refuse("skeleton: "):
        list(verify_folder(path, skeleton="none"))
    with refuse("data.body: "):
        list(verify_folder(path, body="none"))
