"""The network: sizes, streaming, memory, and that every switch changes something."""

import pytest
import tiny
import torch

from memmlp.evaluation.modes import predict_windows
from memmlp.motion.body import MOTION_DIM, SPARSE_DIM, make_builtin_rest_joints
from memmlp.motion.dataset import WindowSampler
from memmlp.motion.network_coordinates import HeadRelative
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import LSTMMemory, NoMemory
from memmlp.networks.own_past_memory import CodeMemory, CodeMemorySettings
from memmlp.networks.predictor import TwoBranch, TwoBranchSettings
from memmlp.networks.vqvae import VQVAE
from memmlp.training.rollout import TeacherForcing

SPARSE = tiny.clip(40)[None, :, :SPARSE_DIM]


def run(model: MemMLP, sparse: torch.Tensor, new: int = 1) -> list[torch.Tensor]:
    state, outputs = model.initial_state(len(sparse)), []
    for part in sparse.split(new, 1):
        output, state = model.advance(part, state)
        outputs.append(output)
    return outputs


def test_paper_profile_has_the_papers_parameters():
    """4.10 M within 3 %: trainable parameters, the frozen VQ-VAE not counted (Table 16)."""
    sizes = {"hidden": 512, "frames": 41}
    keys = CodeMemorySettings([2, 4, 6, 8], 192, fusion="residual", shift="window", history="first")
    memory = CodeMemory(keys, codes=VQVAE(), depth=8, **sizes)
    normalizer = Normalizer.from_coordinates(HeadRelative(), torch.tensor(make_builtin_rest_joints()))
    model = MemMLP(normalizer, memory, TwoBranch(TwoBranchSettings(2), **sizes), depth=8, **sizes)
    assert model.count_parameters() == 4_117_118
    assert abs(model.count_parameters() / 4.10e6 - 1) < 0.03
    assert 0.9 < 41**0.5 * float(model.blocks[0].time_mix.weight.detach().abs().max()) <= 1  # as torch begins


@pytest.mark.parametrize(("shift", "new"), [("frame", 1), ("window", 1), ("frame", 7), ("window", 7)])
@torch.no_grad()
def test_memory_sees_the_shifted_past_or_that_of_the_window_before(shift, new):
    """The past of frame t is the inputs and own first estimates `shift` earlier; in calls of a window it is,
    whatever the shift, the inputs and the output of the call before."""
    model, seen = tiny.model(CodeMemory, shift=shift), []
    model.blocks[1].register_forward_hook(lambda module, args, output: seen.append(args[1]))
    size, call, sparse = model.frames, 28 // new, SPARSE[:, :35]
    outputs = run(model, sparse, new)
    origin = model.normalizer.find_origin(sparse)
    back = 1 if (shift, new) == ("frame", 1) else size
    end = (call + 1) * new - back  # of the past; with calls of a window, features have the call's own origin
    span = slice(end - size, end)
    own = torch.cat([output[:, -new:] for output in outputs], 1)[:, span]
    torch.testing.assert_close(seen[call].sparse, model.normalizer.encode_sparse(sparse, origin)[:, span])
    motion = model.normalizer.encode_motion(own, origin[:, span])
    torch.testing.assert_close(seen[call].motion, motion, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("shift", "back"), [("frame", 1), ("window", 7)])
@torch.no_grad()
def test_in_window_mode_a_memory_recalls_what_it_was_trained_on(shift, back):
    """That is the window that ends `shift` before the newest frame of each one, as in teacher forcing."""
    model, clip, seen = tiny.model(CodeMemory, shift=shift), tiny.clip(24), []
    model.blocks[1].register_forward_hook(lambda module, args, output: seen.append(args[1].sparse))
    found, size = predict_windows(model, [clip])[0], model.frames
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


def test_codes_stay_frozen_while_the_rest_learns():
    model = tiny.model().train()
    assert not model.memory.codes.training
    model.advance(SPARSE[:, :7], model.initial_state(1))[0].square().sum().backward()
    assert all(p.grad is None for p in model.memory.codes.parameters())
    learned = [name for name, p in model.named_parameters() if p.requires_grad and p.grad is None]
    assert learned == []
