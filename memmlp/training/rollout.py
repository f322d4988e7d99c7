"""The rollout slot: draws a step's training batch, and provides the history that the network sees.

A network that is trained only on true history learns to rely on it, but does not have it at run time
(exposure bias). A rollout can therefore let the network predict its own history, as in a live stream."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.components import component
from memmlp.common.settings import Settings, at_least, setting
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import MotionDataset, WindowSampler
from memmlp.networks.motion_model import MotionModel, State


class TrainingCall(NamedTuple):
    """The arguments of `MotionModel.compute_training_outputs`: world inputs (B, n, 54) of the new frames, the
    state before them, world frames [X | Theta] (B, T, 252) of the window, and the samples' clips (B,)."""

    sparse: Tensor
    state: State
    true_frames: Tensor
    clips: Tensor


class Rollout(nn.Module):
    """The rollout slot's interface. If several processes share a batch, each draws only its own rows."""

    def begin(self, model: MotionModel) -> None:
        """Prepare buffers that stay between a network's training steps; by default there are no buffers."""

    def draw(
        self, model: MotionModel, dataset: MotionDataset, sampler: WindowSampler, step: int
    ) -> TrainingCall:
        """Draw the batch of a training step, with the state before it."""
        raise NotImplementedError

    def keep(self, state: State) -> None:
        """Store the state after a training step for later steps; by default nothing is stored."""

    def average_over_draws(self, measure: Callable[[], float]) -> float:
        """Return the expected value of `measure`, a number that depends on the rollout's random draws."""
        return measure()


@component("rollout", "teacher_forcing")
class TeacherForcing(Rollout):
    """A rollout with the true motion as history: the paper's training (Sec. 3.2.1)."""

    def draw(
        self, model: MotionModel, dataset: MotionDataset, sampler: WindowSampler, step: int
    ) -> TrainingCall:
        clips, end = map(distributed.take_local_rows, sampler.draw(step))
        stride = model.stride
        past = model.count_past(stride)
        stretch = dataset.read_stretches(clips, end, past + stride)
        state = model.true_state(stretch[:, :past])
        return TrainingCall(stretch[:, past:, :SPARSE_DIM], state, stretch[:, -model.frames :], clips)


@component("rollout", "own_predictions", builds="OwnPredictions")
@dataclass
class OwnPredictionsSettings(Settings):
    """Training on the network's own predictions for the frames before the window (docs/readings.md, no. 6).

    With memory.shift=frame a call predicts only one frame, so max_passes must be at least model.frames.
    """

    # maximum number of network calls without gradients before the trained call; each step draws the number of
    # calls from 0 to this maximum
    max_passes: int = setting(at_least(1), 3)


class OwnPredictions(Rollout):
    """A rollout with predicted history, from 0 to `max_passes` earlier calls without gradients. The first
    call sees an empty history. Each call fills one stride. All samples of a step use the same number of
    calls."""

    def __init__(self, max_passes: int):
        super().__init__()
        self.max_passes = max_passes
        self.passes: int | None = None  # a fixed number of calls

    def draw(
        self, model: MotionModel, dataset: MotionDataset, sampler: WindowSampler, step: int
    ) -> TrainingCall:
        clips, end = map(distributed.take_local_rows, sampler.draw(step))
        past, stride = model.past_frames, model.stride
        drawn = int(torch.randint(self.max_passes + 1, ())) if model.shift else 0
        passes = drawn if self.passes is None else self.passes
        stretch = dataset.read_stretches(clips, end, past + stride * (passes + 1))
        sparse = stretch[..., :SPARSE_DIM]
        state = model.running_state(sparse[:, :past])
        model.eval()
        with torch.no_grad():
            for done in range(passes):
                start = past + done * stride
                _, state = model.advance(sparse[:, start : start + stride], state, stride)
        torch.clear_autocast_cache()  # weights that were cast without a gradient would have none below
        model.train()
        return TrainingCall(sparse[:, -stride:], state, stretch[:, -model.frames :], clips)

    def average_over_draws(self, measure: Callable[[], float]) -> float:
        """Return the expected value of `measure`, which must be linear in the number of network calls."""
        total = 0.0
        for passes in (0, self.max_passes):
            self.passes = passes
            total += measure() / 2
        self.passes = None
        return total


@component("rollout", "streams", version=2, builds="PersistentStreams")
@dataclass
class StreamsSettings(Settings):
    """Training on persistent streams (docs/readings.md, no. 6)."""

    # number of parallel streams; each stream runs through whole clips with its own history
    streams: int = setting(at_least(1), tiny=16, small=1024, paper=1024)


class PersistentStreams(Rollout):
    """A rollout with many streams, which run through the clips during the whole training and predict their
    own history. Every step advances the next `batch` streams by one stride. A stream starts at a random frame
    of a clip. At the clip's end it restarts at the beginning of another clip, which preserves the sampler's
    window frequencies. The streams' states are part of the checkpoint: clip index, newest frame in that clip,
    and whether the stream has started (streams,)."""

    clip: Tensor
    end: Tensor
    lives: Tensor

    def __init__(self, streams: int):
        super().__init__()
        self.streams = streams
        self.register_buffer("clip", torch.zeros(streams, dtype=torch.long))
        self.register_buffer("end", torch.zeros(streams, dtype=torch.long))
        self.register_buffer("lives", torch.zeros(streams, dtype=torch.bool))

    def begin(self, model: MotionModel) -> None:
        for name, tensor in model.initial_state(1).items():
            self.register_buffer(f"state_{name}", tensor.repeat(self.streams, *[1] * (tensor.dim() - 1)))

    def draw(
        self, model: MotionModel, dataset: MotionDataset, sampler: WindowSampler, step: int
    ) -> TrainingCall:
        """Draw the next streams, each advanced by one stride. Call `keep` before the next draw: it stores the
        new states of the streams that were drawn last."""
        clips, end = sampler.draw(step)
        who = (step * len(clips) + torch.arange(len(clips), device=clips.device)) % self.streams
        again = sampler.draw_stream_starts(step, model.stride)
        clips, end = (torch.where(self.lives[who], *pair) for pair in zip(again, (clips, end), strict=True))
        going = self.lives[who] & (self.end[who] + model.stride < dataset.lengths[self.clip[who]])
        self.clip[who] = torch.where(going, self.clip[who], clips)
        self.end[who] = torch.where(going, self.end[who] + model.stride, end)
        self.lives[who] = True
        self.who, mine, going = who, distributed.take_local_rows(who), distributed.take_local_rows(going)
        past, stride = model.past_frames, model.stride
        stretch = dataset.read_stretches(self.clip[mine], self.end[mine], past + stride)
        fresh = model.running_state(stretch[:, :past, :SPARSE_DIM])
        state = {}
        for name, tensor in fresh.items():
            kept = self.get_buffer(f"state_{name}")[mine]
            state[name] = torch.where(going.view(-1, *[1] * (tensor.dim() - 1)), kept, tensor)
        return TrainingCall(
            stretch[:, past:, :SPARSE_DIM], state, stretch[:, -model.frames :], self.clip[mine]
        )

    def keep(self, state: State) -> None:
        for name, tensor in state.items():
            self.get_buffer(f"state_{name}")[self.who] = distributed.gather_rows(tensor.detach())
