"""All computations from trackers to a body as one ONNX file, for programs without Python (`--scope full`).

docs/guides/onnx.md describes the inputs and outputs. `memmlp.live.stream` does the same in Python, and also
handles lost trackers, other rates and gaps. NaN inputs give NaN outputs.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.deploy.export import export_module, make_metadata
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.opsets import NATIVE
from memmlp.deploy.parity import stream_torch
from memmlp.live.rotations import BodyTree, quaternion_to_matrix
from memmlp.live.spaces import Space, find_space
from memmlp.motion.body import (
    HEAD,
    N_JOINTS,
    POSITION,
    ROTATION,
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
)
from memmlp.motion.geometry import compute_sparse_features, sixd_to_matrix
from memmlp.networks.motion_model import MotionModel, StreamingGraph

INPUTS = ("tracker_positions", "tracker_rotations")
OUTPUTS = ("rotations", "positions", "joints")
UNIT = 1e-4  # how far a quaternion's norm may be from 1
OWN = {"seen": (1, 1), "positions": (1, 3, 3), "rotations": (1, 3, 3, 3)}
"""Additional states: whether there was an earlier frame, and the trackers of that frame in AMASS' world."""


def convert_to_quaternions(rotations: Tensor) -> Tensor:
    """Convert matrices (..., 3, 3) to unit quaternions (..., 4), xyzw, w not negative; accurate everywhere,
    and equal to `memmlp.motion.geometry.matrix_to_wxyz`. The best-conditioned of four formulas is selected by
    pairwise comparisons, which do not need a computed index."""
    m = rotations.flatten(-2).split(1, -1)
    xx, yy, zz = m[0], m[4], m[8]
    wx, wy, wz = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    xy, xz, yz = m[1] + m[3], m[2] + m[6], m[5] + m[7]
    pivots = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz]
    ww, xx, yy, zz = pivots
    rows = [wx, wy, wz, ww], [xx, xy, xz, wx], [xy, yy, yz, wy], [xz, yz, zz, wz]
    largest, chosen = pivots[0], torch.cat(rows[0], -1)
    for pivot, row in zip(pivots[1:], rows[1:], strict=True):
        chosen = torch.where(pivot > largest, torch.cat(row, -1), chosen)
        largest = torch.where(pivot > largest, pivot, largest)
    chosen = chosen * torch.where(chosen[..., 3:] < 0, -1.0, 1.0)
    return chosen / (chosen * chosen).sum(-1, keepdim=True).sqrt()


FORMATS: dict[str, Callable[[Tensor], Tensor]] = {
    "matrix": lambda matrices: matrices,
    "quaternion": convert_to_quaternions,
}
"""The formats of output rotations, by name."""


class FullStep(nn.Module):
    """The step of one frame from trackers to joints, with flat inputs and outputs in the frame of reference
    `space`. `output` converts rotation matrices; a value of FORMATS."""

    world: Tensor
    body: Tensor
    bones: Tensor

    def __init__(self, model: MotionModel | StreamingGraph, space: Space, output: Callable[[Tensor], Tensor]):
        super().__init__()
        self.model, self.output = model, output
        self.names = list(model.initial_state(1))
        self.register_buffer("world", torch.tensor(space.world, dtype=torch.float32))
        self.register_buffer("body", torch.tensor(space.body, dtype=torch.float32))
        tree = BodyTree(model.normalizer.rest.double().cpu().numpy())
        self.ancestors = [torch.tensor(ancestor) for ancestor in tree.ancestors]
        self.register_buffer("bones", torch.tensor(tree.bone_offsets, dtype=torch.float32)[None, ..., None])

    def initial_state(self) -> dict[str, Tensor]:
        own = {f"trackers.{name}": torch.zeros(shape) for name, shape in OWN.items()}
        return own | self.model.initial_state(1)

    def forward(self, positions: Tensor, rotations: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Return rotations, positions and joints, then the new states."""
        seen, last_positions, last_rotations = state[: len(OWN)]
        positions = positions @ self.world.T
        rotations = self.world @ rotations * self.body
        past = seen > 0
        sparse = compute_sparse_features(
            torch.cat([torch.where(past[..., None, None], last_rotations, rotations), rotations]),
            torch.cat([torch.where(past[..., None], last_positions, positions), positions]),
        )
        before = dict(zip(self.names, state[len(OWN) :], strict=True))
        motion, after = self.model.advance_frame(sparse, before)
        # The first frame does not have velocities. It gives a pose, but does not change the network's state,
        # like in training.
        kept = [after[name] * seen.view(-1, *[1] * (after[name].ndim - 1)) for name in self.names]
        pose = self.convert_outputs(motion, positions[:, 0])
        return *pose, seen.clamp_min(1), positions, rotations, *kept

    def convert_outputs(self, motion: Tensor, head: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return rotations, positions and joints in the graph's frame of reference, for world motion (1, 198)
        and the head tracker's position (1, 3), metres, AMASS' world."""
        local = sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))
        # Forward kinematics like in `BodyTree.compute_positions`: a graph runs few operations on large arrays
        # faster than many small operations.
        bottom = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(1, N_JOINTS, 1, 4)
        transforms = torch.cat([torch.cat([local, self.bones], -1), bottom], -2)
        transforms = torch.cat([transforms, torch.eye(4).expand(1, 1, 4, 4)], 1)
        for ancestor in self.ancestors:
            transforms = transforms.index_select(1, ancestor) @ transforms
        reached = transforms[:, :N_JOINTS, :3, 3]
        positions = reached + (head - reached[:, HEAD])[:, None]
        joints = motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))
        root = self.world.T @ local[:, :1] * self.body
        turned = torch.cat([root, local[:, 1:] * torch.outer(self.body, self.body)], 1)
        return self.output(turned), positions @ self.world, joints @ self.world


