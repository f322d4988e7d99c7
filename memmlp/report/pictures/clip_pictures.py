"""Figures and films of a clip: truth and predictions side by side, coloured by error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import chain, cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from memmlp.common.errors import InputError, require
from memmlp.common.files import atomic_write
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FPS
from memmlp.report.pictures.clip_piece import ClipPiece
from memmlp.report.pictures.drawing import (
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
    require("matplotlib", "plots", key)
    if path.suffix.lower() == ".mp4":
        require("av", "video", key)


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
    av, buffer = require("av", "video", "MP4"), BytesIO()
    frames = (av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24") for picture in pictures)
    with av.open(buffer, "w", format="mp4") as container:
        first = next(frames)
        stream = container.add_stream("libx264", rate=RATE, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = first.width, first.height, "yuv420p"
        for frame in chain([first], frames, [None]):  # None flushes the encoder
            container.mux(stream.encode(frame))
    return buffer.getvalue()
