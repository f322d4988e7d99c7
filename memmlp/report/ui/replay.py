"""Replays: a network's predictions for test clips, computed in the background."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.spaces import SPACES
from memmlp.motion.body import FPS, JOINTS
from memmlp.motion.limb_shapes import HEAT, LIMBS
from memmlp.report.pictures.clip_pictures import colour_scale_top
from memmlp.runs.run import Run

Predict = Callable[[Run, str, str], Mapping[str, np.ndarray]]
"""Gives "true_positions" and "predicted_positions" (N, 22, 3), metres, of a run's test clip in a mode."""

SECONDS = 10  # the length of the piece around the worst second
PAGE_AXES = SPACES["openxr"]  # those of three.js
GAP = 0.5  # least seconds between two of a clip's worst seconds
WORST = 3  # number of a clip's worst seconds
MAX_KEPT = 64  # predictions in memory

Motion = tuple[np.ndarray, np.ndarray]
"""Truth and prediction (N, 22, 3), metres, world."""


class Replays:
    """Makes replays one after the other.

    Args:
        outputs: the folder of runs and caches.
        predict: computes a prediction.
    """

    def __init__(self, outputs: Path, predict: Predict):
        self.outputs, self.predict = outputs, predict
        self.worker = ThreadPoolExecutor(1, "replay")
        self.motions: dict[tuple[Any, ...], Future[Motion]] = {}
        self.lock = threading.Lock()

    def get(
        self,
        run_id: str,
        clip: str,
        mode: str,
        begin: float | None = None,
        seconds: float = SECONDS,
        timeout: float | None = 0.2,
    ) -> dict[str, Any]:
        """Return a piece of a replay (`cut_piece`), or that it is being computed.

        Args:
            run_id: a finished run's id.
            clip: a test clip's name.
            mode: "stream" or "window".
            begin: where the piece begins, seconds; None for a piece around the worst second.
            seconds: the piece's length.
            timeout: the seconds to wait for the prediction; None to wait until it is there.

        Returns:
            `state` is "computing", "failed" (with `reason`) or "ready".
        """
        run = Run.from_id(self.outputs, run_id)
        key = (run_id, clip, mode, run.marker.stat().st_mtime_ns if run.done else 0)  # the run may be redone
        with self.lock:
            if key not in self.motions:
                if len(self.motions) >= MAX_KEPT:
                    del self.motions[next(iter(self.motions))]
                self.motions[key] = self.worker.submit(self._predict, run, clip, mode)
            future = self.motions[key]
        try:
            truth, prediction = future.result(timeout)
        except TimeoutError:
            return {"state": "computing"}
        except Exception as error:  # the page shows it and may ask again; the server goes on
            self.motions.pop(key, None)
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            return {"state": "failed", "reason": reason}
        return cut_piece(truth, prediction, begin, seconds)

    def _predict(self, run: Run, clip: str, mode: str) -> Motion:
        arrays = self.predict(run, clip, mode)
        return arrays["true_positions"], arrays["predicted_positions"]

    def close(self) -> None:
        """Cancel the computations that are still waiting."""
        self.worker.shutdown(wait=False, cancel_futures=True)


def describe_body() -> dict[str, Any]:
    """Return what a page needs in order to draw a person."""
    limbs = [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS]
    return {"limbs": limbs, "heat": HEAT, "joints": JOINTS, "fps": FPS}


def cut_piece(
    truth: np.ndarray, prediction: np.ndarray, begin: float | None = None, seconds: float = SECONDS
) -> dict[str, Any]:
    """Return a piece of a clip for a page.

    Args:
        truth, prediction: joint positions (N, 22, 3), metres, world.
        begin: where the piece begins, seconds; None for a piece around the worst second.
        seconds: the piece's length, seconds.

    Returns:
        `errors`, the mean error over the joints for each frame of the clip, cm; `worst`, the worst seconds,
        each with its first frame and its mean error, cm; and from frame `from` on, `truth` and `joints` as
        whole millimetres in the page's axes, 66 per frame. A prediction with NaN can't be shown: then `state`
        is "failed" (with `reason`).
    """
    bad = np.flatnonzero(~np.isfinite(prediction).all((1, 2)))
    if bad.size:
        reason = f"{bad.size} of {len(prediction)} frames are NaN or infinite, first at {bad[0] / FPS:.1f} s"
        return {"state": "failed", "reason": reason}
    distances = 100 * np.linalg.norm(prediction - truth, axis=-1)
    errors = distances.mean(1)
    worst = find_worst_seconds(errors)
    length = round(seconds * FPS)
    first = round(begin * FPS) if begin is not None else worst[0]["first"] - (length - FPS) // 2
    first = max(min(first, len(truth) - length), 0)
    piece = slice(first, first + length)
    return {
        "state": "ready", "fps": FPS, "frames": len(truth), "from": first, "worst": worst,
        "top": colour_scale_top(distances), "mean": round(float(errors.mean()), 3),
        "errors": np.round(errors, 2).tolist(),
        "truth": _millimetres(truth[piece]), "joints": _millimetres(prediction[piece]),
    }  # fmt: skip


def find_worst_seconds(errors: np.ndarray) -> list[dict[str, Any]]:
    """Return the worst seconds of a clip, the worst first, without overlaps.

    Args:
        errors: the mean error of each frame (N,), cm.
    """
    width = min(FPS, len(errors))
    means = np.convolve(errors, np.ones(width) / width, "valid")
    found: list[dict[str, Any]] = []
    while len(found) < WORST and np.isfinite(means).any() and means.max() > -np.inf:
        first = int(means.argmax())
        found.append({"first": first, "mean": round(float(means[first]), 3)})
        gap = width + round(GAP * FPS)
        means[max(first - gap + 1, 0) : first + gap] = -np.inf
    return found


def _millimetres(joints: np.ndarray) -> list[list[int]]:
    positions = PAGE_AXES.convert_positions_from_amass(np.asarray(joints, np.float64))
    return (1000 * positions).round().astype(int).reshape(len(joints), -1).tolist()
