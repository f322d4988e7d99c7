"""Replays: a network's predictions for test clips, computed in the background."""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.spaces import SPACES
from memmlp.motion.body import FPS, HEAT, JOINTS, LIMBS
from memmlp.report.pictures.clip_pictures import find_colour_scale_top
from memmlp.report.ui.run_index import get_change_time
from memmlp.runs.run import Run

Predict = Callable[[Run, str, str], Mapping[str, np.ndarray]]
"""Computes "true_positions" and "predicted_positions" (N, 22, 3), metres, from a run, clip and mode."""

PIECE_SECONDS = 10  # default length of a piece
PAGE_AXES = SPACES["openxr"]  # also the axes of three.js
MIN_GAP_SECONDS = 0.5  # minimum time between two of the worst seconds
WORST_SECONDS = 3  # number of worst seconds of a clip
MAX_PREDICTIONS = 64  # maximum number of predictions in memory

Motion = tuple[np.ndarray, np.ndarray]
"""Truth and prediction (N, 22, 3), metres, world."""


class Replays:
    """Computes replays, one at a time.

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
        seconds: float = PIECE_SECONDS,
        timeout: float | None = 0.2,
    ) -> dict[str, Any]:
        """Return a piece of a replay (`cut_piece`), or the state of its computation.

        Args:
            run_id: a finished run's id.
            clip: a test clip's name.
            mode: "stream" or "window".
            begin: start of the piece, seconds; None for a piece around the worst second.
            seconds: length of the piece.
            timeout: maximum wait for the prediction, seconds; None for no limit.

        Returns:
            `state` is "computing", "failed" (with `reason`) or "ready".
        """
        run = Run.from_id(self.outputs, run_id)
        key = run_id, clip, mode, get_change_time(run.marker)  # changes when the run is redone
        with self.lock:
            if key not in self.motions:
                if len(self.motions) >= MAX_PREDICTIONS:
                    del self.motions[next(iter(self.motions))]
                self.motions[key] = self.worker.submit(self._predict, run, clip, mode)
            future = self.motions[key]
        try:
            truth, prediction = future.result(timeout)
        except TimeoutError:
            return {"state": "computing"}
        except Exception as error:  # the page shows the error and may retry
            self.motions.pop(key, None)
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            return {"state": "failed", "reason": reason}
        return cut_piece(truth, prediction, begin, seconds)

    def _predict(self, run: Run, clip: str, mode: str) -> Motion:
        arrays = self.predict(run, clip, mode)
        return arrays["true_positions"], arrays["predicted_positions"]

    def close(self) -> None:
        """Cancel the waiting computations."""
        self.worker.shutdown(wait=False, cancel_futures=True)


def describe_body() -> dict[str, Any]:
    """Return limbs, heat colours, joints and frame rate, which a page needs to draw a person."""
    limbs = [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS]
    return {"limbs": limbs, "heat": HEAT, "joints": JOINTS, "fps": FPS}


def cut_piece(
    truth: np.ndarray, prediction: np.ndarray, begin: float | None = None, seconds: float = PIECE_SECONDS
) -> dict[str, Any]:
    """Return a piece of a clip for a page.

    Args:
        truth, prediction: joint positions (N, 22, 3), metres, world.
        begin: start of the piece, seconds; None for a piece around the worst second.
        seconds: length of the piece.

    Returns:
        `errors` has the mean error over joints for each frame of the clip, cm. `worst` lists the worst
        seconds with first frame and mean error, cm. `truth` and `joints` have 66 integers per frame from
        frame `from` on: millimetres in the page's axes. If the prediction contains NaN, `state` is "failed"
        and `reason` describes why.
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
        "top": find_colour_scale_top(distances), "mean": round(float(errors.mean()), 3),
        "errors": np.round(errors, 2).tolist(),
        "truth": _convert_to_millimetres(truth[piece]), "joints": _convert_to_millimetres(prediction[piece]),
    }  # fmt: skip


def find_worst_seconds(errors: np.ndarray) -> list[dict[str, Any]]:
    """Return a clip's worst seconds without overlaps, the largest error first.

    Args:
        errors: the mean error of each frame (N,), cm.
    """
    width = min(FPS, len(errors))
    means = np.convolve(errors, np.ones(width) / width, "valid")
    seconds: list[dict[str, Any]] = []
    while len(seconds) < WORST_SECONDS and np.isfinite(means).any() and means.max() > -np.inf:
        first = int(means.argmax())
        seconds.append({"first": first, "mean": round(float(means[first]), 3)})
        gap = width + round(MIN_GAP_SECONDS * FPS)
        means[max(first - gap + 1, 0) : first + gap] = -np.inf
    return seconds


def _convert_to_millimetres(joints: np.ndarray) -> list[list[int]]:
    positions = PAGE_AXES.convert_positions_from_amass(np.asarray(joints, np.float64))
    return (1000 * positions).round().astype(int).reshape(len(joints), -1).tolist()
