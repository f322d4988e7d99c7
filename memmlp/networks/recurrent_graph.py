"""RecurrentPoser's streaming graph, with few operations: small ones take most of a step's time.

One product computes a layer of all members. The affine maps of norms are part of the layers that follow.
"""

import copy
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from memmlp.motion.body import N_JOINTS, PARENTS, SPARSE_DIM, SPARSE_POSITION, SPARSE_ROTATION, TRACKED
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.limb_solver import (
    BONE_ENDS,
    BONE_STARTS,
    OFFSET,
    SHOULDERS,
    dot,
    place_elbows_and_wrists,
)
from memmlp.networks.motion_model import State, StreamingGraph
from memmlp.networks.streaming import OneFrameNormalizer, make_linear, with_one

PREDICTED = [joint for joint in range(N_JOINTS) if joint not in TRACKED]
"""The joints without trackers. With reaching arms, only their rotations are predicted."""


class JoinedLinear(nn.Module):
    """Linear layers with weights (m, n) and biases (m,) as one product: (layers, 1, n) to (layers, 1, m)."""

    def __init__(self, weights: Iterable[Tensor], biases: Iterable[Tensor]):
        super().__init__()
        self.weight = nn.Parameter(torch.stack([weight.T for weight in weights]))
        self.bias = nn.Parameter(torch.stack([bias[None] for bias in biases]))

    def forward(self, x: Tensor) -> Tensor:
        return x @ self.weight + self.bias


