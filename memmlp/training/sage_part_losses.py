"""The losses of SAGE-Net's VQ-VAEs and diffusion models (Feng et al., CVPR 2024), as released.

Each loss is computed on world windows (B, T, 252), and hides some of their joints in training.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.float32_regions import in_float32
from memmlp.motion.body import HANDS, HEAD, N_JOINTS, ROOT, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.networks.sage_net import SAGENet
from memmlp.networks.sage_parts import HIDDEN, HalfVQVAE
from memmlp.training.losses.terms import Body

HIDDEN_SHARE = 0.5  # of a half's joints, which its VQ-VAE has to guess
HIDDEN_COUNT = 2  # joints of the diffusion models' condition, drawn with replacement
CODE_WEIGHTS = {"orientation": 0.2, "rotation": 1.0, "position": 5.0, "hand": 5.0, "codebook": 0.25}

Objective = Callable[[Tensor, bool], dict[str, Tensor]]
"""Maps world windows (B, T, 252), and whether it is for training, to weighted losses by name."""


def objective(kind: str, halves: nn.ModuleDict) -> Objective:
    """Return the objective that trains a part.

    Args:
        kind: one of PARTS, except "decoder".
        halves: the network ("net"), and the VQ-VAE of each half ("upper", "lower").
    """
    half, of = kind.split("_")
    net, codes = halves["net"], halves[half]
    assert isinstance(net, SAGENet)
    assert isinstance(codes, HalfVQVAE)
    return partial(code_losses if of == "codes" else LATENT_LOSSES[half], net, codes)


def code_losses(net: SAGENet, codes: HalfVQVAE, frames: Tensor, training: bool) -> dict[str, Tensor]:
    """Return the losses of a VQ-VAE: of the last frame's rotations and joints, and of its codebooks.

    In training, random joints of its half except the first are hidden, so that the VQ-VAE has to guess them.
    The half with the hands has a loss of the hands' positions, too.

    Args:
        net: the network, whose space the VQ-VAE works in.
        codes: the VQ-VAE.
        frames: world windows (B, T, 252).
        training: whether joints are hidden.
    """
    rotation, encoded = seen(net, frames)
    sixd = rotation.unflatten(-1, (N_JOINTS, 6))
    hidden = distributed.drawn(torch.rand_like, sixd[:, 0, :, 0]) < HIDDEN_SHARE
    hidden[:, codes.joints[0]] = False
    shown = sixd.masked_fill(hidden[:, None, :, None], HIDDEN) if training else sixd
    latent, codebook = codes.encode(shown.flatten(-2), encoded)
    made = codes.decode(latent)[:, -1].unflatten(-1, (-1, 6))
    errors = half_errors(net, codes.joints, made, frames[:, -1], sixd[:, -1])
    return {name: CODE_WEIGHTS[name] * term for name, term in (errors | {"codebook": codebook}).items()}


def half_errors(
    net: SAGENet, joints: tuple[int, ...], made: Tensor, frame: Tensor, true: Tensor
) -> dict[str, Tensor]:
    """Return errors of a half's rotations and of its joints by forward kinematics (smooth L1).

    A half contains all ancestors of its joints, so the other joints' rotations do not matter.

    Args:
        net: the network, whose space the rotations are in.
        joints: the half's joints.
        made: the half's predicted rotations (B, J, 6).
        frame: world frames (B, 252).
        true: the true rotations (B, 22, 6) of all joints.
    """
    sparse, own = frame[:, None, :SPARSE_DIM], list(joints)
    full = true.clone()
    full[:, own] = made.to(true)
    motions = [net.normalizer.posed(sixd.flatten(-2)[:, None], sparse) for sixd in (full, true)]
    bodies = [Body(motion, net.normalizer) for motion in motions]
    with in_float32(frame.device):
        (found, placed), (expected, true_placed) = [(one.sixd, one.posed[1]) for one in bodies]
    errors = {
        "orientation": F.smooth_l1_loss(found[..., ROOT, :], expected[..., ROOT, :]),
        "rotation": F.smooth_l1_loss(found[..., own[1:], :], expected[..., own[1:], :]),
        "position": F.smooth_l1_loss(placed[..., own, :], true_placed[..., own, :]),
    }
    if set(HANDS) <= set(joints):
        head, *hands = sparse[..., SPARSE_POSITION].unflatten(-1, (-1, 3)).unbind(-2)
        moved = placed + (head - placed[..., HEAD, :])[..., None, :]
        errors["hand"] = F.smooth_l1_loss(moved[..., list(HANDS), :], torch.stack(hands, -2))
    return errors


def upper_losses(net: SAGENet, codes: HalfVQVAE, frames: Tensor, training: bool) -> dict[str, Tensor]:
    """Return the error of the upper half's latents (smooth L1); see `code_losses` for the arguments."""
    rotation, encoded = seen(net, frames)
    clean = latents(codes, rotation, encoded)
    if not training:
        return {"latent": F.smooth_l1_loss(net.upper_latent(encoded), clean)}
    noisy, time, hidden = noised(net, clean)
    return {"latent": F.smooth_l1_loss(net.upper(noisy, time, encoded, hidden), clean)}


def lower_losses(net: SAGENet, codes: HalfVQVAE, frames: Tensor, training: bool) -> dict[str, Tensor]:
    """Return the error of the lower half's latents (smooth L1), given sampled latents of the upper half."""
    rotation, encoded = seen(net, frames)
    clean = latents(codes, rotation, encoded)
    with torch.no_grad():
        upper = net.upper_latent(encoded)
    if not training:
        return {"latent": F.smooth_l1_loss(net.lower_latent(upper, encoded), clean)}
    noisy, time, hidden = noised(net, clean)
    found = net.lower(net.lower.joined(noisy, upper), time, encoded, hidden)
    return {"latent": F.smooth_l1_loss(found, clean)}


LATENT_LOSSES = {"upper": upper_losses, "lower": lower_losses}


def seen(net: SAGENet, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return world windows (B, T, 252) in network space: rotations (B, T, 132) and inputs (B, T, 54)."""
    sparse, motion = net.normalizer.encode(frames).tensor_split([SPARSE_DIM], -1)
    return motion[..., ROTATION], sparse


@torch.no_grad()
def latents(codes: HalfVQVAE, rotation: Tensor, encoded: Tensor) -> Tensor:
    """Return a trained VQ-VAE's latents (B, T // 2, 384) of rotations (B, T, 132) and inputs (B, T, 54).

    They are computed in float32 in a mixed-precision training, too: rounded ones have other code-vectors.
    """
    assert not codes.training
    with in_float32(rotation.device):
        return codes.encode(rotation, encoded)[0]


def noised(net: SAGENet, clean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return noisy latents (B, T // 2, 384), their random times (B,), and random hidden joints (B, 22)."""
    time = distributed.drawn(net.diffusion.random_times, clean)
    noisy = net.diffusion.noised(clean, time, distributed.drawn(torch.randn_like, clean))
    drawn = distributed.drawn(lambda like: torch.rand_like(like[:, 0, :HIDDEN_COUNT]), clean) * N_JOINTS
    return noisy, time, F.one_hot(drawn.long(), N_JOINTS).sum(1) > 0
