"""The network: sizes, streaming, memory, and that every switch changes something."""

import pytest
import tiny
import torch
from torch import nn

from memmlp.evaluation.modes import stream, window
from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM, builtin_rest_joints
from memmlp.motion.dataset import WindowSampler
from memmlp.motion.network_coordinates import Heading, HeadRelative, World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import GRUMemory, LSTMMemory, NoMemory
from memmlp.networks.own_past_memory import CodeMemory, CodeMemorySettings, JointCodeMemory, NoCodesMemory
from memmlp.networks.predictor import (
    RotationOnlyMemorySettings,
    RotationOnlySettings,
    TwoBranch,
    TwoBranchMemorySettings,
    TwoBranchSettings,
)
from memmlp.networks.vqvae import VQVAE
from memmlp.training.rollout import TeacherForcing

MEMORIES = [
    (NoMemory, {}),
    (NoCodesMemory, {"shift": "frame", "history": "latest"}),
    (CodeMemory, {"shift": "frame", "history": "first"}),
    (CodeMemory, {"shift": "frame", "history": "latest"}),
    (CodeMemory, {"shift": "window", "history": "first"}),
    (CodeMemory, {"shift": "window", "history": "latest"}),
    (CodeMemory, {"fusion": "plain"}),
    (JointCodeMemory, {}),
    (LSTMMemory, {}),
    (GRUMemory, {"fusion": "plain"}),
]  # fmt: skip
SPARSE = tiny.clip(40)[None, :, :SPARSE_DIM]


def run(model: MemMLP, sparse: torch.Tensor, new: int = 1) -> list[torch.Tensor]:
    state = model.initial_state(len(sparse))
    outputs = []
    for part in sparse.split(new, 1):
        output, state = model.advance(part, state)
        outputs.append(output)
    return outputs


def test_paper_profile_has_the_papers_parameters():
    """4.10 M within 3 %: trainable parameters, the frozen VQ-VAE not counted (Table 16)."""
    sizes = {"hidden": 512, "frames": 41}
    read = {"fusion": "residual", "shift": "window", "history": "first"}
    keys = CodeMemorySettings(layers=[2, 4, 6, 8], width=192, **read)
    memory = CodeMemory(keys, codes=VQVAE(), depth=8, **sizes)
    normalizer = Normalizer.raw(HeadRelative(), torch.tensor(builtin_rest_joints()))
    model = MemMLP(normalizer, memory, TwoBranch(TwoBranchSettings(2), **sizes), depth=8, **sizes)
    assert model.count_parameters() == 4_117_118
    assert abs(model.count_parameters() / 4.10e6 - 1) < 0.03


@pytest.mark.parametrize(("kind", "changes"), MEMORIES)
@torch.no_grad()
def test_the_first_frame_fills_the_window_and_clips_side_by_side_are_as_alone(kind, changes):
    model = tiny.model(kind, **changes)
    first = model.advance(SPARSE[:, :1], model.initial_state(1))[0]
    still = model.running_state(SPARSE[:, :1].expand(-1, model.memory.past_frames, -1))
    torch.testing.assert_close(first, model.advance(SPARSE[:, :1], still)[0])
    clips = [tiny.clip(n, seed=n) for n in (9, 25, 14)]
    for together, clip in zip(stream(model, clips), clips, strict=True):
        torch.testing.assert_close(together, stream(model, [clip])[0], atol=1e-5, rtol=0)


