"""The interfaces of networks and of their streaming graphs, which are exported for live use."""

from __future__ import annotations

import copy
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer

State = dict[str, Tensor]


class TrainingOutputs(NamedTuple):
    """The results of `MotionModel.compute_training_outputs`.

    Attributes:
        motion: world motion (B, n, 198) for comparison with the true motion of the window's last n frames. An
            ensemble with separately trained networks returns their motions one after the other: (networks x
            B, n, 198).
        state: the new state.
        losses: additional weighted losses of the network, which are added to the motion losses.
    """

    motion: Tensor
    state: State
    losses: dict[str, Tensor]


class MotionModel(nn.Module):
    """The interface of all networks, which process frames by calls of `advance`.

    Evaluation, export, timing and training use only this interface. In this base class a network sees a
    window, the last T frames, and its state is only the buffer of past inputs. WindowlessModel does not have
    a buffer.

    Args:
        normalizer: converts between the world and network space.
        frames: T, the window's length.

    Attributes:
        branches: the learned quantities, out of "rotation" and "position". Without learned positions, forward
            kinematics gives them.
        origin: the origin of imported weights; empty for trained weights.
        graph: the class of the streaming graph, or None. It is not inherited, since a subclass may compute
            something else.
        shift: number of frames from the end of the recalled past to the newest frame; 0 without a recalled
            past.
        settled: whether the recalled values of a past frame never change, so that a live stream may keep
            them.
        windowless: whether both evaluation modes run the network as a stream; see WindowlessModel.
        frames_per_call: maximum number of new frames in a call of `advance_frames`. A network with a window
            that has its own `advance` has 1 by default.
        is_stream: whether the network needs no future frames. If not, only window mode can evaluate it.
        takes_whole_clip: whether window mode passes a whole clip to `predict_clip`, which may overlap
            windows.
    """

    branches: frozenset[str] = frozenset({"rotation"})
    shift: int = 0
    settled: bool = True
    windowless: bool = False
    frames_per_call: int = 1
    is_stream: bool = True
    takes_whole_clip: bool = False
    origin: str = ""
    graph: ClassVar[type[StreamingGraph] | None] = None

    def __init_subclass__(cls, **arguments: Any):
        super().__init_subclass__(**arguments)
        if "advance" in vars(cls) and not cls.windowless:  # a frame may depend on the others of its call
            cls.frames_per_call = vars(cls).get("frames_per_call", 1)

    def __init__(self, normalizer: Normalizer, frames: int):
        super().__init__()
        self.normalizer = normalizer
        self.frames = frames

    @property
    def past_frames(self) -> int:
        """The number of past input frames in the buffer, which ends just before the new frames."""
        return self.frames - 1

    def count_past(self, new: int) -> int:
        """Return how many past frames a call with this many new frames depends on; at most `past_frames`."""
        return self.past_frames

    @property
    def stride(self) -> int:
        """The number of frames by which a training step advances: the shift, or 1 without a past."""
        return max(self.shift, 1)

    def initial_state(self, batch: int = 1) -> State:
        """Return the initial state, all zeros.

        In the first call, the first frame's inputs replace all earlier inputs.
        """
        state = {"sparse": torch.zeros(batch, self.past_frames, SPARSE_DIM), "started": torch.zeros(batch, 1)}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items()}

    def running_state(self, sparse: Tensor) -> State:
        """Return the state after world inputs (B, past, 54), without a history of motion."""
        initial = self.initial_state(len(sparse))
        return initial | {"sparse": sparse, "started": torch.ones_like(initial["started"])}

    def true_state(self, frames: Tensor) -> State:
        """Return the state after world frames [X | Theta] (B, past, 252), with true history."""
        return self.running_state(frames[..., :SPARSE_DIM])

    def append_inputs(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Return past and new inputs together (B, past + n, 54), and the new buffers.

        Args:
            sparse: new world inputs (B, n, 54).
            state: the state from the last call, or `initial_state`.
        """
        before = torch.where(state["started"][..., None] > 0, state["sparse"], sparse[:, :1])
        inputs = torch.cat([before, sparse], 1)
        return inputs, {"sparse": inputs[:, sparse.shape[1] :], "started": state["started"].clamp_min(1)}

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Process the newest frames.

        Args:
            sparse: world inputs (B, n, 54) of the n newest frames: n is 1 for a live stream, T for windows,
                and fewer at a clip's end.
            state: the state from the last call, or `initial_state`.
            newest: number of newest frames to return; by default all frames that the network predicts.

        Returns:
            World motion (B, newest, 198) of the newest frames, and the new state.
        """
        raise NotImplementedError

    def advance_frame(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Process one frame (B, 54); return its motion (B, 198) in the world, and the new state."""
        motion, state = self.advance(sparse[:, None], state, 1)
        return motion[:, -1], state

    def advance_frames(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Process n new frames (B, n, 54) at once like n calls of `advance_frame`, up to rounding; return
        their motion (B, n, 198) in the world, and the new state."""
        motion, state = self.advance(sparse, state, sparse.shape[1])
        return motion[:, -sparse.shape[1] :], state

    def advance_windows(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Compute `advance_frames` with a window for each new frame, if the state consists of the last frames
        of some sequences, and a frame does not depend on the n frames before it except through its inputs."""
        size, count = sparse.shape[:2]
        if count == 1:
            motion, state = self.advance(sparse, state, 1)
            return motion[:, -1:], state
        inputs, kept = self.append_inputs(sparse, state)
        others = {name: tensor for name, tensor in state.items() if name not in kept}
        windows = slide(inputs, self.past_frames, count)
        later = {
            name: slide(F.pad(each, (0, 0, 0, count)), each.shape[1], count) for name, each in others.items()
        }
        motion, after = self.advance(sparse.flatten(0, 1)[:, None], self.running_state(windows) | later, 1)
        for name, tensor in others.items():
            made = torch.unflatten(after[name][:, -1], 0, (size, count))
            kept[name] = torch.cat([tensor, made], 1)[:, count:]
        return torch.unflatten(motion[:, -1], 0, (size, count)), kept

    def predict_clip(self, sparse: Tensor) -> Tensor:
        """Map a clip's world inputs (N, 54), N >= T, to its world motion (N, 198); see `takes_whole_clip`."""
        raise NotImplementedError

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Predict the motion for a training step, with additional losses; by default this is `advance`.

        Args:
            sparse: see `advance`.
            state: see `advance`.
            true_frames: world frames [X | Theta] (B, T, 252) of the window.
        """
        return TrainingOutputs(*self.advance(sparse, state), {})

    @classmethod
    def adapt_published(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Rearrange the authors' tensors where names are not enough (`Release`); by default unchanged."""
        return tensors

    def count_parameters(self) -> int:
        """Count the trainable parameters; tables show this number in millions.

        A frozen VQ-VAE is not counted. A jointly trained VQ-VAE is counted with its decoder.
        """
        return sum(p.numel() for p in self.parameters() if p.requires_grad)


class WindowlessModel(MotionModel):
    """A network without a window: its state holds everything about the past.

    Every live step costs the same. `frames` is the number of frames in a training step, from the initial
    state. In both evaluation modes the network is a stream over the whole clip. By default `advance` returns
    the motion of the n new frames, which is the maximum.
    """

    windowless = True
    frames_per_call = 256

    @property
    def past_frames(self) -> int:
        """The number of past input frames in the buffer: 0."""
        return 0

    @property
    def stride(self) -> int:
        """The number of frames by which a training step advances: all frames of the step."""
        return self.frames

    def initial_state(self, batch: int = 1) -> State:
        """Return the initial state, all zeros; by default it is empty."""
        return {}

    def running_state(self, sparse: Tensor) -> State:
        """Return the initial state, because earlier frames (B, 0, 54) are not kept."""
        return self.initial_state(len(sparse))


class WindowModel(MotionModel):
    """The base class of networks that map a window of inputs to its rotations (`predict_rotations`)."""

    frames_per_call = 256
    advance_frames = MotionModel.advance_windows

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        """Map inputs (B, T, 54) to rotations (B, T, 132), both in network space."""
        raise NotImplementedError

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Process the newest frames; see MotionModel.

        By default all T frames are returned. The whole window is always computed, as in the published
        networks.
        """
        inputs, kept = self.append_inputs(sparse, state)
        window = inputs[:, -self.frames :]
        rotation = self.predict_rotations(
            self.normalizer.encode_sparse(window, self.normalizer.find_origin(window))
        )
        count = self.frames if newest is None else newest
        return self.normalizer.decode_rotations(rotation[:, -count:], window[:, -count:]), kept


class NewestFrameModel(MotionModel):
    """The base class of networks that predict only the newest frame of a window (`predict_rotations`).

    Both evaluation modes give the same numbers, except for rounding.
    """

    frames_per_call = 256

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) to their last frames' rotations (B, 132), both in network space."""
        raise NotImplementedError

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Process the newest frames; see MotionModel.

        By default the n new frames are returned, which is the maximum for this network.
        """
        inputs, kept = self.append_inputs(sparse, state)
        count = sparse.shape[1] if newest is None else newest
        ends = torch.arange(inputs.shape[1] - count, inputs.shape[1], device=inputs.device)
        window = ends[:, None] + torch.arange(1 - self.frames, 1, device=inputs.device)
        encoded = self.normalizer.encode_sparse(inputs, self.normalizer.find_origin(inputs))
        windows = torch.unflatten(encoded.index_select(1, window.flatten()), 1, window.shape)
        rotation = torch.unflatten(self.predict_rotations(windows.flatten(0, 1)), 0, (len(inputs), count))
        return self.normalizer.decode_rotations(rotation, inputs[:, -count:]), kept


def slide(frames: Tensor, size: int, count: int) -> Tensor:
    """Return the first `count` windows of `size` frames of (B, n, k): (B count, size, k)."""
    return frames.unfold(1, size, 1)[:, :count].flatten(0, 1).transpose(1, 2)


def fill_past(earlier: Tensor, first: Tensor, is_first_step: Tensor) -> Tensor:
    """Return a window's earlier frames; in a stream's first step they are copies of the first frame.

    In the first step the carried frames are zeros, so a sum is enough. Not every runtime has conditions.

    Args:
        earlier: the carried frames (n, size).
        first: the frame that replaces earlier frames (1, size).
        is_first_step: 1 in a stream's first step, else 0 (1,).
    """
    return earlier + is_first_step * first


def slide_window(window: Tensor, entering: Tensor, before: Tensor, is_first_step: Tensor) -> Tensor:
    """Return a window (T, size) without its oldest frame, and with a new last frame (1, size).

    In a stream's first step `before` (1, size) replaces all earlier frames; see `fill_past`.
    """
    return torch.cat([fill_past(window[1:], before, is_first_step), entering])


class StreamingGraph(nn.Module):
    """The interface of streaming graphs: a network as a graph for one live stream, without gradients.

    Args:
        model: the trained network; the graph is made from a copy.

    Attributes:
        float32_modules: names of the modules that stay in float32 when the graph is quantised. They are the
            network's first and last layers, and other layers with visible rounding.
        int16_modules: names of the modules whose newest frame has sixteen bits in an int8 file. The last row
            of their inputs is the newest frame.
    """

    float32_modules: tuple[str, ...]
    int16_modules: tuple[str, ...] = ()

    def __init__(self, model: MotionModel):
        super().__init__()
        model = copy.deepcopy(model).eval().requires_grad_(False)
        self.frames, self.normalizer, self.branches = model.frames, model.normalizer, model.branches
        self.origin = model.origin
        self.build(model)
        self.requires_grad_(False)

    @classmethod
    def fits(cls, model: MotionModel) -> bool:
        """Return whether this graph supports the given model, with its memory and sizes."""
        return True

    def build(self, model: Any) -> None:
        """Make the graph's parts from a copy of the network."""
        raise NotImplementedError

    def windows(self) -> State:
        """Return the initial state without the step count, all zeros."""
        raise NotImplementedError

    def initial_state(self, batch: int = 1) -> State:
        """Return the initial state, all zeros.

        In the first call, the first frame replaces all earlier frames.

        Args:
            batch: must be 1. Without a batch axis, windows (T, size) are exported to fewer operations.
        """
        assert batch == 1
        state = {"count": torch.zeros(1), **self.windows()}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items() if tensor.numel()}

    def advance(self, sparse: Tensor, state: State, newest: int = 1) -> tuple[Tensor, State]:
        """Process one frame.

        Args:
            sparse: world inputs (1, 1, 54).
            state: the state from the last call, or `initial_state`.
            newest: must be 1, because only the newest frame is computed.

        Returns:
            Motion (1, 1, 198) in the world, and the new state.
        """
        motion, state = self.advance_frame(sparse[0], state)
        return motion[None], state

    def advance_frame(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Process one frame (1, 54); return its motion (1, 198) in the world, and the new state."""
        # An exported graph has no empty inputs, so empty parts of the state (a queue of 0 frames) are dropped
        # from the new state and put back from `windows` here.
        is_first_step = 1 - state["count"].clamp_max(1)
        motion, kept = self.step(sparse, self.windows() | state, is_first_step)
        kept["count"] = state["count"].clamp_max(self.frames - 1) + 1  # stops at T
        return motion, {name: tensor for name, tensor in kept.items() if tensor.numel()}

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        """Process one frame.

        Args:
            sparse: world inputs (1, 54).
            state: the state, initially zeros.
            is_first_step: 1 in a stream's first step, else 0 (1,).

        Returns:
            World motion (1, 198), and the new state.
        """
        raise NotImplementedError


class FrameGraph(StreamingGraph):
    """The streaming graph of a network without a window, which runs the network one frame per step."""

    model: WindowlessModel

    def build(self, model: Any) -> None:
        self.model = model

    def windows(self) -> State:
        """Return the network's initial state, because it does not have a window."""
        return self.model.initial_state(1)

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        motion, kept = self.model.advance(sparse[None], state, 1)
        return motion[0], kept