class JoinedGates(nn.Module):
    """What inputs and hidden states, both (layers, 1, d), each add to the gates of GRU or LSTM layers."""

    def __init__(self, layers: Sequence[Any]):
        super().__init__()
        of_input, of_state, input_bias, state_bias = zip(*(rnn.all_weights[0] for rnn in layers), strict=True)
        self.entering, self.again = JoinedLinear(of_input, input_bias), JoinedLinear(of_state, state_bias)

    def forward(self, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        return self.entering(x), self.again(hidden)


def join(modules: Sequence[Any]) -> Any:
    """Return one module that computes several modules of the same form, on (modules, 1, n)."""
    if isinstance(modules[0], nn.RNNBase):
        return JoinedGates(modules)
    if isinstance(modules[0], nn.Linear):
        return JoinedLinear((one.weight for one in modules), (one.bias for one in modules))
    joined = copy.deepcopy(modules[0])
    for name, _ in modules[0].named_children():
        setattr(joined, name, join([getattr(module, name) for module in modules]))
    for name, _ in modules[0].named_parameters(recurse=False):
        setattr(joined, name, nn.Parameter(torch.stack([getattr(module, name)[None] for module in modules])))
    return joined


def fold_norm(module: nn.Module, name: str, layer: nn.Module) -> None:
    """Move the affine map of a module's norm to the layer that follows it (linear, GRU or LSTM)."""
    norm, suffix = getattr(module, name), "_ih_l0" if isinstance(layer, nn.RNNBase) else ""
    weight, bias = layer.get_parameter(f"weight{suffix}"), layer.get_parameter(f"bias{suffix}")
    bias.add_(weight @ norm.bias)
    weight.mul_(norm.weight)
    # Two axes: ONNX Runtime would fuse a sum and a norm of one axis to a slower operator.
    setattr(module, name, nn.LayerNorm((1, *norm.normalized_shape), elementwise_affine=False))


class ReachingPose(nn.Module):
    """The world motion of one frame, with arms that reach the hand trackers: see `bend_arms_to_trackers`.

    A body's rotations are rows (3 x 22, 3): first columns, second columns, third columns. Before the arms
    bend, points and bones are linear in these rows, so one product gives them. An arm's bones take the
    smallest rotations. Each is two reflections; the first, along the bone, is linear too.
    """

    def __init__(self, normalizer: Normalizer):
        super().__init__()
        rest, parents = normalizer.rest, list(PARENTS[1:])
        rows = torch.tensor([*PREDICTED, *TRACKED]).argsort() + N_JOINTS * torch.arange(3)[:, None]
        columns = torch.eye(3 * N_JOINTS).to(rest)[rows]  # each column (3, 22) as a sum of rows, as all below
        joints = normalizer.chains @ ((rest[1:] - rest[parents]).T[..., None] * columns[:, parents]).sum(0)
        arms, bones = (points[BONE_ENDS] - points[BONE_STARTS] for points in (rest, joints))
        side = bones[:2] - OFFSET * columns[2, SHOULDERS]
        lengths = arms.norm(dim=-1, keepdim=True)
        self.upper, self.lower = lengths[:2], lengths[2:]
        arms, bones, shoulders = arms / lengths, bones / lengths, joints[SHOULDERS]
        reflected = columns[:, BONE_STARTS] - 2 * arms.T[..., None] * bones
        parts = [joints[: BONE_ENDS.start], shoulders, shoulders, -shoulders, side, bones.repeat(3, 1)]
        self.points = nn.Parameter(torch.cat([*parts, reflected.flatten(0, 1)]))
        self.sizes = [BONE_ENDS.start, 4, 2, 2, 12, 12]
        # The head's tracker moves all points, and a hand's tracker its goal.
        head = SPARSE_POSITION.start // 3
        trackers = torch.zeros(len(self.points), SPARSE_DIM // 3).to(rest)
        trackers[:N_JOINTS, head] = 1
        trackers[N_JOINTS : N_JOINTS + 2, head : head + 3] = torch.tensor([[-1.0, 1, 0], [-1, 0, 1]])
        self.trackers = nn.Parameter(trackers)
        bend = torch.eye(4).to(rest)  # elbows and wrists to unit bones
        bend[2:, :2] = -bend[:2, :2]
        self.bend = nn.Parameter((bend / lengths).repeat(3, 1))
        # Local rotations are products of columns: of each joint's first two with its parent's three.
        rows[:, BONE_STARTS] = rows.numel() + torch.arange(12).view(3, 4)  # the arms after bending
        pairs = rows[:2, 1:].T[..., None] * (rows.numel() + 12) + rows[:, parents].T[:, None]
        self.pairs = pairs.flatten()
        axes = torch.eye(3).to(rest)  # for cross products
        self.one, self.two = (
            nn.Parameter(axes[:, [1, 2, 0, 2, 0, 1]]),
            nn.Parameter(axes[:, [2, 0, 1, 1, 2, 0]]),
        )
        self.signs = nn.Parameter(torch.cat([axes, -axes]))

    def forward(self, predicted: Tensor, sparse: Tensor) -> Tensor:
        """Return world motion (1, 198).

        Args:
            predicted: 6D (2 x 19, 3) of the joints without trackers, global rotations, world.
            sparse: world inputs (1, 54).
        """
        seen = sparse.view(-1, 3)
        columns = self.complete_rotations(torch.cat([predicted, seen[: SPARSE_ROTATION.stop // 3]]))
        points = torch.addmm(self.trackers @ seen, self.points, columns)
        fixed, shoulders, goal, side, bones, reflected = points.split(self.sizes)
        bent = torch.cat(place_elbows_and_wrists(goal, side, self.upper, self.lower))
        both = torch.addmm(bones, self.bend, bent)
        arms = reflected - dot(reflected, both) / dot(bones, both).clamp_min(1e-6) * both
        columns = torch.cat([columns, arms])
        local = (columns @ columns.T).view(-1).index_select(0, self.pairs).view(-1, 3)
        return torch.cat([predicted[:2], local, fixed, shoulders + bent]).view(1, -1)

    def complete_rotations(self, sixd: Tensor) -> Tensor:
        """Return the columns (3 x n, 3) of the rotations of 6D (2 x n, 3); see `sixd_to_matrix`."""
        first, second = sixd.view(-1, 6).split(3, -1)
        third = self.cross(first, second)
        columns = torch.cat([first, self.cross(third, first), third])
        return columns / columns.norm(dim=-1, keepdim=True).clamp_min(1e-12)

    def cross(self, one: Tensor, other: Tensor) -> Tensor:
        """Return the cross products (n, 3) of vectors (n, 3)."""
        return ((one @ self.one) * (other @ self.two)) @ self.signs


class RecurrentPoserGraph(StreamingGraph):
    """RecurrentPoser's streaming graph.

    When the graph is quantised, only the cells become int8. A cell's state averages rounding errors over many
    frames, but rounding in the MLPs would show as jitter.
    """

    normalizer: OneFrameNormalizer
    joined: Any
    pose: ReachingPose

    def build(self, model: Any) -> None:
        self.normalizer = model.normalizer = OneFrameNormalizer(model.normalizer)
        members = list(model.members.values())
        for member in members:
            for block in member.blocks.values():
                fold_norm(block, "cell_norm", next(block.cell.children()))
                fold_norm(block, "norm", block.mlp[0])
            fold_norm(member, "norm", member.head)
        weight = torch.cat([member.head.weight for member in members], 1) / len(members)
        bias = torch.stack([member.head.bias for member in members]).mean(0)
        if model.output == "reaching":
            weight, bias = (part.unflatten(0, (-1, 6))[PREDICTED].flatten(0, 1) for part in (weight, bias))
            self.pose = ReachingPose(model.normalizer)
        self.joined, self.head = join(members), make_linear(weight, bias)
        self.size = (len(members), 1, next(iter(model.sizes.values())))
        self.model, model.members, self.joined.head = model, None, None
        mlps = (f"joined.blocks.{name}.mlp" for name in self.joined.blocks)
        self.float32_modules = ("model.normalizer", "joined.stem", *mlps, "head", "pose")

    def windows(self) -> State:
        """Return zeros (members, 1, carried x d) for the blocks' cells."""
        return {name: torch.zeros(self.size).to(self.normalizer.mean) for name in self.joined.blocks}

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        turn = with_one(self.normalizer.coordinates.find_turn(sparse))
        h, kept = self.joined.stem(self.normalizer.encoder(sparse, turn)), {}
        for name, block in self.joined.blocks.items():
            h, kept[name] = block.step(h, state[name])
        rotations = self.head(self.joined.norm(h).view(1, -1))
        if self.model.output != "reaching":
            return self.model.pose(rotations, sparse), kept
        return self.pose(self.normalizer.turn_columns(rotations.view(-1, 3), turn), sparse), kept
