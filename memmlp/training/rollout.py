"""The rollout slot: how the history that a training step sees comes about.

A network trained on true history alone leans on what is not there at run time (exposure bias), so the
history may be made by the network itself, as it will be live.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import MotionDataset, WindowSampler
from memmlp.networks.memory import State
from memmlp.networks.window_model import WindowModel


class Call(NamedTuple):
    """One training call: `model.learn(sparse, state, truth)` should give the truth.

    sparse (B, n, 54) and truth (B, T, 252) are world frames; clips (B,) says where they are from.
    """

    sparse: Tensor
    state: State
    truth: Tensor
    clips: Tensor


class Rollout(nn.Module):
    """The rollout slot."""

    def begin(self, model: WindowModel) -> None:
        """Make room for what is kept between steps of that network's training; here nothing is."""

    def draw(self, model: WindowModel, frames: MotionDataset, sampler: WindowSampler, step: int) -> Call:
        """The call of a training step."""
        raise NotImplementedError

    def keep(self, state: State) -> None:
        """Keep what the trained call left; here nothing is kept."""


class TeacherForcing(Rollout):
    """The true history: the paper's training (Sec. 3.2.1)."""

    def draw(self, model: WindowModel, frames: MotionDataset, sampler: WindowSampler, step: int) -> Call:
        """The call of a training step."""
        clips, end = sampler.draw(step)
        past, stride = model.length, model.stride
        segment = frames.segments(clips, end, past + stride)
        state = model.true_state(segment[:, :past])
        return Call(segment[:, past:, :SPARSE_DIM], state, segment[:, -model.frames :], clips)


class OwnPredictions(Rollout):
    """The network's own history, made by 0 to `max_passes` untrained calls before the trained one.

    The first of them sees an empty history. All samples of a step take the same number of calls.
    """

    def __init__(self, max_passes: int):
        super().__init__()
        self.max_passes = max_passes

    def draw(self, model: WindowModel, frames: MotionDataset, sampler: WindowSampler, step: int) -> Call:
        """The call of a training step."""
        clips, end = sampler.draw(step)
        past, stride = model.length, model.stride
        passes = int(torch.randint(self.max_passes + 1, ())) if model.shift else 0
        segment = frames.segments(clips, end, past + stride * (passes + 1))
        sparse = segment[..., :SPARSE_DIM]
        state = model.running_state(sparse[:, :past])
        model.eval()
        with torch.no_grad():
            for done in range(passes):
                start = past + done * stride
                _, state = model.advance(sparse[:, start : start + stride], state, stride)
        model.train()
        return Call(sparse[:, -stride:], state, segment[:, -model.frames :], clips)


class PersistentStreams(Rollout):
    """Many streams that run through the clips for the whole training, each fed with its own history.

    Every step takes the next `batch` of them one stride further; at its clip's end a stream starts
    afresh in a clip drawn anew. Their state is part of the checkpoint.
    """

    clip: Tensor
    end: Tensor
    lives: Tensor

    def __init__(self, streams: int):
        super().__init__()
        self.streams = streams
        self.register_buffer("clip", torch.zeros(streams, dtype=torch.long))
        self.register_buffer("end", torch.zeros(streams, dtype=torch.long))
        self.register_buffer("lives", torch.zeros(streams, dtype=torch.bool))

    def begin(self, model: WindowModel) -> None:
        """Room for the streams' states."""
        for name, tensor in model.initial_state(1).items():
            self.register_buffer(f"state_{name}", tensor.repeat(self.streams, *[1] * (tensor.dim() - 1)))

    def draw(self, model: WindowModel, frames: MotionDataset, sampler: WindowSampler, step: int) -> Call:
        """The call of a training step: the next streams, each one stride further."""
        clips, end = sampler.draw(step)
        who = (step * len(clips) + torch.arange(len(clips), device=clips.device)) % self.streams
        going = self.lives[who] & (self.end[who] + model.stride < frames.lengths[self.clip[who]])
        self.clip[who] = torch.where(going, self.clip[who], clips)
        self.end[who] = torch.where(going, self.end[who] + model.stride, end)
        self.lives[who] = True
        past, stride = model.length, model.stride
        segment = frames.segments(self.clip[who], self.end[who], past + stride)
        fresh = model.running_state(segment[:, :past, :SPARSE_DIM])
        state = {}
        for name, tensor in fresh.items():
            kept = self.get_buffer(f"state_{name}")[who]
            state[name] = torch.where(going.view(-1, *[1] * (tensor.dim() - 1)), kept, tensor)
        self.who = who
        return Call(segment[:, past:, :SPARSE_DIM], state, segment[:, -model.frames :], self.clip[who])

    def keep(self, state: State) -> None:
        """The states of the streams after the trained call."""
        for name, tensor in state.items():
            self.get_buffer(f"state_{name}")[self.who] = tensor.detach()
