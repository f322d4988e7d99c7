"""Figures and films of a clip: truth and predictions side by side, coloured by error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from itertools import chain, cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from memmlp.common.errors import InputError, import_optional
from memmlp.common.files import atomic_write
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FPS, LIMBS, RADII, ROOT
from memmlp.report.pictures.drawing import (
    ELEVATION,
    NEUTRAL,
    PANEL,
    Camera,
    draw_skeleton,
    encode_png,
    freeze_layout,
    get_pixels,
    make_heat_colours,
    make_panels,
    write_colour_scale,
    write_skeleton,
    write_text,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

SUFFIXES = (".svg", ".png", ".gif", ".mp4")
POSES = 6  # default number of poses
RATE = 30  # pictures per second
TICKS = (30, 30, 40)  # durations of GIF pictures in turn, ms: multiples of 10, on average 30 per second
BOTTOM = -0.195  # height of a picture's lower edge above the floor, metres
SIDE = np.deg2rad(25)  # the camera's angle from the person's front, radians
LOWEST, HIGHEST = 2.15, 2.9  # smallest and largest height that a picture covers, metres
TIP = max(limb.tip + max(limb.radii) for limb in LIMBS)  # largest reach of a limb beyond its joint, metres
SCALES = (10, 15, 20, 30, 40, 50, 75, 100)  # the possible tops of a colour scale, cm
SMOOTHING = 0.2  # seconds over which the camera's path is smoothed


def find_frame_range(
    length: int, title: str, begin: float, end: float | None, keys: tuple[str, str] = ("begin", "end")
) -> tuple[int, int]:
    """Return the first frame of a piece of a clip with `length` frames, and the frame after its end. The
    piece begins and ends at times in seconds; None is the end of the clip. `keys` are the names of begin and
    end in messages. Raises InputError if the piece contains no frame."""
    stop = length / FPS if end is None else min(end, length / FPS)
    if not 0 <= begin < stop or round(begin * FPS) == round(stop * FPS):  # also true for NaN
        given = f"{keys[0]} {begin:g}" + ("" if end is None else f" {keys[1]} {end:g}")
        raise InputError(f"{given}: must contain a frame; {title} has {length / FPS:.1f} s")
    return round(begin * FPS), round(stop * FPS)


def find_colour_scale_top(errors: np.ndarray) -> float:
    """Return the first value in `SCALES` that is at least the 98th percentile of the errors, cm."""
    high = float(np.percentile(errors, 98))
    return float(next((top for top in SCALES if high <= top), SCALES[-1]))


@dataclass(frozen=True)
class ClipPiece:
    """A piece of a clip with true joint positions (N, 22, 3), metres, world (Z up), at 60 Hz, and predictions
    of them by label. `title` is the clip's name, `start` the index of the piece's first frame in the clip."""

    title: str
    truth: np.ndarray
    predictions: Mapping[str, np.ndarray]
    start: int = 0

    @cached_property
    def errors(self) -> dict[str, np.ndarray]:
        """Each joint's distance (N, 22) from the truth, cm, by label."""
        return {k: 100 * np.linalg.norm(p - self.truth, axis=-1) for k, p in self.predictions.items()}

    @cached_property
    def top(self) -> float:
        """The top of the colour scale, cm, shared by all predictions."""
        return find_colour_scale_top(np.stack(list(self.errors.values())))

    @cached_property
    def floor(self) -> float:
        """The floor's height, metres, estimated from the lowest true joints."""
        return float(np.percentile(self.truth[..., 2].min(1), 5)) - min(RADII)

    @cached_property
    def metres(self) -> float:
        """The height of the visible area, metres; raised hands make it larger."""
        joints = np.stack([self.truth, *self.predictions.values()])
        distance = np.linalg.norm(joints[..., :2] - self.truth[:, None, ROOT, :2], axis=-1)
        up = joints[..., 2] - self.floor + np.tan(ELEVATION) * distance  # distant joints are drawn higher
        highest = np.nan_to_num(up, nan=0.0, posinf=0.0).max() + TIP
        return float(np.clip(highest - BOTTOM, LOWEST, HIGHEST))

    def list_skeletons(self, frame: int) -> list[tuple[np.ndarray, np.ndarray | None]]:
        """Return joints (22, 3) and errors (22,), as fractions of the scale's top, of each skeleton. The
        truth comes first, with None as errors."""
        predicted = [(p[frame], self.errors[k][frame] / self.top) for k, p in self.predictions.items()]
        return [(self.truth[frame], None), *predicted]

    def make_camera(self, azimuth: float, place: np.ndarray) -> Camera:
        """Return a camera that looks at a point (2,) on the floor, metres, and at the person above it."""
        return Camera(np.array([*place, self.floor + BOTTOM + self.metres / 2]), azimuth, self.metres)

    def find_azimuth(self, frame: int) -> float:
        """Return the camera azimuth, radians: a front view of the true person, turned slightly sideways."""
        left = self.truth[frame, 1] - self.truth[frame, 2]  # from right to left hip
        return float(np.arctan2(left[1], left[0])) + SIDE

    def smooth_camera_path(self) -> np.ndarray:
        """Return the camera's position in each frame (N, 2), metres: the smoothed true root."""
        from scipy.ndimage import gaussian_filter1d  # slow to import

        return gaussian_filter1d(self.truth[:, ROOT, :2], SMOOTHING * FPS, axis=0, mode="nearest")

    def find_seconds(self, frame: int) -> float:
        return (self.start + frame) / FPS


