"""RecurrentPoser, this project's network: a recurrent stream of poses, without a window."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, one_of, setting, sized
from memmlp.motion.body import N_JOINTS, ROTATION, SPARSE_DIM
from memmlp.motion.geometry import forward_kinematics, matrix_to_sixd, sixd_to_matrix
from memmlp.motion.normalizer import Normalizer, use_float32
from memmlp.networks.layers import apply_gru_gates
from memmlp.networks.limb_solver import bend_arms_to_trackers, use_tracker_rotations
from memmlp.networks.motion_model import State, TrainingOutputs, WindowlessModel
from memmlp.networks.recurrent_graph import RecurrentPoserGraph
from memmlp.networks.settings import NetworkSettings

SHORTEST, LONGEST = 0.9, 0.999
"""The smallest fraction of its state that an untrained LRU's first and last unit keep from frame to frame."""


class RecurrentCell(nn.Module):
    """The interface of recurrent cells, which have d inputs and d outputs.

    `forward` processes a sequence, for training. `step` processes one frame of joined cells, for live use
    (`memmlp.networks.recurrent_graph`). Both give equal results.

    Args:
        width: d.

    Attributes:
        carried: number of values that each of the d units carries from frame to frame.
    """

    carried: ClassVar[int] = 1

    def __init__(self, width: int):
        super().__init__()

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Run over inputs (B, n, d) from a state (B, carried x d).

        Returns:
            Outputs (B, n, d), and the state after the last input.
        """
        raise NotImplementedError

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Process inputs (cells, 1, d) with states (cells, 1, carried x d); return outputs and new states."""
        raise NotImplementedError


class GRUCell(RecurrentCell):
    """A gated recurrent unit (Cho et al. 2014)."""

    def __init__(self, width: int):
        super().__init__(width)
        self.layer = nn.GRU(width, width, batch_first=True)

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        outputs, after = self.layer(x, state[None].contiguous())
        return outputs, after[0]

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        entering, again = self.layer(x, state)
        state = apply_gru_gates(entering, again, state)
        return state, state