def export_full(
    model: MotionModel | StreamingGraph,
    path: Path,
    run_id: str,
    space: str = "amass",
    rotations: str = "matrix",
    opset: int = NATIVE,
) -> None:
    """Write the full step and its metadata as one ONNX file for the CPU in float32. Raises InputError for an
    unknown space or rotation format, or an opset that does not support the step."""
    if rotations not in FORMATS:
        raise InputError(f"rotations={rotations}: must be one of {', '.join(FORMATS)}")
    step = FullStep(model.cpu().eval(), find_space(space), FORMATS[rotations]).eval()
    state = step.initial_state()
    names = [f"state.{name}" for name in state]
    export_module(
        step,
        (torch.zeros(1, 3, 3), torch.eye(3).expand(1, 3, 3, 3), *state.values()),
        [*INPUTS, *names],
        [*OUTPUTS, *(f"{name}.next" for name in names)],
        path,
        make_metadata(model, run_id) | {"scope": "full", "space": space, "rotations": rotations},
        opset,
    )


def extract_trackers(frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return tracker positions (N + 1, 3, 3) and rotations (N + 1, 3, 3, 3) of frames (N, 252 or 54). The
    first entry is the time step before the first frame, which gives the first frame's velocities."""
    sixd = frames[:, SPARSE_ROTATION].unflatten(-1, (3, 6))
    turned = sixd_to_matrix(frames[:1, SPARSE_ANGULAR_VELOCITY].unflatten(-1, (3, 6)))
    rotations, positions = sixd_to_matrix(sixd), frames[:, SPARSE_POSITION].unflatten(-1, (3, 3))
    velocity = frames[:1, SPARSE_VELOCITY].unflatten(-1, (3, 3))
    before = rotations[:1] @ turned.transpose(-1, -2)
    return torch.cat([positions[:1] - velocity, positions]), torch.cat([before, rotations])


def measure_full_graph_differences(
    model: MotionModel, path: Path, clip: Tensor, space: str = "amass"
) -> Tensor:
    """Return each frame's largest difference (N,) between torch and an ONNX file over a clip (N, 252). Each
    uses its own history. torch computes the same as evaluation: features, network and
    `Normalizer.compute_positions`. If a quaternion does not have length 1, all differences are infinity."""
    positions, rotations = extract_trackers(clip[:, :SPARSE_DIM].cpu())
    sparse, reference = compute_sparse_features(rotations, positions), find_space(space)
    stream = OnnxStream(path)
    motion = stream_torch(model.cpu().eval(), sparse)
    local = sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6))).numpy()
    predicted = motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))
    joints = (model.normalizer.compute_positions(motion, sparse), predicted)
    expected = [reference.convert_positions_from_amass(part.numpy()) for part in joints]
    expected.insert(0, reference.convert_pose_from_amass(local))
    inputs = (
        reference.convert_positions_from_amass(positions.numpy()),
        reference.convert_rotations_from_amass(rotations.numpy()),
    )
    steps = [stream.step(*(part[index : index + 1] for part in inputs)) for index in range(len(clip) + 1)]
    outputs = [np.concatenate(parts)[1:] for parts in zip(*steps, strict=True)]  # without the step before
    if outputs[0].shape[-1] == 4:
        if not np.abs(np.linalg.norm(outputs[0], axis=-1) - 1).max() <= UNIT:
            return torch.full((len(clip),), torch.inf)
        outputs[0] = quaternion_to_matrix(outputs[0].astype(np.float64))
    apart = [np.abs(one - other).reshape(len(one), -1) for one, other in zip(outputs, expected, strict=True)]
    return torch.from_numpy(np.concatenate(apart, 1).max(1))
