"""What every baseline keeps to: streams, windows, joints."""

import pytest
import tiny
import torch

from memmlp.evaluation import modes as evaluation
from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import Heading

NAMES = list(tiny.BASELINES)
WINDOWED = [name for name in NAMES if name not in tiny.WINDOWLESS]
CLIP = tiny.clip(24)
SPARSE = CLIP[None, :, :SPARSE_DIM]


@pytest.mark.parametrize("name", WINDOWED)
@torch.no_grad()
def test_a_stream_is_the_last_frame_of_windows_which_the_first_frame_fills(name):
    model = tiny.baseline(name, Heading())
    size = model.frames
    stream = evaluation.stream(model, [CLIP])[0]
    for end in (size, 13, 24):
        window = model.advance(SPARSE[:, end - size : end], model.initial_state(1))[0]
        torch.testing.assert_close(window[0, -1], stream[end - 1], atol=1e-5, rtol=0)
    first = model.advance(SPARSE[:, :1], model.initial_state(1), 1)[0]
    still = model.advance(SPARSE[:, :1].expand(-1, size, -1), model.initial_state(1), 1)[0]
    torch.testing.assert_close(first, still)


@pytest.mark.parametrize("name", tiny.WINDOWLESS)
@torch.no_grad()
def test_without_a_window_both_modes_are_the_stream_in_calls_of_any_size(name):
    model = tiny.baseline(name, Heading())
    stream = evaluation.stream(model, [CLIP])[0]
    assert torch.equal(evaluation.window(model, [CLIP])[0], stream)
    state, made = model.initial_state(1), []
    for part in SPARSE.split([1, 9, 14], 1):
        motion, state = model.advance(part, state)
        made.append(motion[0])
    torch.testing.assert_close(torch.cat(made), stream, atol=1e-5, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_side_by_side_is_one_by_one_and_short_clips_count(name):
    model = tiny.baseline(name).double()
    clips = [tiny.clip(n, seed=n).double() for n in (4, 17, 12)]
    for mode in ("stream", "window"):
        for together, clip in zip(evaluation.predict(model, clips, mode, 8), clips, strict=True):
            assert together.shape == (len(clip), MOTION_DIM)
            alone = evaluation.predict(model, [clip], mode, 8)[0]
            torch.testing.assert_close(together, alone, atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_positions_are_forward_kinematics_of_the_rotations(name):
    model = tiny.baseline(name, Heading())
    clip = CLIP[:12]
    motion = evaluation.stream(model, [clip])[0]
    expected = model.normalizer.pose(motion, clip[:, :SPARSE_DIM]).flatten(1)
    torch.testing.assert_close(motion[:, ROTATION.stop :], expected, atol=1e-5, rtol=0)


KNOBS = {
    "agrol_mlp": ({"frames": 6}, {"depth": 3}, {"width": 12}),
    "agrol_diffusion": ({"diffusion_steps": 60}, {"sampling_steps": 2}, {"noise_seed": 1}, {"depth": 3}),
    "bodiffusion": ({"diffusion_steps": 60}, {"sampling_steps": 2}, {"noise_seed": 1}, {"heads": 2}),
    "sage": (
        {"noise": 1.0}, {"sampling_steps": 3}, {"diffusion_steps": 60}, {"heads": 1}, {"code_heads": 1},
        {"code_depth": 2}, {"depth": 2},
    ),
    "avatar_poser": ({"frames": 6}, {"heads": 2}, {"feedforward": 16}, {"depth": 3}),
    "ego_poser": ({"frames": 6}, {"heads": 2}, {"feedforward": 16}),
    "vae_hmd": ({"depth": 1}, {"latent": 5}, {"width": 12}),
    "rpm": ({"context": 2}, {"horizon": 3}, {"feedforward": 16}, {"heads": 2}),
    "avatar_jlm": ({"frames": 6}, {"depth": 1}, {"feedforward": 16}),
    "hmd_poser": ({"encoder_layers": 2}, {"depth": 1}, {"heads": 2}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOBS)
@torch.no_grad()
def test_every_knob_changes_the_motion(name):
    plain, *others = (
        evaluation.stream(tiny.baseline(name, **change), [CLIP[:12]])[0] for change in ({}, *KNOBS[name])
    )
    for change, other in zip(KNOBS[name], others, strict=True):
        assert not torch.allclose(plain, other, atol=1e-4), change
