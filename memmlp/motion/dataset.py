"""Prepared motion as tensors: windows for training, whole clips for evaluation, and mirrored clips."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.motion.body import FRAME_DIM, SWAPPED, TRACKED
from memmlp.motion.preparing.find_clips import get_source_name
from memmlp.motion.preparing.manifest import PARTS, Manifest

SHARE_STEPS = 2**52  # resolution of the sources' shares


class MotionDataset:
    """All clips of one part (train, val or test), concatenated: `frames` [X | Theta] (F, 252), float32,
    world, and the first frames and numbers of frames of the clips (C,), int64, on the same device. Dependent
    clips share a group; by default each clip has its own group. `sources` is the source of each clip; None if
    all clips are from one folder."""

    def __init__(
        self,
        frames: Tensor,
        starts: Tensor,
        lengths: Tensor,
        names: list[str],
        groups: list[str] | None = None,
        sources: list[str] | None = None,
    ):
        self.frames, self.starts, self.lengths, self.names = frames, starts, lengths, names
        self.groups, self.sources = groups or list(names), sources

    @classmethod
    def open(cls, cache: Path, part: str) -> MotionDataset:
        """Open a part (train, val, test) of a prepared cache, memory-mapped; `.to(device)` copies it. Raises
        InputError if the cache is unfinished or damaged, or the part has no clips."""
        if part not in PARTS:
            raise InputError(f"part={part}: must be one of {', '.join(PARTS)}")
        manifest = Manifest.load(cache)
        clips = manifest.part(part)
        if not clips:
            raise InputError(f"{cache}: has no {part} clips; prepare the data with a {part} part")
        frames = _map_array(cache / f"{part}.npy")
        if frames.shape != (sum(clip.length for clip in clips), FRAME_DIM):
            raise InputError(f"{cache}: {part}.npy does not fit the manifest; prepare the data again")
        starts = torch.tensor([clip.start for clip in clips])
        lengths = torch.tensor([clip.length for clip in clips])
        names, groups = [clip.name for clip in clips], [clip.group for clip in clips]
        sources = [get_source_name(name) for name in names] if manifest.sources else None
        return cls(frames, starts, lengths, names, groups, sources)

    def to(self, device: torch.device | str) -> MotionDataset:
        tensors = (self.frames.to(device), self.starts.to(device), self.lengths.to(device))
        return MotionDataset(*tensors, list(self.names), list(self.groups), self.sources)

    def __len__(self) -> int:
        return len(self.names)

    def read_stretches(self, clip: Tensor, end: Tensor, length: int) -> Tensor:
        """Read the last `length` frames (B, length, 252) of clips (B,) up to and including their frames `end`
        (B,). Before the start of a clip its first frame is repeated, like in the warm-up of a live stream."""
        device = self.frames.device
        back = torch.arange(1 - length, 1, device=device)
        frame = (end.to(device)[:, None] + back).clamp_min(0)
        rows = self.starts[clip.to(device)][:, None] + frame
        return self.frames.index_select(0, rows.flatten()).unflatten(0, rows.shape)

    def read_clip(self, index: int) -> Tensor:
        """Return all frames (N, 252) of a clip."""
        start, length = int(self.starts[index]), int(self.lengths[index])
        return self.frames[start : start + length]

    def read_clips(self) -> list[Tensor]:
        """Return all frames (N, 252) of each clip, without copying."""
        return [self.read_clip(index) for index in range(len(self.names))]


class WindowSampler:
    """Draws `batch` random windows of `window` frames. A draw depends only on seed and step. A window is
    identified by its last frame; a clip shorter than the window has one window, which ends at the clip's last
    frame. `drawn_by` is "frames", where all windows of the part are equally likely (docs/readings.md, no.
    23); "clips", where all clips are; or "groups", where the frequency of a group of clips, such as a
    person, is the square root of its number of windows. `shares` are the relative frequencies of each
    source's windows; None ignores sources."""

    def __init__(
        self,
        dataset: MotionDataset,
        batch: int,
        window: int,
        seed: int,
        drawn_by: str = "frames",
        shares: Mapping[str, float] | None = None,
    ):
        self.batch, self.seed, self.device = batch, seed, dataset.frames.device
        lengths = dataset.lengths.cpu().numpy()
        self.first_end = np.minimum(window, lengths) - 1
        self.windows = np.maximum(lengths - window + 1, 1)
        weights = np.ones_like(self.windows) if drawn_by == "clips" else self.windows
        if drawn_by == "groups":
            group = np.unique(dataset.groups, return_inverse=True)[1]
            roots = np.sqrt(np.bincount(group, self.windows))
            weights = _round_shares(weights / roots[group] / roots.sum())
        self.weights = _scale_weights(weights, dataset.sources, shares) if shares else weights
        self.bounds = np.cumsum(self.weights)

    def draw(self, step: int) -> tuple[Tensor, Tensor]:
        """Draw clips (B,) and the last frame of a window in each (B,), int64, on the dataset's device."""
        random = np.random.Generator(np.random.Philox(key=[self.seed, step]))
        clip = np.searchsorted(self.bounds, random.integers(0, self.bounds[-1], self.batch), side="right")
        end = self.first_end[clip] + random.integers(0, self.windows[clip])
        return torch.from_numpy(clip).to(self.device), torch.from_numpy(end).to(self.device)

    def draw_stream_starts(self, step: int, stride: int) -> tuple[Tensor, Tensor]:
        """Draw the first windows of streams that run to the end of their clips, `stride` frames per step:
        clips (B,) and the last frame in each (B,), independent of the draws of `draw`. Longer clips are drawn
        less often, because a stream takes longer to run through them. So all windows are as frequent as with
        `draw`."""
        random = np.random.Generator(np.random.Philox(key=[self.seed, step], counter=[0, 0, 1, 0]))
        bounds = np.cumsum(self.weights / np.maximum(self.windows / stride, 1))
        clip = np.searchsorted(bounds, random.random(self.batch) * bounds[-1], side="right")
        end = self.first_end[clip] + random.integers(0, np.minimum(stride, self.windows[clip]))
        return torch.from_numpy(clip).to(self.device), torch.from_numpy(end).to(self.device)


