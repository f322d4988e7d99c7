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
from memmlp.motion.body import FPS, ROOT
from memmlp.motion.limb_shapes import LIMBS, RADII
from memmlp.report.pictures.drawing import (
    ELEVATION,
    NEUTRAL,
    Camera,
    draw_skeleton,
    encode_png,
    fix_layout,
    get_pixels,
    heat_colours,
    make_panels,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

SUFFIXES = (".png", ".gif", ".mp4")
POSES = 6
RATE = 30  # pictures a second
TICKS = (30, 30, 40)  # milliseconds of a GIF's pictures in turn, multiples of 10: 30 a second on average
BOTTOM = -0.195  # height of a picture's lower edge above the floor, metres
SIDE = np.deg2rad(25)  # the camera's angle from the person's front, radians
LOWEST, HIGHEST = 2.15, 2.9  # smallest and largest height that a picture covers, metres
TIP = max(limb.tip + max(limb.radii) for limb in LIMBS)  # largest reach of a limb beyond its joint, metres
SCALES = (10, 15, 20, 30, 40, 50, 75, 100)  # the possible tops of a colour scale, cm
SMOOTHING = 0.2  # seconds over which the camera's path is smoothed


def frame_range(
    length: int, title: str, begin: float, end: float | None, keys: tuple[str, str] = ("begin", "end")
) -> tuple[int, int]:
    """Return the first frame of a piece of a clip, and the frame after its last.

    Args:
        length: the clip's number of frames.
        title: the clip's name.
        begin, end: beginning and end of the piece, seconds; None for the clip's end.
        keys: the options or arguments that gave begin and end.

    Raises:
        InputError: if there is no frame between begin and end.
    """
    stop = length / FPS if end is None else min(end, length / FPS)
    if not 0 <= begin < stop or round(begin * FPS) == round(stop * FPS):  # NaN is neither
        given = f"{keys[0]} {begin:g}" + ("" if end is None else f" {keys[1]} {end:g}")
        raise InputError(f"{given}: there is no frame between; {title} has {length / FPS:.1f} s")
    return round(begin * FPS), round(stop * FPS)


def colour_scale_top(errors: np.ndarray) -> float:
    """Return the top of a scale for errors in cm: the least of `SCALES` below which 98 % of them are."""
    high = float(np.percentile(errors, 98))
    return float(next((top for top in SCALES if high <= top), SCALES[-1]))


@dataclass(frozen=True)
class ClipPiece:
    """A piece of a clip: the truth, and predictions by their labels.

    Attributes:
        title: the clip's name.
        truth: joint positions (N, 22, 3), metres, world (Z up), at 60 Hz.
        predictions: the same for each label.
        start: the index in the clip of the piece's first frame.
    """

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
        return colour_scale_top(np.stack(list(self.errors.values())))

    @cached_property
    def floor(self) -> float:
        """The floor's height, metres: where the truth's lowest joints are."""
        return float(np.percentile(self.truth[..., 2].min(1), 5)) - min(RADII)

    @cached_property
    def metres(self) -> float:
        """The height that a picture covers, metres: larger with hands above the head."""
        joints = np.stack([self.truth, *self.predictions.values()])
        distance = np.linalg.norm(joints[..., :2] - self.truth[:, None, ROOT, :2], axis=-1)
        up = joints[..., 2] - self.floor + np.tan(ELEVATION) * distance  # distant joints are drawn higher
        highest = np.nan_to_num(up, nan=0.0, posinf=0.0).max() + TIP
        return float(np.clip(highest - BOTTOM, LOWEST, HIGHEST))

    def rows(self, frame: int) -> list[tuple[np.ndarray, np.ndarray | None]]:
        """Return joints (22, 3) and their errors (22,) as fractions of the scale's top, for each row.

        The truth is first; its errors are None.
        """
        predicted = [(p[frame], self.errors[k][frame] / self.top) for k, p in self.predictions.items()]
        return [(self.truth[frame], None), *predicted]

    def camera(self, azimuth: float, place: np.ndarray) -> Camera:
        """Return a camera that looks at a person standing at a point (2,) on the floor, metres."""
        return Camera(np.array([*place, self.floor + BOTTOM + self.metres / 2]), azimuth, self.metres)

    def azimuth(self, frame: int) -> float:
        """Return the azimuth, radians, that shows the true person from the front, slightly from the side."""
        left = self.truth[frame, 1] - self.truth[frame, 2]  # from right to left hip
        return float(np.arctan2(left[1], left[0])) + SIDE

    def path(self) -> np.ndarray:
        """Return the camera's position over time (N, 2), metres: the truth's root, smoothed."""
        from scipy.ndimage import gaussian_filter1d  # slow to import

        return gaussian_filter1d(self.truth[:, ROOT, :2], SMOOTHING * FPS, axis=0, mode="nearest")

    def seconds(self, frame: int) -> float:
        """Return the time of a frame in the clip, seconds."""
        return (self.start + frame) / FPS


def check_picture(path: Path, key: str = "path", suffixes: tuple[str, ...] = SUFFIXES) -> None:
    """Raise InputError for an invalid picture file or a missing package, before any work is done.

    Args:
        path: the file to write.
        key: the option or argument that gave the path.
        suffixes: the possible suffixes.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{key} {path}: must end in {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise InputError(f"{key} {path}: there is no folder {path.parent}")
    import_optional("matplotlib", "plots", key)
    if path.suffix.lower() == ".mp4":
        import_optional("av", "video", key)


def write_picture(path: Path, piece: ClipPiece, poses: int = POSES, key: str = "path") -> None:
    """Write a PNG of `poses` poses in a row, or a GIF or MP4 of all frames, completely or not at all.

    Raises:
        InputError: if the file can't be written, or PyAV is not installed for an MP4.
    """
    suffix = path.suffix.lower()
    try:
        if suffix == ".png":
            atomic_write(path, encode_png(draw_poses(piece, poses)))
        else:
            atomic_write(path, {".gif": encode_gif, ".mp4": encode_mp4}[suffix](draw_film(piece)))
    except OSError as error:
        raise InputError(f"{key} {path}: {error.strerror or error}") from None


def draw_poses(piece: ClipPiece, poses: int = POSES) -> Figure:
    """Draw a heat-map figure like the paper's Figs. 6 and 9 to 13.

    The first row has the truth's poses, and each further row a prediction, coloured by error. Each pose is
    seen from the person's front, by the same camera in all rows. The mean error of the 22 joints is written
    under a prediction.
    """
    labels = ["truth", *piece.predictions]
    figure, panels = make_panels(150 + 230 * poses, 60 + 360 * len(labels), len(labels), poses)
    frames = np.linspace(0, len(piece.truth) - 1, poses + 2).round().astype(int)[1:-1].tolist()
    for column, frame in zip(panels.T, frames, strict=True):
        column[0].set_title(f"{piece.seconds(frame):.2f} s")
        _write_errors(column[1:], piece, frame)
    for panel, label in zip(panels[:, 0], labels, strict=True):
        panel.set_ylabel(label, weight="bold")
    _add_scale(figure, piece)
    for column, frame in zip(panels.T, progress_bar(frames, "poses"), strict=True):
        camera = piece.camera(piece.azimuth(frame), piece.truth[frame, 0, :2])
        _draw_skeletons(column, piece, frame, camera)
    return figure


def draw_film(piece: ClipPiece) -> Iterator[np.ndarray]:
    """Yield a film's pictures (H, W, 3), uint8, 30 a second, with a progress bar. H and W are even."""
    labels = ["truth", *piece.predictions]
    figure, panels = make_panels(120 + 340 * len(labels), 600, 1, len(labels))
    for panel, label in zip(panels[0], labels, strict=True):
        panel.set_title(label, weight="bold")
    _write_errors(panels[0, 1:], piece, 0)
    title = _add_scale(figure, piece)
    path, azimuth = piece.path(), piece.azimuth(len(piece.truth) // 2)
    for frame in progress_bar(range(0, len(piece.truth), FPS // RATE), "pictures"):
        _draw_skeletons(panels[0], piece, frame, piece.camera(azimuth, path[frame]))
        _write_errors(panels[0, 1:], piece, frame)
        title.set_text(f"{piece.title}   {piece.seconds(frame):.2f} s")
        yield get_pixels(figure)


def _draw_skeletons(panels: Iterable[Axes], piece: ClipPiece, frame: int, camera: Camera) -> None:
    for panel, (joints, errors) in zip(panels, piece.rows(frame), strict=True):
        draw_skeleton(panel, camera, joints, errors, piece.floor)


def _write_errors(panels: Iterable[Axes], piece: ClipPiece, frame: int) -> None:
    for panel, errors in zip(panels, piece.errors.values(), strict=True):
        panel.set_xlabel(f"{errors[frame].mean():.1f} cm")


def _add_scale(figure: Figure, piece: ClipPiece) -> Text:
    """Add the colour scale and the title, fix the layout, and return the title."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colours = ScalarMappable(Normalize(0, piece.top), heat_colours())
    figure.colorbar(colours, ax=figure.axes, shrink=0.6, aspect=24, label="error of a joint [cm]")
    title = figure.suptitle(piece.title, x=0.01, ha="left", weight="bold", size=16)
    fix_layout(figure)
    return title


def encode_gif(pictures: Iterable[np.ndarray]) -> bytes:
    """Encode pictures as a GIF that repeats endlessly.

    All pictures have one palette, so that the film does not flicker: the heat map and the truth in light and
    shadow, and greys.
    """
    from PIL import Image

    heat, white = heat_colours()(np.linspace(0, 1, 28))[:, :3], np.ones((1, 3))
    hues = ((heat, 7, 1.1), (np.array([NEUTRAL]), 36, 1.1), (white, 24, 1.0))
    shades = [(np.linspace(0.3, top, n)[:, None, None] * hue).reshape(-1, 3) for hue, n, top in hues]
    palette = Image.new("P", (1, 1))
    palette.putpalette((255 * np.clip(np.concatenate(shades), 0, 1) + 0.5).astype(np.uint8).tobytes())
    first, *others = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    )
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
