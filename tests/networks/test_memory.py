"""Memories other than the paper's: recurrent, with a VQ-VAE trained jointly, or in the predictor's blocks."""

from functools import partial

import pytest
import tiny
import torch
from tiny_tasks import motion_task

from memmlp.common.errors import InputError
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import WindowSampler
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import GRUMemory, LSTMMemory, NoMemory
from memmlp.networks.own_past_memory import CodeMemory, JointCodeMemory, MemoryWithoutCodes
from memmlp.networks.predictor import RotationOnlyMemorySettings, TwoBranchMemorySettings
from memmlp.networks.vqvae import VQVAE
from memmlp.training.losses import l1
from memmlp.training.optim import Optim
from memmlp.training.rollout import TeacherForcing
from memmlp.training.train_network import MotionTask

RECURRENT = [LSTMMemory, GRUMemory]
SPARSE = tiny.clip(35)[None, :, :SPARSE_DIM]
SPLIT = tiny.frames((60, 90))


def outputs(model: MemMLP, sparse: torch.Tensor, new: int) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Return the last window's motion and the state after taking in the frames `new` at a time."""
    state = model.initial_state(len(sparse))
    for part in sparse.split(new, 1):
        motion, state = model.advance(part, state)
    return motion, state


@pytest.mark.parametrize("kind", RECURRENT)
@torch.no_grad()
def test_the_recurrent_feature_is_norm_layer_silu_over_the_whole_stream(kind):
    """An independent re-derivation: torch's layer over all frames from zeros."""
    model, seen = tiny.model(kind), []
    model.blocks[1].register_forward_hook(lambda module, args, output: seen.append(args[1]))
    outputs(model, SPARSE, 1)
    encoded = model.normalizer.encode_sparse(SPARSE, model.normalizer.find_origin(SPARSE))
    first = model.memory.recurrences[0]
    expected = torch.nn.functional.silu(first.layer(first.norm(encoded))[0])
    found = model.blocks[1].feature(seen[-1])
    torch.testing.assert_close(found, expected[:, -model.frames :], atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", RECURRENT)
def test_teacher_forcing_starts_the_hidden_state_from_the_input_before_the_window(kind):
    model = tiny.model(kind).train()
    sampler = WindowSampler(SPLIT, batch=5, window=7, seed=0)
    call = TeacherForcing().draw(model, SPLIT, sampler, 0)
    clips, end = sampler.draw(0)
    assert torch.equal(call.sparse, SPLIT.read_stretches(clips, end, 7)[..., :SPARSE_DIM])
    before = SPLIT.read_stretches(clips, end - 7, 1)
    encoded = model.normalizer.encode(before)[:, 0, :SPARSE_DIM]
    layer = model.memory.recurrences[1]
    torch.testing.assert_close(call.state["hidden"][:, 1], layer.first(layer.norm(encoded)))
    assert all(float(call.state[name].abs().sum()) == 0 for name in set(call.state) & {"cell", "features"})
    model.advance(call.sparse, call.state)[0].square().sum().backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []


def joint_task(codebook: str = "ema") -> MotionTask:
    vqvae = partial(VQVAE, codes=8, width=12, encoder_depth=2, codebook=codebook)
    task = motion_task("forced", Optim(steps=3, batch=5, lr=1e-2), kind=JointCodeMemory, vqvae=vqvae)
    task.model.train()
    return task


@pytest.mark.parametrize("codebook", ["ema", "gradient"])
def test_joint_training_adds_the_vqvaes_own_terms_unweighted(codebook):
    task = joint_task(codebook)
    result = task.step(0)
    own = {"vqvae_rotation", "vqvae_codebook"}
    assert own <= set(result.terms)
    assert own.isdisjoint(task.loss.weighting.weights())
    weighted = task.loss.weighting({n: t for n, t in result.terms.items() if n not in own})
    torch.testing.assert_close(result.loss, weighted + sum(result.terms[name] for name in own))
    result.loss.backward()
    learned = {name for name, p in task.model.named_parameters() if p.requires_grad and p.grad is not None}
    assert {name for name, _ in task.model.named_parameters()} == learned
    assert ("memory.codes.codebook.vectors" in learned) == (codebook == "gradient")


def test_the_networks_loss_reaches_the_joint_encoder_straight_through():
    task = joint_task()
    task.step(0)  # puts the codes onto data
    call = task.rollout.draw(task.model, task.dataset, task.sampler, 1)
    task.model.advance(call.sparse, call.state)[0].square().sum().backward()
    vqvae = task.model.memory.codes
    assert vqvae.encoder[0].weight.grad.any()
    assert all(p.grad is None for p in vqvae.decoder.parameters())


@torch.no_grad()
def test_the_vqvaes_terms_are_eq_1_in_the_worlds_units_and_the_codebooks_loss():
    model, normalizer, clip = tiny.vqvae(), tiny.normalizer(), tiny.clip(20)
    frames = normalizer.encode(clip)
    model.codebook.started.fill_(True)
    nearest = torch.cdist(model.encoder(frames), model.codebook.vectors).argmin(-1)
    rotations = model.decoder(model.codebook.vectors[nearest])
    std, mean = normalizer.std[54:186], normalizer.mean[54:186]
    truth = normalizer.coordinates.convert_motion_to_local(clip[:, 54:], normalizer.find_origin(clip[:, :54]))
    terms, indices = model.compute_losses(frames, normalizer)
    expected = l1((rotations * std + mean - truth[:, :132])[:, None])
    torch.testing.assert_close(terms["rotation"], expected, rtol=1e-5, atol=0)
    assert torch.equal(indices, nearest)
    assert set(terms) == {"rotation", "codebook"}


@pytest.mark.parametrize("kind", [MemoryWithoutCodes, CodeMemory, LSTMMemory])
@pytest.mark.parametrize("predictor", [TwoBranchMemorySettings, RotationOnlyMemorySettings])
@torch.no_grad()
def test_the_branches_look_at_the_memory(kind, predictor):
    """The backbone has no memory blocks, yet the past changes the output."""
    model = tiny.model(kind, predictor, layers=())
    _, state = outputs(model, SPARSE[:, :20], 7)
    blank = {name: t if name in ("sparse", "started") else torch.zeros_like(t) for name, t in state.items()}
    with_past, without = (model.advance(SPARSE[:, 20:21], past)[0] for past in (state, blank))
    assert not torch.allclose(with_past, without, atol=1e-5)


def test_no_memory_has_no_blocks_for_the_branches():
    with pytest.raises(InputError, match="memory: must have memory blocks"):
        tiny.model(NoMemory, TwoBranchMemorySettings)
