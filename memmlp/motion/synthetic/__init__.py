"""The synthetic dataset: seeded procedural motion of a plausible person, written as AMASS files."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.progress import progress_bar
from memmlp.motion.clip import FRAME_RATE_RANGE, Clip
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.synthetic import actions, gait
from memmlp.motion.synthetic.puppet import Puppet, solve_joints

Activity = Callable[[np.random.Generator, np.ndarray], Puppet]
ACTIVITIES: dict[str, Activity] = {
    "walking": gait.draw_walking,
    "running": gait.draw_running,
    "squatting": actions.draw_squatting,
    "sitting": actions.draw_sitting,
    "reaching": actions.draw_reaching,
    "waving": actions.draw_waving,
    "punching": actions.draw_punching,
    "jumping": actions.draw_jumping,
    "sidestepping": actions.draw_sidestepping,
    "idling": actions.draw_idling,
}
CLIP_SECONDS = 14.0  # mean duration
MIN_CLIPS = 3  # train, validation and test
MARGIN = 4.0  # seconds: a clip is a random excerpt of a performance that is longer by this margin


def synthesize(out: Path, *, minutes: float = 10.0, seed: int = 0, fps: float = 60.0) -> list[Path]:
    """Write clips of 8 to 20 s with a total duration of `minutes`, as OUT/ACTIVITY/ACTIVITY_NNN.npz: at least
    three, which are shorter if necessary. They depend only on the arguments. Raises InputError for invalid
    arguments."""
    low, high = FRAME_RATE_RANGE
    if not (math.isfinite(minutes) and minutes > 0):
        raise InputError(f"minutes={minutes:g}: must be a positive number")
    if seed < 0:
        raise InputError(f"seed={seed}: must be 0 or more")
    if not low <= fps <= high:
        raise InputError(f"fps={fps:g}: must be {low:g} to {high:g}")
    rng, seconds = np.random.default_rng(seed), minutes * 60.0
    fractions = rng.uniform(0.6, 1.4, max(MIN_CLIPS, round(seconds / CLIP_SECONDS)))
    ends = np.round(np.cumsum(fractions) / fractions.sum() * seconds * fps).astype(int)
    lengths = [max(2, int(frames)) for frames in np.diff(ends, prepend=0)]
    repetitions = math.ceil(len(lengths) / len(ACTIVITIES))
    names = np.concatenate([rng.permutation(list(ACTIVITIES)) for _ in range(repetitions)])
    paths: list[Path] = []
    try:
        for index, frames in enumerate(progress_bar(lengths, "synthesize")):
            name = str(names[index])
            path = out / name / f"{name}_{index // len(ACTIVITIES):03d}.npz"
            write_clip(path, synthesize_clip(name, int(rng.integers(2**62)), seconds=frames / fps, fps=fps))
            paths.append(path)
    except BaseException:  # a part of the clips must not pass for all of them
        for path in paths:
            path.unlink(missing_ok=True)
        raise
    return paths


def synthesize_clip(activity: str, seed: int, *, seconds: float = 14.0, fps: float = 60.0) -> Clip:
    """Make one float32 clip of the built-in body, with the name ACTIVITY/SEED. Raises InputError for an
    unknown activity."""
    if activity not in ACTIVITIES:
        raise InputError(f"activity={activity}: must be one of {', '.join(ACTIVITIES)}")
    rng = np.random.default_rng([list(ACTIVITIES).index(activity), seed])
    frames = max(2, round(seconds * fps))
    t = np.arange(frames + round(MARGIN * fps)) / fps
    first = int(rng.integers(len(t) - frames + 1))
    poses, trans = solve_joints(ACTIVITIES[activity](rng, t))
    cut = slice(first, first + frames)
    return Clip(f"{activity}/{seed}", poses[cut].astype(np.float32), trans[cut].astype(np.float32), fps)
