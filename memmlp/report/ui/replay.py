"""Replays: a network's predictions for test clips, computed in the background and stored in the cache."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import read_json
from memmlp.live.spaces import SPACES
from memmlp.motion.body import FPS, JOINTS
from memmlp.motion.limb_shapes import HEAT, LIMBS
from memmlp.report.pictures.raster import scale
from memmlp.runs.identity import evaluation_id
from memmlp.runs.run import Run

Predict = Callable[[Run, str, str], Mapping[str, np.ndarray]]
"""Gives "true_positions" and "predicted_positions" (N, 22, 3), metres, of a run's test clip in a mode."""

SECONDS = 10  # the length of the piece around the worst second that a page gets
SHOWN = SPACES["openxr"]  # the page's axes: those of three.js
SPREAD = 0.5  # seconds between two of a clip's worst moments, at least
MOST = 64  # predictions that are kept in memory
WORST = 3  # how many of a clip's worst seconds are told


class Replays:
    """Makes replays one after the other, and stores the predictions.

    Args:
        outputs: the folder of runs and caches.
        predict: computes a prediction; None if nothing can be computed.
    """

    def __init__(self, outputs: Path, predict: Predict | None):
        self.outputs, self.predict = outputs, predict
        self.worker = ThreadPoolExecutor(1, "replay")
        self.made: dict[tuple[str, str, str], Future[dict[str, np.ndarray]]] = {}
        self.lock = threading.Lock()

    def get_waiting(
        self, run_id: str, clip: str, mode: str, begin: float | None = None, seconds: float = SECONDS
    ) -> dict[str, Any]:
        """Compute a piece of `seconds` of a replay and return it as `get` does, but only once it is there."""
        try:
            motion = self._motion(Run.of(self.outputs, run_id), clip, mode)
        except Exception as error:
            return _failed(error)
        return piece(motion["truth"], motion["joints"], begin, seconds)

    def get(self, run_id: str, clip: str, mode: str, begin: float | None = None) -> dict[str, Any]:
        """Return a piece of a replay, or say that it is being computed.

        Args:
            run_id: a finished run's id.
            clip: a test clip's name.
            mode: "stream" or "window".
            begin: where the piece begins, seconds; None for a piece around the worst second.

        Returns:
            `state` is "computing", "failed" (with `reason`) or "ready".
        """
        with self.lock:
            key = (run_id, clip, mode)
            if key not in self.made:
                if len(self.made) >= MOST:
                    del self.made[next(iter(self.made))]
                self.made[key] = self.worker.submit(self._motion, Run.of(self.outputs, run_id), clip, mode)
            future = self.made[key]
        try:
            motion = future.result(timeout=0.2)
        except TimeoutError:
            return {"state": "computing"}
        except Exception as error:  # the page tells it, and may ask again; the server goes on
            self.made.pop(key, None)
            return _failed(error)
        return piece(motion["truth"], motion["joints"], begin)

    def _motion(self, run: Run, clip: str, mode: str) -> dict[str, np.ndarray]:
        """Return truth and prediction (N, 22, 3), metres, world, from the store or newly computed."""
        path = self._path(run, clip, mode)
        known = _read(path)
        if known is not None:
            return known
        if self.predict is None:
            raise InputError("no prediction of this clip is kept here")
        arrays = self.predict(run, clip, mode)
        made = {
            "truth": np.asarray(arrays["true_positions"], np.float32),
            "joints": np.asarray(arrays["predicted_positions"], np.float32),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp.npz")
        np.savez(temporary, allow_pickle=False, truth=made["truth"], joints=made["joints"])
        temporary.replace(path)
        return made

    def _path(self, run: Run, clip: str, mode: str) -> Path:
        """Return the file of a prediction, named after the weights and recipes with which it was made."""
        weights = str(read_json(run.marker).get("artifacts", {}).get(run.model.name))
        data = str(run.manifest.get("data"))
        made_by = evaluation_id(run.config, mode)
        words = hashlib.sha256("\n".join([run.id, weights, data, clip, made_by]).encode()).hexdigest()[:24]
        return self.outputs / "cache" / "ui" / "replays" / f"{words}.npz"

    def close(self) -> None:
        """Cancel the computations that are still waiting."""
        self.worker.shutdown(wait=False, cancel_futures=True)


def _failed(error: Exception) -> dict[str, Any]:
    words = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    return {"state": "failed", "reason": words}


def _read(path: Path) -> dict[str, np.ndarray] | None:
    """Return a stored prediction; None if there is none, or if its file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in ("truth", "joints")}
    except (OSError, ValueError, KeyError, EOFError):
        return None
    same = found["truth"].shape == found["joints"].shape and found["truth"].shape[1:] == (len(JOINTS), 3)
    return found if same else None


def body() -> dict[str, Any]:
    """Return what a page needs in order to draw a person."""
    limbs = [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS]
    return {"limbs": limbs, "heat": HEAT, "joints": JOINTS, "fps": FPS}


def piece(
    truth: np.ndarray, joints: np.ndarray, begin: float | None = None, seconds: float = SECONDS
) -> dict[str, Any]:
    """Return a piece of a clip for a page.

    Args:
        truth, joints: positions (N, 22, 3), metres, world.
        begin: where the piece begins, seconds; None for a piece around the worst second.
        seconds: the piece's length, seconds.

    Returns:
        `errors`, the mean error over the joints for each frame of the clip, cm; `worst`, the worst seconds,
        each with its first frame and its mean error, cm; and from frame `from` on, `truth` and `joints` as
        whole millimetres in the page's axes, 66 per frame. Joints that are no numbers can't be shown: then
        `state` is "failed" (with `reason`).
    """
    bad = np.flatnonzero(~np.isfinite(joints).all((1, 2)))
    if bad.size:
        first_bad = f"first at {bad[0] / FPS:.1f} s"
        return {
            "state": "failed",
            "reason": f"{bad.size} of {len(joints)} frames are no numbers, {first_bad}",
        }
    distances = 100 * np.linalg.norm(joints - truth, axis=-1)
    errors = distances.mean(1)
    worst = worst_seconds(errors)
    length = round(seconds * FPS)
    first = round(begin * FPS) if begin is not None else worst[0]["first"] - (length - FPS) // 2
    first = max(min(first, len(truth) - length), 0)
    shown = slice(first, first + length)
    return {
        "state": "ready", "fps": FPS, "frames": len(truth), "from": first, "worst": worst,
        "top": scale(distances), "mean": round(float(errors.mean()), 3),
        "errors": np.round(errors, 2).tolist(),
        "truth": _millimetres(truth[shown]), "joints": _millimetres(joints[shown]),
    }  # fmt: skip


def worst_seconds(errors: np.ndarray) -> list[dict[str, Any]]:
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
        gap = width + round(SPREAD * FPS)
        means[max(first - gap + 1, 0) : first + gap] = -np.inf
    return found


def _millimetres(joints: np.ndarray) -> list[list[int]]:
    shown = SHOWN.positions_out(np.asarray(joints, np.float64))
    return (1000 * shown).round().astype(int).reshape(len(joints), -1).tolist()