def check_picture_path(path: Path, key: str = "path", suffixes: tuple[str, ...] = SUFFIXES) -> None:
    """Raise InputError, with the name of the option or argument, for an invalid picture file or a missing
    package."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{key} {path}: must end in {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise InputError(f"{key} {path}: there is no folder {path.parent}")
    if path.suffix.lower() != ".svg":
        import_optional("matplotlib", "plots", key)
    if path.suffix.lower() == ".mp4":
        import_optional("av", "video", key)


def write_picture(path: Path, piece: ClipPiece, poses: int = POSES, key: str = "path") -> None:
    """Write a PNG or SVG of `poses` poses, or a GIF or MP4 of all frames, completely or not at all. Raises
    InputError if the file can't be written, or PyAV is not installed for an MP4."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".svg":
            atomic_write(path, encode_svg(piece, poses))
        elif suffix == ".png":
            atomic_write(path, encode_png(draw_poses(piece, poses)))
        else:
            atomic_write(path, {".gif": encode_gif, ".mp4": encode_mp4}[suffix](draw_film(piece)))
    except OSError as error:
        raise InputError(f"{key} {path}: {error.strerror or error}") from None


def select_frames(piece: ClipPiece, poses: int) -> list[int]:
    """Return the frames of `poses` poses, evenly spaced in a piece."""
    return [int(frame) for frame in np.linspace(0, len(piece.truth) - 1, poses + 2).round()[1:-1]]


def draw_poses(piece: ClipPiece, poses: int = POSES) -> Figure:
    """Draw a heat-map figure like the paper's Figs. 6 and 9 to 13. The first row shows true poses. Each other
    row shows a prediction, coloured by error, with the mean error of the 22 joints below. All rows show a
    pose from the same camera, in front of the person."""
    labels = ["truth", *piece.predictions]
    figure, panels = make_panels(150 + 230 * poses, 60 + 360 * len(labels), len(labels), poses)
    frames = select_frames(piece, poses)
    for column, frame in zip(panels.T, frames, strict=True):
        column[0].set_title(f"{piece.find_seconds(frame):.2f} s")
        _write_errors(column[1:], piece, frame)
    for panel, label in zip(panels[:, 0], labels, strict=True):
        panel.set_ylabel(label, weight="bold")
    _add_colour_scale(figure, piece)
    for column, frame in zip(panels.T, progress_bar(frames, "poses"), strict=True):
        camera = piece.make_camera(piece.find_azimuth(frame), piece.truth[frame, 0, :2])
        _draw_skeletons(column, piece, frame, camera)
    return figure


def encode_svg(piece: ClipPiece, poses: int = POSES) -> str:
    """Encode the figure of `draw_poses` as SVG, which does not need matplotlib."""
    labels, frames = ["truth", *piece.predictions], select_frames(piece, poses)
    width, height = 70 + PANEL[0] * poses, 56 + PANEL[1] * len(labels)
    parts = [write_text(12, 30, piece.title, 18, "bold")]
    for row, label in enumerate(labels):
        y = 56 + PANEL[1] * row
        parts.append(write_text(12, y + 16, label, 15, "bold"))
        for column, frame in enumerate(frames):
            camera = piece.make_camera(piece.find_azimuth(frame), piece.truth[frame, 0, :2])
            joints, errors = piece.list_skeletons(frame)[row]
            x = 40 + PANEL[0] * column
            parts.append(f'<svg x="{x}" y="{y}" width="{PANEL[0]}" height="{PANEL[1]}">')
            parts.append(write_skeleton(camera, joints, errors, piece.floor) + "</svg>")
            seconds = piece.find_seconds(frame)
            note = f"{piece.errors[label][frame].mean():.1f} cm" if row else f"{seconds:.2f} s"
            parts.append(write_text(x + PANEL[0] / 2, y + PANEL[1] - 8, note, 13, anchor="middle"))
    parts.append(write_colour_scale(width - 150, 14, piece.top))
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    style = 'font-family="sans-serif" fill="#222"'
    background = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>{background}{"".join(parts)}</svg>\n'


