"""Skeletons drawn with matplotlib: round limbs, coloured by error, over a floor in a parallel projection."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from memmlp.motion.body import HEAT, LIMBS, find_limb_ends

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

DPI = 100
NEUTRAL = (0.66, 0.70, 0.74)  # the truth's colour
ELEVATION = np.deg2rad(12)  # angle by which a camera looks down, radians
DISCS = 24  # number of discs along a limb
TONES = np.linspace(0, 1, 6)  # from a limb's dark edge to its highlight
LIGHT = np.array([-0.28, 0.40])  # offset of the highlight to the right and up, in radii
GRID, STEP = 0.5, 0.1  # distance between the floor's lines, and length of their pieces, metres
FLOOR = 0.56  # radius of the visible floor as a fraction of the picture's width
SHADOW = 0.16  # radius of a limb's shadow, metres


def make_heat_colours() -> Colormap:
    """Return the colour map for errors, scaled to 0..1."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("heat", HEAT)


@dataclass(frozen=True)
class Camera:
    """A parallel projection of the world (Z up).

    Attributes:
        centre: the point (3,) in the middle of the picture, metres.
        azimuth: rotation about the vertical axis, radians; at 0 the camera looks along +Y.
        metres: the height of the visible area.
        elevation: the angle by which the camera looks down, radians.
    """

    centre: np.ndarray
    azimuth: float
    metres: float
    elevation: float = ELEVATION

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors as rows (3, 3): to the right, up, and towards the viewer."""
        (c, s), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in (self.azimuth, self.elevation))
        return np.array([[c, s, 0], [-s * se, c * se, ce], [s * ce, -c * ce, se]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project world points (..., 3) to metres (..., 3) from the centre: right, up, towards the viewer."""
        return (points - self.centre) @ self.axes.T


def make_panels(width: int, height: int, rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """Return a figure of a size in pixels, and its panels (rows, columns) without frames and ticks."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width / DPI, height / DPI), DPI, layout="constrained")
    FigureCanvasAgg(figure)
    plain: dict[str, Any] = {"xticks": (), "yticks": (), "frame_on": False}
    return figure, figure.subplots(rows, columns, squeeze=False, subplot_kw=plain)


def freeze_layout(figure: Figure) -> None:
    """Compute the panel positions once, so later drawings do not move them."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")


def get_pixels(figure: Figure) -> np.ndarray:
    """Draw a figure, and return its pixels (height, width, 3), uint8."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]


def encode_png(figure: Figure) -> bytes:
    """Draw a figure, and return it as a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def draw_skeleton(
    axes: Axes, camera: Camera, joints: np.ndarray, errors: np.ndarray | None = None, floor: float = 0.0
) -> None:
    """Draw a skeleton in a panel, and remove the previous one.

    Args:
        axes: the panel; its coordinates become metres from the camera's centre, to the right and up.
        camera: the projection.
        joints: positions (22, 3), metres, world.
        errors: errors of the joints (22,), as fractions of the colour scale's top; None for the truth.
        floor: the floor's height, metres.
    """
    for artist in list(axes.collections):
        artist.remove()
    box = axes.get_window_extent()
    up, right = camera.metres / 2, camera.metres / 2 * box.width / box.height
    axes.set(xlim=(-right, right), ylim=(-up, up))
    _draw_floor(axes, camera, joints, floor, 2 * right * FLOOR)
    _draw_limbs(axes, camera, joints, errors)


def _draw_limbs(axes: Axes, camera: Camera, joints: np.ndarray, errors: np.ndarray | None) -> None:
    """Draw each limb as overlapping discs, with dark edges and a highlight; distant limbs come first."""
    part = np.linspace(0, 1, DISCS)
    limits = np.array([[camera.project(point) for point in find_limb_ends(limb, joints)] for limb in LIMBS])
    centres = limits[:, :1] + part[:, None] * (limits[:, 1:] - limits[:, :1])  # (limb, disc, 3)
    first, last = np.array([limb.radii for limb in LIMBS]).T[..., None]
    radii = first + part * (last - first)
    colours = np.broadcast_to(NEUTRAL, (*radii.shape, 3))
    if errors is not None:
        begin, end = errors[[limb.first_joint for limb in LIMBS]], errors[[limb.end for limb in LIMBS]]
        colours = make_heat_colours()(begin[:, None] + part * (end - begin)[:, None])[..., :3]
    order = np.argsort(centres[..., 2].mean(1))
    size = 1 - 0.85 * TONES[:, None, None]
    bright = 0.6 + 0.5 * TONES[:, None, None]
    places = centres[order, None, :, :2] + LIGHT * (1 - size) * radii[order, None, :, None]
    _add_ellipses(
        axes,
        places.reshape(-1, 2),
        np.repeat((2 * size[..., 0] * radii[order, None]).reshape(-1, 1), 2, axis=1),
        np.clip(colours[order, None] * bright, 0, 1).reshape(-1, 3),
    )


def _draw_floor(axes: Axes, camera: Camera, joints: np.ndarray, floor: float, radius: float) -> None:
    """Draw a floor grid that fades out with distance, and a soft shadow below both ends of each limb."""
    from matplotlib.collections import LineCollection

    x, y = camera.centre[:2]
    steps, lines = np.arange(-radius, radius, STEP), GRID * np.arange(-radius // GRID, radius // GRID + 1)
    grid = np.stack(np.meshgrid(steps, lines), -1).reshape(-1, 2)
    nearest = np.round(camera.centre[:2] / GRID) * GRID  # a crossing of grid lines
    starts = np.concatenate([np.add(grid, [x, nearest[1]]), np.add(grid[:, ::-1], [nearest[0], y])])
    lengths = np.repeat([[STEP, 0], [0, STEP]], len(grid), axis=0)
    segments = np.stack([starts, starts + lengths], 1)
    fade = np.clip(0.3 * (1 - np.hypot(*(starts - [x, y]).T) / radius), 0, 1)
    heights = np.full((len(segments), 2, 1), floor)
    places = camera.project(np.concatenate([segments, heights], -1))[..., :2]
    axes.add_collection(
        LineCollection(list(places), colors=[(0, 0, 0, dark) for dark in fade], linewidths=0.8)
    )
    feet = np.concatenate([find_limb_ends(limb, joints) for limb in LIMBS])
    spread = SHADOW + 0.25 * np.maximum(
        np.nan_to_num(feet[:, 2:]) - floor, 0
    )  # higher joints: wider, fainter
    feet[:, 2] = floor
    sizes = 2 * spread * [1, np.sin(camera.elevation)]
    dark = [(0, 0, 0, 0.03 * (SHADOW / radius) ** 2) for (radius,) in spread]
    _add_ellipses(axes, camera.project(feet)[:, :2], sizes, dark)


def _add_ellipses(axes: Axes, places: np.ndarray, sizes: np.ndarray, colours: Any) -> None:
    """Add filled ellipses.

    Args:
        axes: the panel.
        places: the centres (n, 2), metres.
        sizes: widths and heights (n, 2), metres.
        colours: n colours.
    """
    from matplotlib.collections import EllipseCollection

    finite = np.isfinite(places).all(1)  # a diverged network predicts NaN
    widths, heights = sizes[finite].T
    shape: dict[str, Any] = {"units": "xy", "offsets": places[finite], "offset_transform": axes.transData}
    colours = np.asarray(colours)[finite]
    axes.add_collection(EllipseCollection(widths, heights, 0, facecolors=colours, linewidths=0, **shape))