def _scale_weights(
    weights: np.ndarray, sources: Sequence[str] | None, shares: Mapping[str, float]
) -> np.ndarray:
    """Scale the clips' weights: the weights of each source then sum to its share. Returns int64 (C,)."""
    named, scaled = np.array(sources), weights.astype(float)
    for source, share in shares.items():
        scaled[named == source] *= share / weights[named == source].sum()
    return _round_shares(scaled / sum(shares.values()))


def _round_shares(shares: np.ndarray) -> np.ndarray:
    return np.rint(shares * SHARE_STEPS).astype(np.int64)


def _map_array(path: Path) -> Tensor:
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as an array ({error}); prepare the data again") from error
    with warnings.catch_warnings():  # torch warns that it has no read-only tensors
        warnings.simplefilter("ignore", UserWarning)
        return torch.from_numpy(array)


# Mirrored motion with left and right exchanged, which augments training data

SIXD_SIGNS = (1.0, -1.0, -1.0, -1.0, 1.0, 1.0)  # the first two columns of S R S with S = diag(-1, 1, 1)
POINT_SIGNS = (-1.0, 1.0, 1.0)  # S p
TRACKED_SWAPPED = tuple(TRACKED.index(SWAPPED[joint]) for joint in TRACKED)


def _build_mirror_layout() -> tuple[Tensor, Tensor]:
    """Return, for each feature of a mirrored frame (252,), the index of the original feature and its sign."""
    sources, signs = torch.arange(FRAME_DIM), torch.ones(FRAME_DIM)
    start = 0
    for joints, joint_signs in (
        *((TRACKED_SWAPPED, part) for part in (SIXD_SIGNS, SIXD_SIGNS, POINT_SIGNS, POINT_SIGNS)),
        *((SWAPPED, part) for part in (SIXD_SIGNS, POINT_SIGNS)),
    ):
        size = len(joints) * len(joint_signs)
        block = torch.arange(start, start + size).view(len(joints), -1)
        sources[start : start + size] = block[list(joints)].flatten()
        signs[start : start + size] = torch.tensor(joint_signs * len(joints))
        start += size
    return sources, signs


SOURCES, SIGNS = _build_mirror_layout()


def mirror_frames(frames: Tensor) -> Tensor:
    """Mirror world frames [X | Theta] (..., 252) at the plane X = 0, and exchange left and right joints. If
    the rest pose is not symmetric, the mirrored motion is motion of the mirrored body."""
    return frames[..., SOURCES.to(frames.device)] * SIGNS.to(frames)


class MirroredDataset(MotionDataset):
    """A dataset with all original clips, followed by a mirrored copy of each, which is made when it
    is read."""

    def __init__(self, plain: MotionDataset):
        names = [*plain.names, *(f"{name} (mirrored)" for name in plain.names)]
        sources = plain.sources and [*plain.sources] * 2
        starts, lengths = plain.starts.repeat(2), plain.lengths.repeat(2)
        super().__init__(plain.frames, starts, lengths, names, [*plain.groups] * 2, sources)

    def read_stretches(self, clip: Tensor, end: Tensor, length: int) -> Tensor:
        plain = super().read_stretches(clip, end, length)
        turned = (clip >= len(self) // 2).to(plain.device)
        return torch.where(turned[:, None, None], mirror_frames(plain), plain)

    def read_clip(self, index: int) -> Tensor:
        plain = super().read_clip(index)
        return mirror_frames(plain) if index >= len(self) // 2 else plain