def draw_film(piece: ClipPiece) -> Iterator[np.ndarray]:
    """Yield a film's pictures (H, W, 3), uint8, 30 per second, and show a progress bar. H and W are even."""
    labels = ["truth", *piece.predictions]
    figure, panels = make_panels(120 + 340 * len(labels), 600, 1, len(labels))
    for panel, label in zip(panels[0], labels, strict=True):
        panel.set_title(label, weight="bold")
    _write_errors(panels[0, 1:], piece, 0)
    title = _add_colour_scale(figure, piece)
    path, azimuth = piece.smooth_camera_path(), piece.find_azimuth(len(piece.truth) // 2)
    for frame in progress_bar(range(0, len(piece.truth), FPS // RATE), "pictures"):
        _draw_skeletons(panels[0], piece, frame, piece.make_camera(azimuth, path[frame]))
        _write_errors(panels[0, 1:], piece, frame)
        title.set_text(f"{piece.title}   {piece.find_seconds(frame):.2f} s")
        yield get_pixels(figure)


def _draw_skeletons(panels: Iterable[Axes], piece: ClipPiece, frame: int, camera: Camera) -> None:
    for panel, (joints, errors) in zip(panels, piece.list_skeletons(frame), strict=True):
        draw_skeleton(panel, camera, joints, errors, piece.floor)


def _write_errors(panels: Iterable[Axes], piece: ClipPiece, frame: int) -> None:
    for panel, errors in zip(panels, piece.errors.values(), strict=True):
        panel.set_xlabel(f"{errors[frame].mean():.1f} cm")


def _add_colour_scale(figure: Figure, piece: ClipPiece) -> Text:
    """Add the colour scale and the title, fix the layout, and return the title."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colours = ScalarMappable(Normalize(0, piece.top), make_heat_colours())
    figure.colorbar(colours, ax=figure.axes, shrink=0.6, aspect=24, label="error of a joint [cm]")
    title = figure.suptitle(piece.title, x=0.01, ha="left", weight="bold", size=16)
    freeze_layout(figure)
    return title


def encode_gif(pictures: Iterable[np.ndarray]) -> bytes:
    """Encode pictures as a GIF that repeats endlessly. All pictures share one palette, so the film does not
    flicker. It has shades of the heat map, of the truth's colour and of grey."""
    from PIL import Image

    heat, white = make_heat_colours()(np.linspace(0, 1, 28))[:, :3], np.ones((1, 3))
    hues = ((heat, 7, 1.1), (np.array([NEUTRAL]), 36, 1.1), (white, 24, 1.0))
    shades = [(np.linspace(0.3, top, n)[:, None, None] * hue).reshape(-1, 3) for hue, n, top in hues]
    palette = Image.new("P", (1, 1))
    palette.putpalette((255 * np.clip(np.concatenate(shades), 0, 1) + 0.5).astype(np.uint8).tobytes())
    images, no_dither = map(Image.fromarray, pictures), Image.Dither.NONE
    first, *others = (image.quantize(palette=palette, dither=no_dither) for image in images)
    buffer, ticks = BytesIO(), cycle(TICKS)
    durations = [next(ticks) for _ in range(1 + len(others))]
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    return buffer.getvalue()


def encode_mp4(pictures: Iterable[np.ndarray]) -> bytes:
    """Encode pictures as H.264 in MP4; width and height must be even."""
    av, buffer = import_optional("av", "video", "MP4"), BytesIO()
    frames = (av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24") for picture in pictures)
    with av.open(buffer, "w", format="mp4") as container:
        first = next(frames)
        stream = container.add_stream("libx264", rate=RATE, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = first.width, first.height, "yuv420p"
        for frame in chain([first], frames, [None]):  # None flushes the encoder
            container.mux(stream.encode(frame))
    return buffer.getvalue()
