"""Plausibility: degrees, other units and another axis are refused; whatever people do is not."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.importing.import_folder import ImportSettings, import_folder
from memmlp.motion.plausibility import explain_implausibility, find_faults
from memmlp.motion.synthetic import synthesize_clip

SIDES = {"left": "right", "right": "left"}
OTHER_SIDE = [JOINTS.index("_".join(SIDES.get(word, word) for word in name.split("_"))) for name in JOINTS]
ACTIVITIES = ("walking", "jumping", "sitting")
Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@cache
def motion(activity: str) -> Clip:
    return synthesize_clip(activity, 3, seconds=4)


def turned(clip: Clip, matrix: np.ndarray) -> Clip:
    """The clip in another world: its root and translation turned."""
    poses = clip.poses.copy()
    poses[:, 0] = (Rotation.from_matrix(matrix) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(clip, poses=poses, trans=clip.trans @ matrix.T)


def moved(clip: Clip, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Clip:
    return replace(clip, trans=np.add(clip.trans, [x, y, z]))


def lying(clip: Clip, heading: float = 0.0) -> Clip:
    """The clip's limbs on someone on their back, the head towards a heading (0 is +Y), hardly moving."""
    pose = Rotation.from_euler("z", heading, degrees=True) * Rotation.from_rotvec([0, 0, 0.05])
    poses = clip.poses.copy()
    poses[:, 0] = pose.as_rotvec()
    poses[:, 1:] *= 0.3
    return replace(clip, poses=poses, trans=0.05 * clip.trans + [0.4, 1.7, 0.1])


def faults(clip: Clip) -> str:
    return "; ".join(find_faults(clip))


def test_what_people_do_passes():
    for clip in map(motion, ACTIVITIES):
        for sound in (clip, moved(clip, z=-40.0), moved(clip, z=100.0), moved(clip, 700.0, -300.0)):
            assert explain_implausibility(sound) is None
            assert faults(sound) == ""
    single = replace(clip, poses=clip.poses[:1], trans=clip.trans[:1])
    assert explain_implausibility(single) is None


@pytest.mark.parametrize("heading", [0, 180])
def test_lying_and_crawling_pass_and_are_reported(heading):
    assert explain_implausibility(lying(motion("idling"), heading)) is None
    assert "head" in faults(lying(motion("idling"), heading))
    crawling = lying(motion("walking"), heading)
    along = np.linspace(0, 3, len(crawling))[:, None] * [0.3, 1.0, 0.0]
    assert explain_implausibility(replace(crawling, trans=crawling.trans + along)) is None


def test_a_rate_at_which_hardly_anybody_records_is_reported():
    clip = motion("idling")
    for fps, said in ((12.0, "20 to 500 Hz"), (1000.0, "20 to 500 Hz"), (62.5, "60 Hz")):
        odd = replace(clip, fps=fps)
        assert explain_implausibility(odd) is None
        assert f"the frame rate {fps:g} Hz" in faults(odd)
        assert said in faults(odd)
    assert not any(faults(replace(clip, fps=usual)) for usual in (20.0, 59.94, 60.0, 250.0, 480.0))


def test_jumps_cuts_and_a_frozen_translation_are_reported():
    for activity in ("walking", "running"):
        clip = synthesize_clip(activity, 3, seconds=12)
        assert faults(clip) == ""
        jump, frozen = clip.trans.copy(), clip.trans.copy()
        jump[200, 0] += 1.0
        assert re.search("after frame (199|200)", faults(replace(clip, trans=jump)))
        poses, trans = (np.delete(values, slice(200, 500), 0) for values in (clip.poses, clip.trans))
        assert "after frame 199" in faults(replace(clip, poses=poses, trans=trans))
        frozen[200:260] = frozen[200]
        assert "trans is constant for 59 successive frames" in faults(replace(clip, trans=frozen))
        still = replace(clip, trans=frozen, poses=clip.poses * 0 + clip.poses[0])
        assert re.findall("trans is constant|the pose is constant", faults(still)) == ["the pose is constant"]


