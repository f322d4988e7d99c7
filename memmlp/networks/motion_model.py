"""The interface of every network, and of its streaming graph, from which the live step is exported."""

from __future__ import annotations

import copy
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer

State = dict[str, Tensor]


class TrainingOutputs(NamedTuple):
    """What a training call returns.

    Attributes:
        motion: (B, n, 198) in the world, to be compared with the true motion of the window's last n frames. A
            network whose members each learn by themselves returns the motion of all members, one after the
            other: (members B, n, 198).
        state: the new state.
        losses: the network's own further losses, weighted, which are added to the motion's losses.
    """

    motion: Tensor
    state: State
    losses: dict[str, Tensor]


class MotionModel(nn.Module):
    """A network that takes in frames by calls of `advance`; the interface of all networks.

    Evaluation, export, timing and training use only this interface. In this base class a network sees a
    window, the last T frames, and its state is only the buffer of past inputs. WindowlessModel has no buffer.

    Args:
        normalizer: converts between the world and network space.
        frames: T, the window's length.

    Attributes:
        branches: the parts of the motion that are learned, out of "rotation" and "position"; positions that
            are not learned follow from the rotations.
        graph: the class of the streaming graph, or None. A subclass names its own, since it may compute
            something else than its base.
        shift: how many frames before the newest one the recalled past ends; 0 without a recalled past.
        settled: whether recalled values of a past frame never change, so that a live stream may keep them.
        windowless: whether the network is a stream in both evaluation modes; see WindowlessModel.
        is_stream: whether it needs no future frames; if it does, only window mode can evaluate it.
        takes_whole_clip: whether window mode passes a whole clip to `predict_clip`, which predicts all its
            windows together; they may overlap.
    """

    branches: frozenset[str] = frozenset({"rotation"})
    shift: int = 0
    settled: bool = True
    windowless: bool = False
    is_stream: bool = True
    takes_whole_clip: bool = False
    graph: ClassVar[type[StreamingGraph] | None] = None

    def __init__(self, normalizer: Normalizer, frames: int):
        super().__init__()
        self.normalizer = normalizer
        self.frames = frames

    @property
    def past_frames(self) -> int:
        """How many past frames of inputs the buffer holds; the last one directly precedes the new ones."""
        return self.frames - 1

    @property
    def stride(self) -> int:
        """By how many frames a training step moves on: the shift, or 1 for a network without a past."""
        return max(self.shift, 1)

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start, all zeros.

        At the first call the first frame's inputs stand for those of all frames before it.
        """
        state = {"sparse": torch.zeros(batch, self.past_frames, SPARSE_DIM), "started": torch.zeros(batch, 1)}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items()}

    def running_state(self, sparse: Tensor) -> State:
        """Return the state after world inputs (B, past, 54), without any history of motion yet."""
        fresh = self.initial_state(len(sparse))
        return fresh | {"sparse": sparse, "started": torch.ones_like(fresh["started"])}

    def true_state(self, frames: Tensor) -> State:
        """Return the state after true world frames [X | Theta] (B, past, 252), the truth as its history."""
        return self.running_state(frames[..., :SPARSE_DIM])

    def append_inputs(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Return past and new inputs together (B, past + n, 54), and the buffers after them.

        Args:
            sparse: new world inputs (B, n, 54).
            state: what the last call returned, or `initial_state`.
        """
        before = torch.where(state["started"][..., None] > 0, state["sparse"], sparse[:, :1])
        inputs = torch.cat([before, sparse], 1)
        return inputs, {"sparse": inputs[:, -self.past_frames :], "started": state["started"].clamp_min(1)}

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames.

        Args:
            sparse: world inputs (B, n, 54) of the n newest frames: n is 1 for a live stream, T for windows,
                and fewer at a clip's end.
            state: what the last call returned, or `initial_state`.
            newest: how many of the newest frames are wanted; by default all that the network predicts.

        Returns:
            Motion (B, newest, 198) in the world, of the frames that end with the newest one, and the new
            state.
        """
        raise NotImplementedError

    def predict_clip(self, sparse: Tensor) -> Tensor:
        """Map a clip's world inputs (N, 54), N >= T, to its world motion (N, 198); see `takes_whole_clip`."""
        raise NotImplementedError

    def training_call(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Make a training call; by default this is `advance`.

        Args:
            sparse: see `advance`.
            state: see `advance`.
            true_frames: world frames [X | Theta] (B, T, 252) of the window.
        """
        return TrainingOutputs(*self.advance(sparse, state), {})

    def count_parameters(self) -> int:
        """Count the trainable parameters; tables show this number in millions.

        A frozen VQ-VAE is not counted; one that is trained with the network is, its decoder included.
        """
        return sum(p.numel() for p in self.parameters() if p.requires_grad)


class WindowlessModel(MotionModel):
    """A network that carries all it knows of the past in its state; every live step takes the same work.

    `frames` is how many frames a training call takes in, from a fresh start. In both evaluation modes the
    network is a stream over the whole clip. By default `advance` returns the motion of the n new frames; more
    than these cannot be predicted.
    """

    windowless = True

    @property
    def past_frames(self) -> int:
        """How many past frames of inputs are kept in a buffer; 0 here."""
        return 0

    @property
    def stride(self) -> int:
        """By how many frames a training step moves on: by all that it takes in."""
        return self.frames

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start, all zeros; by default nothing is carried."""
        return {}

    def running_state(self, sparse: Tensor) -> State:
        """Return the state of a fresh start, since no earlier frames (B, 0, 54) are kept."""
        return self.initial_state(len(sparse))


class WindowModel(MotionModel):
    """The base of networks that map a whole window of inputs to its rotations (`predict_rotations`)."""

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        """Map inputs (B, T, 54) to rotations (B, T, 132), both in network space."""
        raise NotImplementedError

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames; see MotionModel.

        By default all T frames are returned. The work is always that of the whole window, as published.
        """
        inputs, kept = self.append_inputs(sparse, state)
        window = inputs[:, -self.frames :]
        rotation = self.predict_rotations(
            self.normalizer.encode_sparse(window, self.normalizer.origin(window))
        )
        wanted = self.frames if newest is None else newest
        return self.normalizer.posed(rotation[:, -wanted:], window[:, -wanted:]), kept


class NewestFrameModel(MotionModel):
    """The base of networks that predict every frame from the window that ends with it (`predict_rotations`).

    Both evaluation modes give the same numbers, to rounding.
    """

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) to their last frames' rotations (B, 132), both in network space."""
        raise NotImplementedError

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames; see MotionModel.

        By default the n new frames are returned, which are the most that this network can make.
        """
        inputs, kept = self.append_inputs(sparse, state)
        wanted = sparse.shape[1] if newest is None else newest
        ends = torch.arange(inputs.shape[1] - wanted, inputs.shape[1], device=inputs.device)
        window = ends[:, None] + torch.arange(1 - self.frames, 1, device=inputs.device)
        encoded = self.normalizer.encode_sparse(inputs, self.normalizer.origin(inputs))
        windows = torch.unflatten(encoded.index_select(1, window.flatten()), 1, window.shape)
        rotation = torch.unflatten(self.predict_rotations(windows.flatten(0, 1)), 0, (len(inputs), wanted))
        return self.normalizer.posed(rotation, inputs[:, -wanted:]), kept


def fill_past(earlier: Tensor, first: Tensor, fresh: Tensor) -> Tensor:
    """Return a window's earlier frames, which at a fresh start are all copies of the first frame.

    The carried frames are zeros then, so a sum is enough; a condition is not available in every runtime.

    Args:
        earlier: the carried frames (n, size).
        first: the copy that stands for earlier frames (1, size).
        fresh: 1 at a fresh start and 0 after it (1,).
    """
    return earlier + fresh * first


def slide_window(window: Tensor, entering: Tensor, before: Tensor, fresh: Tensor) -> Tensor:
    """Return a window (T, size) without its oldest frame and with a new one (1, size) at its end.

    At a fresh start `before` (1, size) stands for the frames before it; see `fill_past`.
    """
    return torch.cat([fill_past(window[1:], before, fresh), entering])


class StreamingGraph(nn.Module):
    """A network as a graph for one live stream, without gradients; the interface of all of them.

    Args:
        model: the trained network; the graph is made from a copy.

    Attributes:
        float32_modules: names of the modules that stay in float32 when the graph is quantised: those at the
            network's two ends, from the inputs to the hidden state and from there to the motion, and others
            whose rounding would be visible.
    """

    float32_modules: tuple[str, ...]

    def __init__(self, model: MotionModel):
        super().__init__()
        model = copy.deepcopy(model).eval().requires_grad_(False)
        self.frames, self.normalizer, self.branches = model.frames, model.normalizer, model.branches
        self.build(model)
        self.requires_grad_(False)

    @classmethod
    def fits(cls, model: MotionModel) -> bool:
        """Return whether this graph can stream this very model: its memory, its sizes."""
        return True

    def build(self, model: Any) -> None:
        """Make the graph's parts from a copy of the network."""
        raise NotImplementedError

    def windows(self) -> State:
        """Return the state of a fresh start, without the count of steps: zeros."""
        raise NotImplementedError

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start, all zeros.

        At the first call the first frame stands for all frames before it.

        Args:
            batch: must be 1. Without a batch axis, windows (T, size) are exported to fewer operations.
        """
        assert batch == 1
        state = {"count": torch.zeros(1), **self.windows()}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items() if tensor.numel()}

    def advance(self, sparse: Tensor, state: State, newest: int = 1) -> tuple[Tensor, State]:
        """Take in one frame.

        Args:
            sparse: world inputs (1, 1, 54).
            state: what the last call returned, or `initial_state`.
            newest: must be 1, since no other frame is computed.

        Returns:
            Motion (1, 1, 198) in the world, and the new state.
        """
        # An exported graph has no empty inputs, so empty parts of the state (a queue of 0 frames) are dropped
        # from the new state and put back from `windows` here.
        fresh = 1 - state["count"].clamp_max(1)
        motion, kept = self.step(sparse[0], self.windows() | state, fresh)
        kept["count"] = state["count"].clamp_max(self.frames - 1) + 1  # stops at T
        return motion[None], {name: tensor for name, tensor in kept.items() if tensor.numel()}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Take in one frame.

        Args:
            sparse: world inputs (1, 54).
            state: the state, all zeros at a fresh start.
            fresh: 1 at a fresh start and 0 after it (1,).

        Returns:
            World motion (1, 198), and the new state.
        """
        raise NotImplementedError


class FrameGraph(StreamingGraph):
    """The streaming graph of a network without a window: the network itself, one frame per step."""

    model: WindowlessModel

    def build(self, model: Any) -> None:
        self.model = model

    def windows(self) -> State:
        """Return the network's state at a fresh start, which is all that it carries: it has no window."""
        return self.model.initial_state(1)

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        motion, kept = self.model.advance(sparse[None], state, 1)
        return motion[0], kept
