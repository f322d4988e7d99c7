"""How SAGE-Net's parts are trained: on their half alone, beside parts that stay as they are."""

from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
import tiny
import torch
from tiny_tasks import part_task
from torch import nn

from memmlp.motion.body import HEAD, N_JOINTS, ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks import checkpoint
from memmlp.networks.architectures import Architecture
from memmlp.networks.sage_parts import LOWER, UPPER
from memmlp.training import train_sage
from memmlp.training.loop import train_step
from memmlp.training.train_sage import PARTS, DroppingOptim

OPTIM = DroppingOptim(steps=4, batch=4, lr=1e-2, lr_drops_at=(0.5, 0.75), lr_drop=0.2)
FRAMES = torch.stack([tiny.clip(8, seed) for seed in (1, 2)])
JOINTS = {"upper": UPPER, "lower": LOWER}


def parts(kind: str) -> tuple[nn.Module, nn.Module]:
    """The network and the half's VQ-VAE of a part's task."""
    net, codes = part_task(kind).objective.args
    return net, codes


@pytest.mark.parametrize("half", JOINTS)
def test_a_vqvae_sees_and_is_scored_on_its_half_alone(half):
    net, codes = parts(f"{half}_codes")
    before = train_sage.compute_code_losses(net, codes, FRAMES, False)
    others = [joint for joint in range(N_JOINTS) if joint not in JOINTS[half]]
    for joints, same in ((others, True), (JOINTS[half][1:], False)):
        turned = FRAMES.clone()
        motion = turned[..., SPARSE_DIM:][..., ROTATION].unflatten(-1, (N_JOINTS, 6))
        motion[..., list(joints), :] = motion[..., list(joints), :].roll(3, -1)
        after = train_sage.compute_code_losses(net, codes, turned, False)
        assert all(torch.equal(before[name], after[name]) for name in before) == same
    assert ("hand" in before) == (half == "upper")


@torch.no_grad()
def test_a_true_pose_has_no_error_and_hands_are_where_the_trackers_are():
    net = tiny.baseline("sage")
    net.normalizer = Normalizer.from_coordinates(World(), tiny.REST)
    true = FRAMES[:, -1, SPARSE_DIM:][..., ROTATION].unflatten(-1, (N_JOINTS, 6))
    errors = train_sage.measure_half_errors(net, UPPER, true[:, list(UPPER)], FRAMES[:, -1], true)
    assert {name: round(float(value), 6) for name, value in errors.items()} == dict.fromkeys(errors, 0.0)
    turned = true.clone()
    turned[:, HEAD] = turned[:, HEAD].roll(3, -1)  # joints hang on the head's tracker, and none on the head
    found = train_sage.measure_half_errors(net, UPPER, turned[:, list(UPPER)], FRAMES[:, -1], true)
    assert float(found["rotation"]) > 0.01
    assert float(found["position"]) == pytest.approx(0, abs=1e-6)
    assert float(found["hand"]) == pytest.approx(0, abs=1e-6)


def test_joints_are_hidden_in_training_alone_and_never_the_first():
    net, codes = parts("upper_codes")
    codes.encode = mock.Mock(side_effect=codes.encode)
    for training in (True, False):
        train_sage.compute_code_losses(net, codes, FRAMES, training)
    seen = [rotation.unflatten(-1, (N_JOINTS, 6)) for (rotation, _), _ in codes.encode.call_args_list]
    hidden, shown = ((one == train_sage.HIDDEN).all(-1) for one in seen)
    assert not shown.any()
    assert not hidden[..., 0].any()
    assert 0.2 < hidden[..., 1:].float().mean() < 0.8
    assert (hidden == hidden[:, :1]).all()  # in all frames of a window
    assert (train_sage.add_noise(net, torch.zeros(99, 4, 384))[2].sum(1) <= 2).all()


@pytest.mark.parametrize("kind", PARTS[:-1])
def test_a_step_changes_the_part_and_nothing_else(kind):
    for precision in ("fp32", "bf16"):
        optim = replace(OPTIM, precision=precision)
        task = part_task(kind, optim)
        tensors = nn.ModuleList(task.objective.args).state_dict()
        before = {name: tensor.clone() for name, tensor in tensors.items()}
        train_step(task, optim, optim.build(task.parameter_groups()), 0)
        own = {tensor.data_ptr() for tensor in task.module.state_dict().values()}
        changed = {name for name, tensor in tensors.items() if not torch.equal(tensor, before[name])}
        assert changed
        assert all(tensors[name].data_ptr() in own for name in changed)
        assert all(torch.isfinite(p).all() for p in task.module.parameters())


@torch.no_grad()
def test_the_upper_half_is_validated_on_what_it_samples():
    """Not on one step of denoising, whose error depends on the noise that was drawn."""
    net, codes = parts("upper_diffusion")
    rotation, encoded = train_sage.encode_windows(net, FRAMES)
    sampled, true = net.sample_upper(encoded), train_sage.encode_latents(codes, rotation, encoded)
    for training in (False, True):
        found = train_sage.compute_latent_losses(net, codes, FRAMES, training, lower=False)["latent"]
        assert torch.equal(found, nn.functional.smooth_l1_loss(sampled, true)) != training


def test_the_lower_half_is_given_what_the_upper_one_samples():
    """Never the true latents, which there are none of at inference."""
    net, codes = parts("lower_diffusion")
    encoded = net.normalizer.encode(FRAMES)[..., :SPARSE_DIM]
    net.lower.merge_latents = mock.Mock(side_effect=net.lower.merge_latents)
    with torch.no_grad():
        for training in (True, False):
            train_sage.compute_latent_losses(net, codes, FRAMES, training, lower=True)
        net.predict_rotations(encoded)
        expected = net.sample_upper(encoded)
    assert len(net.lower.merge_latents.call_args_list) == 1 + 2 * len(net.diffusion.times)
    assert all(torch.equal(upper, expected) for (_, upper), _ in net.lower.merge_latents.call_args_list)


def test_it_begins_with_the_weights_of_its_parts(tmp_path: Path):
    kept, parts = tiny.baseline("sage", seed=1), ("upper", "lower", "decoder")
    checkpoint.write(tmp_path / "model", checkpoint.collect_module_tensors("model", kept), {})
    build = lambda normalizer, *_: tiny.build_baseline("sage", normalizer)  # noqa: E731
    architecture = Architecture(World(), normalize=False, vqvae=tiny.vqvae, network=build)
    for finished in ((), ("upper", "lower")):
        architecture = replace(architecture, trained_parts=finished)
        net = architecture.build_for_training(tiny.normalizer(), tmp_path / "model")
        stems, known = ({name: one.get_submodule(name).stem.weight for name in parts} for one in (net, kept))
        same = {name for name, stem in stems.items() if torch.equal(stem, known[name])}
        assert same == (set(finished) or set(stems))
        assert {name for name, stem in stems.items() if not stem.requires_grad} == set(finished)
