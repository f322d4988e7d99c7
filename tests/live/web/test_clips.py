"""A site's clips: the middle, in OpenXR's axes."""

from __future__ import annotations

import numpy as np
import wearer

from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.spaces import SPACES
from memmlp.live.web.clips import NUMBERS, packed

PERSON = wearer.person(np.arange(121) / 60)


def test_it_is_the_middle_of_the_clip_in_the_page_s_axes():
    clip = packed("walk", PERSON.frames.numpy(), 1.0)
    assert (clip.name, clip.frames) == ("walk", 60)
    numbers = np.frombuffer(clip.content, "<f4").reshape(60, NUMBERS)
    space, middle = SPACES["openxr"], slice(31, 91)  # frames have no first moment
    np.testing.assert_allclose(
        numbers[:, :9].reshape(-1, 3, 3), space.positions_out(PERSON.positions[middle]), atol=1e-6
    )
    rotations = quaternion_to_matrix(numbers[:, 9:21].reshape(-1, 4).astype(float)).reshape(-1, 3, 3, 3)
    np.testing.assert_allclose(rotations, space.rotations_out(PERSON.rotations[middle]), atol=1e-5)
    joints = PERSON.frames[30:90, -66:].reshape(-1, 22, 3).numpy()
    np.testing.assert_allclose(numbers[:, 21:].reshape(-1, 22, 3), space.positions_out(joints), atol=1e-6)


def test_the_same_frames_have_the_same_key():
    frames = PERSON.frames.numpy()
    assert packed("a", frames, 9.0).key == packed("b", frames, 9.0).key
    assert packed("a", frames, 9.0).key != packed("a", frames[1:], 9.0).key
    assert packed("a", frames, 9.0).frames == len(frames)
