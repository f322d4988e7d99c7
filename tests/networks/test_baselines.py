"""What every baseline keeps to: streams, windows, joints."""

import functools

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
def test_a_stream_is_the_last_frame_of_windows_with_full_history(name):
    model = tiny.baseline(name, Heading())
    size = model.frames
    stream = evaluation.stream(model, [CLIP])[0]
    for end in (size, 13, 24):
        window = model.advance(SPARSE[:, end - size : end], model.initial_state(1))[0]
        torch.testing.assert_close(window[0, -1], stream[end - 1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", WINDOWED)
@torch.no_grad()
def test_a_fresh_start_is_the_first_frame_for_a_window(name):
    model = tiny.baseline(name)
    first = model.advance(SPARSE[:, :1], model.initial_state(1), 1)[0]
    still = model.advance(SPARSE[:, :1].expand(-1, model.frames, -1), model.initial_state(1), 1)[0]
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
@pytest.mark.parametrize("mode", ["stream", "window"])
@torch.no_grad()
def test_side_by_side_is_one_by_one_and_short_clips_count(name, mode):
    model = tiny.baseline(name).double()
    clips = [tiny.clip(n, seed=n).double() for n in (4, 17, 12)]
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


KNOBS = [
    ("agrol_mlp", {"frames": 6}), ("agrol_mlp", {"depth": 3}), ("agrol_mlp", {"width": 12}),
    ("agrol_diffusion", {"diffusion_steps": 60}), ("agrol_diffusion", {"sampling_steps": 2}),
    ("agrol_diffusion", {"noise_seed": 1}), ("agrol_diffusion", {"depth": 3}),
    ("bodiffusion", {"diffusion_steps": 60}), ("bodiffusion", {"sampling_steps": 2}),
    ("bodiffusion", {"noise_seed": 1}), ("bodiffusion", {"heads": 2}),
    ("sage", {"noise": 1.0}), ("sage", {"sampling_steps": 3}), ("sage", {"diffusion_steps": 60}),
    ("sage", {"heads": 1}), ("sage", {"code_heads": 1}), ("sage", {"code_depth": 2}), ("sage", {"depth": 2}),
    ("avatar_poser", {"frames": 6}), ("avatar_poser", {"heads": 2}), ("avatar_poser", {"feedforward": 16}),
    ("avatar_poser", {"depth": 3}),
    ("ego_poser", {"frames": 6}), ("ego_poser", {"heads": 2}), ("ego_poser", {"feedforward": 16}),
    ("vae_hmd", {"depth": 1}), ("vae_hmd", {"latent": 5}), ("vae_hmd", {"width": 12}),
    ("rpm", {"context": 2}), ("rpm", {"horizon": 3}), ("rpm", {"feedforward": 16}), ("rpm", {"heads": 2}),
    ("avatar_jlm", {"frames": 6}), ("avatar_jlm", {"depth": 1}), ("avatar_jlm", {"feedforward": 16}),
    ("hmd_poser", {"encoder_layers": 2}), ("hmd_poser", {"depth": 1}), ("hmd_poser", {"heads": 2}),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("name", "change"), KNOBS, ids=str)
@torch.no_grad()
def test_every_knob_changes_the_motion(name, change):
    other = evaluation.stream(tiny.baseline(name, **change), [CLIP[:12]])[0]
    assert not torch.allclose(unchanged(name), other, atol=1e-4)


@functools.cache
def unchanged(name: str) -> torch.Tensor:
    """What a network makes of the clip's beginning, a little more than its window."""
    return evaluation.stream(tiny.baseline(name), [CLIP[:12]])[0]