@pytest.mark.parametrize("shift", ["frame", "window"])
@torch.no_grad()
def test_memory_sees_the_shifted_past(shift):
    """Derived independently: the past of frame t is the inputs and own first estimates `shift` earlier."""
    model = tiny.model(CodeMemory, shift=shift)
    seen = []
    model.blocks[1].register_forward_hook(lambda module, args, output: seen.append(args[1]))
    outputs = run(model, SPARSE)
    back, size, t = {"frame": 1, "window": model.frames}[shift], model.frames, 30
    span = slice(t - back - size + 1, t - back + 1)
    origin = model.normalizer.origin(SPARSE)
    torch.testing.assert_close(seen[t].sparse, model.normalizer.encode_sparse(SPARSE, origin)[:, span])
    own = torch.stack([output[0, -1] for output in outputs])[None]
    torch.testing.assert_close(
        seen[t].motion, model.normalizer.encode_motion(own, origin)[:, span], atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("shift", ["frame", "window"])
@torch.no_grad()
def test_the_past_of_a_call_of_a_window_is_the_window_before(shift):
    """Whatever the shift, the past is the inputs and the output of the call before."""
    model = tiny.model(CodeMemory, shift=shift)
    seen = []
    model.blocks[1].register_forward_hook(lambda module, args, output: seen.append(args[1]))
    size, sparse = model.frames, SPARSE[:, : 3 * model.frames]
    outputs = run(model, sparse, new=size)
    origin = model.normalizer.origin(sparse)[:, size : 2 * size]
    before = model.normalizer.encode_sparse(sparse[:, size : 2 * size], origin)
    torch.testing.assert_close(seen[2].sparse, before)
    torch.testing.assert_close(
        seen[2].motion, model.normalizer.encode_motion(outputs[1], origin), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize(("shift", "back"), [("frame", 1), ("window", 7)])
@torch.no_grad()
def test_in_window_mode_a_memory_recalls_what_it_was_trained_on(shift, back):
    """That is the window that ends `shift` before the newest frame of each one, as in teacher forcing."""
    model, clip, seen = tiny.model(CodeMemory, shift=shift), tiny.clip(24), []
    model.blocks[1].register_forward_hook(lambda module, args, output: seen.append(args[1].sparse))
    found, size = window(model, [clip])[0], model.frames
    encoded = model.normalizer.encode(clip)[None, :, :SPARSE_DIM]
    kept = seen[size - 1 :: size] if shift == "frame" else seen
    for t, past in zip(range(size - 1, 24, size), kept, strict=False):
        expected = torch.cat([encoded[:, :1].expand(-1, back + size, -1), encoded], 1)[:, t + 1 :][:, :size]
        torch.testing.assert_close(past, expected)
    trained = TeacherForcing().draw(model, tiny.frames((24,)), WindowSampler(tiny.frames((24,)), 4, 7, 0), 0)
    model.advance(trained.sparse, trained.state)
    inputs = model.normalizer.encode(trained.true_frames)[..., :SPARSE_DIM]
    torch.testing.assert_close(seen[-1][:, back:], inputs[:, :-back])
    assert found.shape == (24, MOTION_DIM)


@torch.no_grad()
def test_in_window_mode_a_frame_by_frame_network_shows_each_windows_last_call():
    """Windows have 7 frames or what is left, and clips side by side give the same as each one alone."""
    model, clips = tiny.model(CodeMemory, shift="frame"), [tiny.clip(24), tiny.clip(9, seed=1)]
    outputs = run(model, clips[0][None, :, :SPARSE_DIM])
    expected = torch.cat([outputs[6][0], outputs[13][0], outputs[20][0], outputs[23][0, -3:]])
    found = window(model, clips)
    torch.testing.assert_close(found[0], expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(found[1], window(model, clips[1:])[0], atol=1e-5, rtol=0)


@torch.no_grad()
def test_latest_history_is_the_last_output():
    model = tiny.model(CodeMemory, shift="frame", history="latest")
    seen = []
    model.blocks[1].register_forward_hook(lambda module, args, output: seen.append(args[1]))
    outputs, t, size = run(model, SPARSE), 30, model.frames
    origin = model.normalizer.origin(SPARSE)[:, t - size : t]
    torch.testing.assert_close(
        seen[t].motion, model.normalizer.encode_motion(outputs[t - 1], origin), atol=1e-5, rtol=0
    )


@torch.no_grad()
def test_the_stream_is_causal_and_remembers():
    """A later input changes no earlier output; an input older than the window still counts with a memory."""
    cases = [(NoMemory, {}, False), (CodeMemory, {"shift": "frame"}, True), (LSTMMemory, {}, True)]
    for kind, changes, remembers in cases:
        model = tiny.model(kind, **changes)
        changed = SPARSE.clone()
        changed[:, 10] += 0.5
        before, after = run(model, SPARSE), run(model, changed)
        assert all(torch.equal(a, b) for a, b in zip(before[:10], after[:10], strict=True))
        assert not torch.equal(before[10], after[10])
        late = 10 + 2 * model.frames
        assert torch.equal(before[late][:, -1], after[late][:, -1]) != remembers


def variant(**changes) -> torch.Tensor:
    return run(tiny.model(**changes), SPARSE[:, :20])[-1]


SWITCHES = [
    {"kind": NoMemory}, {"kind": NoCodesMemory}, {"kind": LSTMMemory}, {"kind": GRUMemory},
    {"predictor": TwoBranchMemorySettings}, {"shift": "frame"}, {"history": "latest"}, {"fusion": "plain"},
    {"layers": (2,)}, {"width": 5}, {"blend": 0.0}, {"blend": 1.0}, {"blend": "sampled"},
    {"predictor": RotationOnlySettings}, {"predictor": RotationOnlyMemorySettings}, {"coordinates": World()},
    {"coordinates": Heading()},
]  # fmt: skip


@torch.no_grad()
def test_every_switch_changes_the_output():
    plain = variant()
    assert torch.equal(plain, variant())
    for changes in SWITCHES:
        assert not torch.allclose(variant(**changes), plain, atol=1e-5), changes


@torch.no_grad()
def test_a_sampled_blend_draws():
    model = tiny.model(blend="sampled")
    torch.manual_seed(1)
    one = run(model, SPARSE)[-1]
    torch.manual_seed(2)
    assert not torch.allclose(one, run(model, SPARSE)[-1])


def test_codes_stay_frozen_while_the_rest_learns():
    model = tiny.model().train()
    assert not model.memory.codes.training
    model.advance(SPARSE[:, :7], model.initial_state(1))[0].square().sum().backward()
    assert all(p.grad is None for p in model.memory.codes.parameters())
    learned = [name for name, p in model.named_parameters() if p.requires_grad and p.grad is None]
    assert learned == []


@torch.no_grad()
def test_rotation_only_positions_are_forward_kinematics():
    model = tiny.model(predictor=RotationOnlySettings)
    motion = run(model, SPARSE)[-1]
    window = SPARSE[:, -model.frames :]
    expected = model.normalizer.pose(motion, window).flatten(-2)
    torch.testing.assert_close(motion[..., ROTATION.stop :], expected, atol=1e-5, rtol=0)
    assert motion.shape[-1] == MOTION_DIM


PREDICTORS = [
    *((kind, changes, TwoBranchSettings) for kind, changes in MEMORIES),
    (CodeMemory, {}, RotationOnlySettings), (CodeMemory, {}, TwoBranchMemorySettings),
    (LSTMMemory, {}, TwoBranchMemorySettings),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "changes", "predictor"), PREDICTORS)
@torch.no_grad()
def test_the_newest_frames_alone_are_the_same_numbers(kind, changes, predictor):
    # In float64: untrained networks on their own output may amplify float32's rounding.
    model = tiny.model(kind, predictor, **changes).double()
    whole = part = model.initial_state(1)
    for sparse in SPARSE[:, :20].double().split(1, 1):  # the past is full from the 14th on
        all_frames, whole = model.advance(sparse, whole)
        newest, part = model.advance(sparse, part, 2)
        torch.testing.assert_close(newest, all_frames[:, -2:], atol=1e-10, rtol=0)
    torch.testing.assert_close(part, whole, atol=1e-10, rtol=0)


def test_time_mix_is_a_convolution_over_frames():
    """The T x T product equals AGRoL's Conv1d T -> T with kernel 1."""
    from memmlp.networks.layers import TimeMix

    mix, conv = TimeMix(7), nn.Conv1d(7, 7, 1)
    with torch.no_grad():
        conv.weight.copy_(mix.weight[..., None])
        conv.bias.copy_(mix.bias[:, 0])
    h = torch.randn(2, 7, 5)
    torch.testing.assert_close(mix(h), conv(h))
