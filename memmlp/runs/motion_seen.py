"""How much motion a run's network saw in training, and what is said where that was next to nothing."""

from __future__ import annotations

from memmlp.runs.run import Run

MINUTE = 60 * 60  # frames, of which a second has 60
LITTLE = 30 * MINUTE  # `profile=small` draws 23 times as many


def frames_seen(run: Run) -> float:
    """Return how many frames a run's network saw in all training steps together; 0 if that is unknown.

    For a refiner, this includes the frames that the network before it saw, and the pieces of its own
    training.
    """
    config = run.config
    refiner, optim, model = (config.get(name) or {} for name in ("refiner", "optim", "model"))
    length = (refiner or model).get("frames") or 0
    seen = float((optim.get("steps") or 0) * (optim.get("batch") or 0) * length)
    if not refiner:
        return seen
    before = frames_seen(Run(run.folder.parent / str(run.manifest.get("upstream"))))
    return seen + before if seen and before else 0.0


def hardly_trained(frames: float) -> str:
    """Return a warning if a network saw less than half an hour of motion in training; empty otherwise.

    Args:
        frames: how many frames it saw, as `frames_seen` counts them; 0 if that is unknown.
    """
    if not 0 < frames < LITTLE:
        return ""
    minutes = f"{frames / MINUTE:.2g} minutes of motion"
    return f"hardly trained (its steps saw {minutes} in all), so that errors say nothing of the network"