def test_held_poses_swapped_sides_and_mirrored_axes_are_reported():
    """T-poses for calibration, and files that have lost all rotations but the root's; elbows and knees that
    bend backwards. A true mirror image is a person's motion."""
    clip = motion("walking")
    for first in (1, 0):
        poses = np.concatenate([clip.poses[:, :first], np.repeat(clip.poses[:1, first:], len(clip), 0)], 1)
        assert explain_implausibility(replace(clip, poses=poses)) is None
        assert faults(replace(clip, poses=poses)).startswith("only the root turns")
    swapped = clip.poses[:, OTHER_SIDE]
    assert faults(replace(clip, poses=swapped)).startswith("the elbows bend backwards")
    assert faults(replace(clip, poses=swapped * [1, -1, -1], trans=clip.trans * [-1, 1, 1])) == ""
    for signs, joints in (((1, -1, -1), "elbows"), ((-1, 1, -1), "knees"), ((-1, -1, 1), "knees")):
        poses = np.concatenate([clip.poses[:, :1], clip.poses[:, 1:] * np.array(signs)], 1)
        assert faults(replace(clip, poses=poses)).startswith(f"the {joints} bend backwards")


@pytest.mark.parametrize(("trans", "z"), [
    (lambda trans: trans * 0, "-0.9"),  # relative to the root
    (lambda trans: trans * 3.281, "2.1"),  # feet
    (lambda trans: trans[:, [0, 2, 1]] * [1, 1, -1], "-5.0"),  # Y up, the rotations Z up
])  # fmt: skip
def test_a_translation_that_does_not_fit_the_steps_is_reported(trans, z):
    clip = motion("walking")
    wrong = replace(clip, trans=trans(clip.trans))
    assert explain_implausibility(wrong) is None
    assert faults(wrong).startswith(f"the lowest joint is at z = {z} m, and no joint stands still")


def test_people_in_other_units_or_with_another_axis_are_refused():
    clip = motion("walking")
    assert "degrees" in explain_implausibility(replace(clip, poses=np.degrees(clip.poses)))
    for scale in (39.37, 100.0, 1000.0):
        assert "not in metres" in explain_implausibility(replace(clip, trans=scale * clip.trans))
    assert "Y is up" in explain_implausibility(turned(clip, Y_UP))
    clip = motion("idling")
    still = replace(clip, trans=clip.trans[0] + 0.05 * (clip.trans - clip.trans[0]))
    assert "at z = " in explain_implausibility(replace(still, trans=100 * still.trans))


SALSA = Path(__file__).parents[3] / "shared" / "data" / "cmu" / "salsa" / "05.bvh"
LEFT, RIGHT = (
    [JOINTS.index(f"{s}_{j}") for j in ("hip", "knee", "ankle", "foot")] for s in ("left", "right")
)


def exchange_legs(clip: Clip) -> Clip:
    poses = clip.poses.copy()
    poses[:, LEFT + RIGHT] = clip.poses[:, RIGHT + LEFT]
    return replace(clip, poses=poses)


def turn_legs(clip: Clip) -> Clip:
    """Turn the legs about the vertical axis, as in a file with exchanged hips."""
    poses = clip.poses.copy()
    poses[:, [LEFT[0], RIGHT[0]]] = [0, np.pi, 0]
    return replace(clip, poses=poses)


@pytest.mark.parametrize(("activity", "change", "said"), [
    ("walking", lambda clip: replace(clip, fps=120.0), "so the frame rate 120 Hz may be about twice"),
    ("running", lambda clip: replace(clip, fps=120.0), "faster than people step"),
    ("walking", lambda clip: replace(clip, fps=15.0), "slower than people step"),
    ("jumping", lambda clip: replace(clip, fps=120.0), "times the acceleration of gravity"),
    ("jumping", lambda clip: replace(clip, fps=30.0), "too low"),
    ("walking", exchange_legs, "left and right legs may be swapped"),
    ("walking", turn_legs, "the feet point backward relative to the pelvis"),
])  # fmt: skip
def test_a_fault_is_named_and_the_sound_clip_is_not(activity: str, change, said: str):
    clip = synthesize_clip(activity, 1, seconds=8.0)
    assert list(find_faults(clip)) == []
    assert said in "; ".join(find_faults(change(clip)))


@pytest.mark.skipif(not SALSA.is_file(), reason="needs cmu/salsa/05.bvh, which is not part of the project")
def test_the_header_of_salsa_is_wrong(tmp_path: Path):
    import_folder(SALSA, tmp_path / "header", ImportSettings(fps={"": 120.0}))
    import_folder(SALSA, tmp_path / "true")
    assert "twice the true rate" in "; ".join(find_faults(read_clip(tmp_path / "header" / "05.npz", "05")))
    assert list(find_faults(read_clip(tmp_path / "true" / "05.npz", "05"))) == []
