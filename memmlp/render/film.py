"""Films of truth and predictions side by side, coloured by error, as MP4 or GIF."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import chain, cycle
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FPS
from memmlp.render.canvas import FAINT, Sheet, indexed
from memmlp.render.clip_piece import ClipPiece
from memmlp.render.raster import draw

RATE = 30  # pictures a second
EVERY = FPS // RATE
WIDTH, HEIGHT = 340, 480  # size of a panel, pixels
TOP, RIGHT, BOTTOM = 88, 112, 44
TICKS = (30, 30, 40)  # milliseconds of a GIF's pictures in turn, multiples of 10: 30 a second on average


def film(path: Path, piece: ClipPiece) -> None:
    """Write a film at 30 pictures per second, completely or not at all: MP4 or GIF, by the path's suffix.

    Raises:
        InputError: if MP4 is asked for and PyAV is not installed.
    """
    encode = {".mp4": mp4, ".gif": gif}[path.suffix.lower()]
    if path.suffix.lower() == ".mp4":
        pyav()
    atomic_write(path, encode(pictures(piece)))


def pictures(piece: ClipPiece) -> Iterator[np.ndarray]:
    """Yield the film's pictures (H, W, 3), uint8, with a progress bar."""
    labels = ["truth", *piece.predictions]
    width = len(labels) * WIDTH + RIGHT
    sheet = Sheet(width + width % 2, TOP + HEIGHT + BOTTOM)
    sheet.text(20, 26, piece.title, 22, ha="left", weight="bold")
    time = sheet.text(width - 20, 26, "", 20, ha="right")
    middles = [(column + 0.5) * WIDTH for column in range(len(labels))]
    for x, label in zip(middles, labels, strict=True):
        sheet.text(x, 64, label, 19, weight="bold")
    panels = [sheet.panel(column * WIDTH, TOP, WIDTH, HEIGHT) for column in range(len(labels))]
    means = {
        k: sheet.text(x, TOP + HEIGHT + 18, "", 18, color=FAINT)
        for x, k in zip(middles[1:], labels[1:], strict=True)
    }
    sheet.colour_bar(len(labels) * WIDTH + 16, TOP + 60, 16, HEIGHT - 120, piece.top)
    path, azimuth = piece.path(), piece.azimuth(len(piece.truth) // 2)
    for frame in progress_bar(range(0, len(piece.truth), EVERY), "pictures"):
        camera = piece.camera(azimuth, path[frame], WIDTH, HEIGHT)
        for panel, (joints, errors) in zip(panels, piece.rows(frame), strict=True):
            panel.set_data(draw(camera, joints, errors, piece.floor))
        for label, text in means.items():
            text.set_text(f"{piece.errors[label][frame].mean():.1f} cm")
        time.set_text(f"{piece.seconds(frame):.2f} s")
        yield sheet.pixels()


def gif(pictures: Iterable[np.ndarray]) -> bytes:
    """Encode pictures as a GIF that repeats endlessly."""
    first, *rest = (indexed(picture) for picture in pictures)
    buffer, ticks = BytesIO(), cycle(TICKS)
    durations = [next(ticks) for _ in range(1 + len(rest))]
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=durations, loop=0)
    return buffer.getvalue()


def mp4(pictures: Iterable[np.ndarray]) -> bytes:
    """Encode pictures as H.264 in MP4; width and height must be even."""
    av, buffer = pyav(), BytesIO()
    frames = (av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24") for picture in pictures)
    with av.open(buffer, "w", format="mp4") as container:
        first = next(frames)
        stream = container.add_stream("libx264", rate=RATE, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = first.width, first.height, "yuv420p"
        for frame in chain([first], frames, [None]):  # None makes the encoder give out what it still holds
            container.mux(stream.encode(frame))
    return buffer.getvalue()


def pyav() -> Any:
    """Import and return the module `av`. Raises InputError if it is not installed."""
    try:
        import av
    except ImportError:
        raise InputError(
            "MP4: needs PyAV, pip install 'memmlp[video]'; allowed without it: .gif, .png"
        ) from None
    return av
