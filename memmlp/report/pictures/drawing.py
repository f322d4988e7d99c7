"""Skeletons with limbs coloured by error, in a parallel projection, drawn with matplotlib or as SVG."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from io import BytesIO
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from memmlp.motion.body import HEAT, LIMBS, find_limb_ends

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

DPI = 100
NEUTRAL = (0.66, 0.70, 0.74)  # the truth's colour
NEUTRAL_HEX = "#a8b2bd"
ELEVATION = np.deg2rad(12)  # angle by which a camera looks down, radians
DISCS = 24  # number of discs along a limb
TONES = np.linspace(0, 1, 6)  # from a limb's dark edge to its highlight
LIGHT = np.array([-0.28, 0.40])  # offset of the highlight to the right and up, in radii
GRID, STEP = 0.5, 0.1  # distance between the floor's lines, and length of their pieces, metres
FLOOR = 0.56  # radius of the visible floor as a fraction of the picture's width
PANEL = (190, 300)  # width and height of a pose in an SVG, pixels
PIECES = 5  # pieces of a limb in an SVG, each in one colour
SHADOW = 0.16  # radius of a limb's shadow, metres


def make_heat_colours() -> Colormap:
    """Return the colour map for errors, scaled to 0..1."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("heat", HEAT)


@dataclass(frozen=True)
class Camera:
    """A parallel projection of the world (Z up)."""

    centre: np.ndarray  # the point (3,) in the middle of the picture, metres
    azimuth: float  # rotation about the vertical axis, radians; at 0 the camera looks along +Y
    metres: float  # the height of the visible area
    elevation: float = ELEVATION  # the angle by which the camera looks down, radians

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
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def draw_skeleton(
    axes: Axes, camera: Camera, joints: np.ndarray, errors: np.ndarray | None = None, floor: float = 0.0
) -> None:
    """Draw a skeleton with joints (22, 3), metres, world, in a panel, and remove the previous one. The
    panel's coordinates become metres from the camera's centre, to the right and up. `errors` (22,) are
    fractions of the colour scale's top; None for the truth. `floor` is the floor's height, metres."""
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
    colours = [(0, 0, 0, dark) for dark in fade]
    axes.add_collection(LineCollection(list(places), colors=colours, linewidths=0.8))
    feet = np.concatenate([find_limb_ends(limb, joints) for limb in LIMBS])
    spread = SHADOW + 0.25 * np.maximum(np.nan_to_num(feet[:, 2:]) - floor, 0)  # wider for higher joints
    feet[:, 2] = floor
    sizes = 2 * spread * [1, np.sin(camera.elevation)]
    dark = [(0, 0, 0, 0.03 * (SHADOW / radius) ** 2) for (radius,) in spread]
    _add_ellipses(axes, camera.project(feet)[:, :2], sizes, dark)


def _add_ellipses(axes: Axes, places: np.ndarray, sizes: np.ndarray, colours: Any) -> None:
    """Add filled ellipses with centres (n, 2) and widths and heights (n, 2), metres, and n colours."""
    from matplotlib.collections import EllipseCollection

    finite = np.isfinite(places).all(1)  # a diverged network predicts NaN
    widths, heights = sizes[finite].T
    shape: dict[str, Any] = {"units": "xy", "offsets": places[finite], "offset_transform": axes.transData}
    colours = np.asarray(colours)[finite]
    axes.add_collection(EllipseCollection(widths, heights, 0, facecolors=colours, linewidths=0, **shape))


def write_skeleton(camera: Camera, joints: np.ndarray, errors: np.ndarray | None, floor: float) -> str:
    """Return a skeleton with its shadow as SVG elements, in a panel of PANEL pixels; see `draw_skeleton`."""
    scale = PANEL[1] / camera.metres

    def place(point: np.ndarray) -> tuple[float, float]:
        right, up, _ = scale * camera.project(point)
        return PANEL[0] / 2 + right, PANEL[1] / 2 - up

    spread = float(np.linalg.norm(joints[:, :2] - joints[0, :2], axis=1).max())
    x, y = place(np.array([*joints[0, :2], floor]))
    flat = np.sin(camera.elevation)
    shadow = f'<ellipse cx="{x:.1f}" cy="{y:.1f}" rx="{scale * spread:.1f}" ry="{scale * spread * flat:.1f}"'
    parts = [shadow + ' fill="#000" opacity=".08"/>']
    ends = {limb: np.stack(find_limb_ends(limb, joints)) for limb in LIMBS}
    middle = np.linspace(0, 1, PIECES + 1)
    for limb in sorted(LIMBS, key=lambda one: camera.project(ends[one].mean(0))[2]):
        first, last = ends[limb]
        for begin, end in pairwise(middle):
            share, colour = (begin + end) / 2, NEUTRAL_HEX
            if errors is not None:
                colour = mix_heat(float((1 - share) * errors[limb.first_joint] + share * errors[limb.end]))
            (x1, y1), (x2, y2) = (place(first + part * (last - first)) for part in (begin, end))
            radius = scale * (limb.radii[0] + share * (limb.radii[1] - limb.radii[0]))
            line = f'<path d="M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}" stroke="{colour}"'
            parts.append(f'{line} stroke-width="{2 * radius:.1f}" stroke-linecap="round"/>')
    return "".join(parts)


def mix_heat(value: float) -> str:
    """Return the colour of an error, a fraction of the colour scale's top, as #rrggbb."""
    stops = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in HEAT], float)
    at = float(np.clip(np.nan_to_num(value, nan=1.0), 0, 1)) * (len(HEAT) - 1)
    low = min(int(at), len(HEAT) - 2)
    mixed = stops[low] + (at - low) * (stops[low + 1] - stops[low])
    return "#" + "".join(f"{round(part):02x}" for part in mixed)


def write_colour_scale(x: float, y: float, top: float) -> str:
    """Return a horizontal colour scale from 0 to `top` cm as SVG elements."""
    size = 'width="4" height="10"'
    cells = [f'<rect x="{x + 4 * i}" y="{y}" {size} fill="{mix_heat(i / 29)}"/>' for i in range(30)]
    limits = write_text(x, y + 26, "0", 12), write_text(x + 120, y + 26, f"{top:g} cm", 12, anchor="end")
    return "".join((*cells, *limits))


def write_text(
    x: float, y: float, text: str, size: int, weight: str = "normal", anchor: str = "start"
) -> str:
    style = f'font-size="{size}" font-weight="{weight}" text-anchor="{anchor}"'
    return f'<text x="{x:.0f}" y="{y:.0f}" {style}>{escape(text)}</text>'
