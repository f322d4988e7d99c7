"""The embedded dataset: procedural motions of a plausible person as AMASS files, seeded, no download."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.progress import progress_bar
from memmlp.motion.clip import FRAME_RATE_RANGE, Clip
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.synthetic import actions, gait
from memmlp.motion.synthetic.puppet import Puppet, solve

Activity = Callable[[np.random.Generator, np.ndarray], Puppet]
ACTIVITIES: dict[str, Activity] = {
    "walking": gait.walking,
    "running": gait.running,
    "squatting": actions.squatting,
    "sitting": actions.sitting,
    "reaching": actions.reaching,
    "waving": actions.waving,
    "punching": actions.punching,
    "jumping": actions.jumping,
    "sidestepping": actions.sidestepping,
    "idling": actions.idling,
}
CLIP_SECONDS = 14.0  # on average
MIN_CLIPS = 3  # train, validation and test
MARGIN = 4.0  # seconds; a clip is a random excerpt of a performance that is longer by this


def synthesize(out: Path, *, minutes: float = 10.0, seed: int = 0, fps: float = 60.0) -> list[Path]:
    """Write clips of 8 to 20 s, `minutes` in all, as `out`/<activity>/<activity>_<nnn>.npz.

    If that would make fewer than three clips, three shorter ones are written. The clips depend only
    on the arguments.

    Raises:
        InputError: for bad arguments.
    """
    low, high = FRAME_RATE_RANGE
    if not (math.isfinite(minutes) and minutes > 0):
        raise InputError(f"minutes={minutes:g}: must be a positive number")
    if seed < 0:
        raise InputError(f"seed={seed}: must be 0 or more")
    if not low <= fps <= high:
        raise InputError(f"fps={fps:g}: must be {low:g} to {high:g}")
    rng, seconds = np.random.default_rng(seed), minutes * 60.0
    share = rng.uniform(0.6, 1.4, max(MIN_CLIPS, round(seconds / CLIP_SECONDS)))
    ends = np.round(np.cumsum(share) / share.sum() * seconds * fps).astype(int)
    lengths = [max(2, int(frames)) for frames in np.diff(ends, prepend=0)]
    rounds = math.ceil(len(lengths) / len(ACTIVITIES))
    names = np.concatenate([rng.permutation(list(ACTIVITIES)) for _ in range(rounds)])
    paths = []
    for index, frames in enumerate(progress_bar(lengths, "synthesize")):
        name = str(names[index])
        path = out / name / f"{name}_{index // len(ACTIVITIES):03d}.npz"
        write_clip(path, synthesize_clip(name, int(rng.integers(2**62)), seconds=frames / fps, fps=fps))
        paths.append(path)
    return paths


def synthesize_clip(activity: str, seed: int, *, seconds: float = 14.0, fps: float = 60.0) -> Clip:
    """Make one clip of the built-in body, named <activity>/<seed>, in float32.

    Raises:
        InputError: for an unknown activity.
    """
    if activity not in ACTIVITIES:
        raise InputError(f"activity={activity}: must be one of {', '.join(ACTIVITIES)}")
    rng = np.random.default_rng([list(ACTIVITIES).index(activity), seed])
    frames = max(2, round(seconds * fps))
    t = np.arange(frames + round(MARGIN * fps)) / fps
    first = int(rng.integers(len(t) - frames + 1))
    poses, trans = solve(ACTIVITIES[activity](rng, t))
    cut = slice(first, first + frames)
    return Clip(f"{activity}/{seed}", poses[cut].astype(np.float32), trans[cut].astype(np.float32), fps)