class LSTMCell(RecurrentCell):
    """A long short-term memory (Hochreiter & Schmidhuber 1997) with the state [hidden, cell]."""

    carried = 2

    def __init__(self, width: int):
        super().__init__(width)
        self.layer = nn.LSTM(width, width, batch_first=True)

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        hidden, cell = (part[None].contiguous() for part in state.chunk(2, -1))
        outputs, after = self.layer(x, (hidden, cell))
        return outputs, torch.cat(after, -1)[0]

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        hidden, cell = state.chunk(2, -1)
        entering, again = self.layer(x, hidden)
        enter, keep, new, show = (entering + again).chunk(4, -1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(enter) * torch.tanh(new)
        hidden = torch.sigmoid(show) * torch.tanh(cell)
        return hidden, torch.cat([hidden, cell], -1)


def scan_linear_recurrence(keep: Tensor, new: Tensor, state: Tensor) -> Tensor:
    """Return h_t = keep_t h_(t-1) + new_t for all frames, computed in log2(n) passes.

    Each pass doubles the number of past frames in h (Hillis & Steele 1986).

    Args:
        keep: the fraction of each unit's state that is kept (B, n, d).
        new: the values added to the kept state (B, n, d).
        state: h before the first frame (B, d).

    Returns:
        (B, n, d).
    """
    keep, h = F.pad(keep, (0, 0, 1, 0)), torch.cat([state[:, None], new], 1)
    held = 1
    while held < h.shape[1]:
        h = h + keep * F.pad(h[:, :-held], (0, 0, held, 0))
        keep = keep * F.pad(keep[:, :-held], (0, 0, held, 0))
        held *= 2
    return h[:, 1:]


class LinearCell(RecurrentCell):
    """The base class of cells that are linear in their state; training computes all frames at once."""

    def compute_gates(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map inputs (..., d) to the kept fraction of the state and to the added values, both (..., d)."""
        raise NotImplementedError

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        h = scan_linear_recurrence(*self.compute_gates(x), state)
        return h, h[:, -1]

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        keep, new = self.compute_gates(x)
        state = keep * state + new
        return state, state


class MinGRU(LinearCell):
    """A minimal GRU: gate and candidate depend only on the input (Feng et al. 2024)."""

    def __init__(self, width: int):
        super().__init__(width)
        self.linear = nn.Linear(width, 2 * width)

    def compute_gates(self, x: Tensor) -> tuple[Tensor, Tensor]:
        gate, new = self.linear(x).chunk(2, -1)
        update = torch.sigmoid(gate)
        return 1 - update, update * new


class LRU(LinearCell):
    """A real-gated linear recurrent unit (De et al. 2024), with a learned decay for each unit."""

    def __init__(self, width: int):
        super().__init__(width)
        self.linear = nn.Linear(width, 3 * width)
        rate = -torch.linspace(SHORTEST, LONGEST, width).log()
        self.decay = nn.Parameter(rate.expm1().log())  # softplus makes the rate of it

    def compute_gates(self, x: Tensor) -> tuple[Tensor, Tensor]:
        forget, enter, new = self.linear(x).chunk(3, -1)
        keep = torch.exp(-F.softplus(self.decay) * torch.sigmoid(forget))
        room = (1 - keep.square()).clamp_min(1e-6).sqrt()  # keeps the state's variance that of its inputs
        return keep, room * torch.sigmoid(enter) * new


CELLS: dict[str, type[RecurrentCell]] = {"gru": GRUCell, "lstm": LSTMCell, "mingru": MinGRU, "lru": LRU}
"""The cells by their names in the config."""


class RecurrentBlock(nn.Module):
    """A recurrent cell over time, then a two-layer MLP over the channels, both pre-norm and residual.

    Args:
        cell: the recurrent cell of d inputs and outputs.
        width: d.
        expansion: the MLP's hidden width, as a multiple of d.
    """

    def __init__(self, cell: RecurrentCell, width: int, expansion: int):
        super().__init__()
        self.cell_norm, self.cell = nn.LayerNorm(width), cell
        self.norm = nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, expansion * width), nn.SiLU(), nn.Linear(expansion * width, width)
        )

    def forward(self, h: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Map a sequence (B, n, d) to the same shape; return it and the new state."""
        x = self.cell_norm(h)
        with use_float32(h.device):  # a state adds up what bfloat16 rounds
            outputs, state = self.cell(x.float() if x.dtype == torch.bfloat16 else x, state)
        h = h + outputs
        return h + self.mlp(self.norm(h)), state

    def step(self, h: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Map one frame of joined blocks (blocks, 1, d) to the same shape; return it and the new states."""
        outputs, state = self.cell.step(self.cell_norm(h), state)
        h = h + outputs
        return h + self.mlp(self.norm(h)), state


class EnsembleMember(nn.Module):
    """A network of the ensemble: linear stem, residual blocks and linear head, from inputs to rotations.

    Args:
        settings: width, depth, cell and expansion of the blocks.
    """

    def __init__(self, settings: RecurrentPoserSettings):
        super().__init__()
        width, cell = settings.width, CELLS[settings.cell]
        self.stem = nn.Linear(SPARSE_DIM, width)
        self.blocks = nn.ModuleDict(
            {
                f"block{i}": RecurrentBlock(cell(width), width, settings.expansion)
                for i in range(1, settings.depth + 1)
            }
        )
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, ROTATION.stop)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Map encoded inputs (B, n, 54) to rotations (B, n, 132) and the new state.

        The names of the states, each (B, carried x d), are the blocks' names.
        """
        h, kept = self.stem(x), {}
        for name, block in self.blocks.items():
            h, kept[name] = block(h, state[name])
        return self.head(self.norm(h)), kept


def compute_mean_pose(normalizer: Normalizer) -> Tensor:
    """Return the global rotations (132,), 6D, of the mean pose in the network's coordinates.

    They are zeros without z-scores (`normalizer.z_scores=false`).
    """
    local = sixd_to_matrix(normalizer.mean[SPARSE_DIM:][ROTATION].unflatten(-1, (N_JOINTS, 6)))
    rotations, _ = forward_kinematics(local, torch.zeros_like(normalizer.rest[0]), normalizer.rest)
    return matrix_to_sixd(rotations).flatten()


@component("model", "recurrent_poser", version=3, builds="RecurrentPoser")
@dataclass
class RecurrentPoserSettings(NetworkSettings):
    """RecurrentPoser, this project's network: residual blocks of a recurrent cell and an MLP.

    It is a recurrent stream without a window. It predicts rotations; positions follow by forward kinematics,
    with the head on its tracker. The learning rate is the best of four at profile=small. Weight decays from
    0.05 to 0.5 give similar MPJRE; higher ones reduce Jitter (docs/guides/recurrent-poser.md).
    """

    # T, the number of frames in a training window, from a zero state; live there is no window
    frames: int = setting(at_least(2), tiny=11, small=21, paper=120)
    # number of networks in the ensemble; each is trained separately, and their rotations are averaged
    members: int = setting(at_least(1), tiny=2, small=3, paper=2)
    # d, the width of the hidden state and the cells of each network in the ensemble
    width: int = setting(at_least(1), tiny=16, small=128, paper=160)
    # number of blocks in each network of the ensemble
    depth: int = setting(at_least(1), tiny=2, small=4, paper=2)
    # the recurrent cell; mingru and lru have linear recurrences, so training computes all frames in parallel
    cell: str = setting(one_of("gru", "lstm", "mingru", "lru"), "gru")
    # global: rotations in the network's space; reaching: global rotations, with arms that reach the hand
    # trackers; local: rotations relative to the parent joints
    output: str = setting(one_of("local", "global", "reaching"), "reaching")
    expansion: int = setting(at_least(1), 1)  # hidden width of the blocks' MLPs as a multiple of the width d

    carries_state: ClassVar[bool] = True
    defaults: ClassVar = {"loss": "calm", "optim": "muon"}
    recipe: ClassVar = {
        "optim.batch": sized(8, 64, 256),
        "optim.lr": 8.0e-3,
        "optim.warmup": sized(0, 0.05, 1 / 300),
        "optim.weight_decay": sized(0.3, 0.3, 2.0e-3),
        "normalizer.coordinates": "heading",
        "normalizer.z_scores": True,
    }

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        yield from super().problems(config)
        output, ik = config["model"]["output"], config["evaluation"]["ik"]
        if ik == "arms" and output == "reaching" and config["refiner"] is None:  # a refiner moves arms again
            yield "evaluation.ik=arms: must be off, since model.output=reaching already moves the arms"


class RecurrentPoser(WindowlessModel):
    """RecurrentPoser: an ensemble of recurrent networks with averaged rotations.

    The ensemble's networks (members) are trained separately: each has losses on its own motion. Positions
    follow from the rotations by forward kinematics with the head on its tracker. The cells' states are its
    only information about the past; it does not see its own outputs. Training runs over T frames from a zero
    state, like the start of a live stream.
    """

    graph = RecurrentPoserGraph

    def __init__(self, normalizer: Normalizer, settings: RecurrentPoserSettings):
        super().__init__(normalizer, settings.frames)
        self.output = settings.output
        members = range(1, settings.members + 1)
        self.members = nn.ModuleDict({f"member{i}": EnsembleMember(settings) for i in members})
        size = CELLS[settings.cell].carried * settings.width
        self.sizes = {f"member{i}_block{j}": size for i in members for j in range(1, settings.depth + 1)}
        if self.output != "local":
            # Trainings that begin at random rotations, far from the mean pose, leave legs turned wrongly.
            for member in cast(Iterable[EnsembleMember], self.members.values()):
                member.head.weight.data *= 0.3
                member.head.bias.data.copy_(compute_mean_pose(normalizer))

    def initial_state(self, batch: int = 1) -> State:
        """Return the initial state: zeros (B, size) for each cell, by names of member and block."""
        return {name: self.normalizer.mean.new_zeros(batch, size) for name, size in self.sizes.items()}

    def pose(self, outputs: Tensor, sparse: Tensor, reach: bool = True) -> Tensor:
        """Map a member's outputs (..., 132) to world motion (..., 198), given inputs (..., 54).

        With `model.output=reaching` the arms reach to the hands' trackers if `reach` is set. Global rotations
        do not inherit errors from a joint's ancestors. Positions are sums of rotated bones.
        """
        if self.output == "local":
            return self.normalizer.decode_rotations(outputs, sparse)
        with use_float32(outputs.device):
            rotations = self.normalizer.convert_rotations_to_world(
                outputs.to(sparse.dtype), self.normalizer.find_origin(sparse)
            )
            if not (reach and self.output == "reaching"):
                return self.normalizer.build_world_motion(rotations, sparse)
            rotations = use_tracker_rotations(rotations, sparse)
            return self.normalizer.build_world_motion(rotations, sparse, bend_arms_to_trackers)

    def predict_members(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the rotations of each member (members, B, n, 132), and the new state.

        Args:
            sparse: world inputs (B, n, 54).
            state: the state before these frames.
        """
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.find_origin(sparse))
        members: list[Tensor] = []
        kept: State = {}
        for name, member in self.members.items():
            member_state = {key.removeprefix(f"{name}_"): value for key, value in state.items()}
            rotations, after = member(encoded, member_state)
            members.append(rotations)
            kept |= {f"{name}_{block}": value for block, value in after.items()}
        return torch.stack(members), kept

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        rotations, kept = self.predict_members(sparse, state)
        start = sparse.shape[1] - (sparse.shape[1] if newest is None else newest)
        return self.pose(rotations[:, :, start:].mean(0), sparse[:, start:]), kept

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Return each member's motion, one after the other (members x B, T, 198); see MotionModel.

        The arms do not reach for the trackers here. Losses after reaching gave larger errors of rotations and
        positions.
        """
        rotations, kept = self.predict_members(sparse, state)
        motion = self.pose(rotations, sparse.expand(len(rotations), -1, -1, -1), reach=False)
        return TrainingOutputs(motion.flatten(0, 1), kept, {})
