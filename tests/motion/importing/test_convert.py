"""Whole imports beside the text of their files, posed by plain NumPy: real families and turned zero poses."""

from __future__ import annotations

import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import own_tree, performed, random_turns, rest_turns, write
from plain_kinematics import bvh_positions, to_world, worst_direction, worst_distance

from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.importing.convert import Converted, convert
from memmlp.motion.importing.skeleton_map import SkeletonMap, find_skeleton, load_skeleton, shipped_skeletons
from memmlp.motion.synthetic import synthesize_clip

REST = builtin_rest_joints()
DATA = Path(__file__).parents[3] / ".." / "shared" / "data"
CMU = [DATA / "cmu" / name for name in ("salsa/15.bvh", "indian/04.bvh", "martial/03.bvh")]
BANDAI = DATA / "bandai-namco" / "bandai-1.tar.xz"
MM, DEGREES = 1.0, 3.0  # the largest errors that an import may have


def imported(path: Path, chosen: SkeletonMap) -> Converted:
    return convert(read_bvh(path), chosen, REST, name=path.stem)


def check(path: Path, chosen: SkeletonMap, unit: float, up: str) -> Converted:
    """Import a file, and compare what is kept with the file's text."""
    converted = imported(path, chosen)
    npz = path.with_suffix(".npz")
    write_clip(npz, converted.clip)
    first = int(chosen.calibration_frame)
    file = {name: to_world(places[first:], up) for name, places in bvh_positions(path).items()}
    joints = dict(chosen.joints)
    assert worst_direction(npz, file, joints)[0] < DEGREES
    assert worst_distance(npz, file, joints, unit)[0] < MM
    return converted


# The data's own files


@pytest.mark.slow
@pytest.mark.parametrize("path", CMU, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_cmu_as_in_the_file(tmp_path: Path, path: Path) -> None:
    if not path.is_file():
        pytest.skip("CMU's clips are not here")
    copy = write(tmp_path, path.read_bytes())
    chosen = find_skeleton(read_bvh(copy))
    assert check(copy, chosen, 0.01, "y").fidelity.faults == ()


@pytest.mark.slow
def test_bandai_namco_as_in_the_file(tmp_path: Path) -> None:
    if not BANDAI.is_file():
        pytest.skip("Bandai-Namco's clips are not here")
    with tarfile.open(BANDAI) as archive:
        members = [member for _, member in zip(range(40), archive, strict=False) if member.isfile()]
        paths = [write(tmp_path, archive.extractfile(m).read(), Path(m.name).name) for m in members[::13]]  # type: ignore[union-attr]
    assert len(paths) >= 3
    for path in paths:
        assert check(path, load_skeleton("bandai_namco"), 0.01, "y").fidelity.faults == ()


# Zero poses turned at random


@pytest.fixture(scope="module")
def walking() -> Clip:
    return synthesize_clip("walking", 1, seconds=1.5)


def random_zero_poses() -> list[tuple[str, int]]:
    """Each skeleton twice; once where the file of the skeleton gives the zero pose, which has no chance."""
    given = {name for name in shipped_skeletons() if isinstance(load_skeleton(name).rest, dict)}
    return [(name, seed) for name in shipped_skeletons() for seed in ([1] if name in given else [1, 2])]


@pytest.mark.parametrize(("skeleton", "seed"), random_zero_poses())
def test_any_zero_pose_is_as_in_the_file(tmp_path: Path, walking: Clip, skeleton: str, seed: int) -> None:
    chosen = load_skeleton(skeleton)
    sample = own_tree(chosen)
    given = isinstance(chosen.rest, dict)
    turns = rest_turns(chosen, sample) if given else random_turns(sample, seed)
    path = write(tmp_path, performed(chosen, walking, turns=turns).text())
    converted = check(path, chosen, chosen.unit or 0.01, chosen.up or "y")
    assert converted.fidelity.faults == ()
    assert ("frame" in converted.stance_words) == (not given)


@pytest.mark.parametrize("skeleton", shipped_skeletons())
def test_the_zero_pose_does_not_matter(tmp_path: Path, walking: Clip, skeleton: str) -> None:
    """Where both are read from the same frame."""
    chosen = replace(load_skeleton(skeleton), rest=20)
    plain = write(tmp_path, performed(chosen, walking).text(), "plain.bvh")
    turns = random_turns(own_tree(chosen), 5)
    turned = write(tmp_path, performed(chosen, walking, turns=turns).text(), "turned.bvh")
    expected, found = imported(plain, chosen).clip, imported(turned, chosen).clip
    np.testing.assert_allclose(found.trans, expected.trans, atol=1e-6)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-5)
