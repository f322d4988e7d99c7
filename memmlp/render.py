"""A picture of truth and prediction side by side, joints coloured by their error."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from memmlp.body import FPS, PARENTS, ROOT
from memmlp.files import atomic_write

POSES = 6
REACH = 0.85  # metres shown to the left and right of the pelvis
MIN_SCALE = 10.0  # cm at the top of the colour bar, at least
CAMERA = np.deg2rad(25.0)  # seen from the front, a little from the side


def poses_png(path: Path, truth: np.ndarray, predicted: np.ndarray, title: str) -> None:
    """Write a PNG: a row of poses of the truth, below it the prediction, coloured by error in cm.

    Args:
        truth, predicted: joint positions (N, 22, 3), metres, world (Z up).
    """
    error = 100 * np.linalg.norm(predicted - truth, axis=-1)
    shown = np.linspace(0, len(truth) - 1, POSES + 2).astype(int)[1:-1]
    colours = Normalize(0, max(MIN_SCALE, float(np.percentile(error, 98))))
    figure = Figure(figsize=(2.1 * POSES, 5.4), layout="constrained")
    axes = figure.subplots(2, POSES, sharey=True)
    for column, frame in enumerate(shown):
        view = facing(truth[frame])
        draw(axes[0, column], truth[frame] @ view.T, truth[frame] @ view.T, None, colours)
        draw(axes[1, column], predicted[frame] @ view.T, truth[frame] @ view.T, error[frame], colours)
        axes[0, column].set_title(f"{frame / FPS:.1f} s", fontsize=10)
        axes[1, column].set_title(f"{error[frame].mean():.1f} cm", fontsize=10)
    axes[0, 0].set_ylabel("truth, height [m]")
    axes[1, 0].set_ylabel("prediction, height [m]")
    scalar = matplotlib.cm.ScalarMappable(colours, "turbo")
    figure.colorbar(scalar, ax=axes, label="error of a joint [cm]", shrink=0.6, pad=0.01)
    figure.suptitle(title, fontsize=12)
    buffer = BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    atomic_write(path, buffer.getvalue())


def facing(joints: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) about the vertical that turns the person to the camera (y into the page)."""
    left = joints[1] - joints[2]  # from right to left hip
    angle = -np.arctan2(left[1], left[0]) + CAMERA
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def draw(
    axes: Axes, joints: np.ndarray, centre: np.ndarray, error: np.ndarray | None, colours: Normalize
) -> None:
    """One skeleton (22, 3) seen from the front, centred on another's pelvis."""
    flat = np.stack([joints[:, 0] - centre[ROOT, 0], joints[:, 2]], -1)
    bones = [(flat[j], flat[p]) for j, p in enumerate(PARENTS) if p >= 0]
    if error is None:
        axes.add_collection(LineCollection(bones, colors="0.25", linewidths=2.5))
        axes.scatter(flat[:, 0], flat[:, 1], color="0.25", s=14, zorder=3)
    else:
        values = [error[j] for j, p in enumerate(PARENTS) if p >= 0]
        lines = LineCollection(bones, cmap="turbo", norm=colours, linewidths=3)
        lines.set_array(np.array(values))
        axes.add_collection(lines)
        axes.scatter(flat[:, 0], flat[:, 1], c=error, cmap="turbo", norm=colours, s=22, zorder=3)
    low = min(0.0, float(centre[:, 2].min()))
    axes.axhline(low, color="0.8", linewidth=1, zorder=0)
    axes.set_xlim(-REACH, REACH)
    axes.set_ylim(low - 0.1, max(1.9, float(centre[:, 2].max()) + 0.2))
    axes.set_aspect("equal")
    axes.set_xticks([])
