"""Figures and films of a clip: truth and predictions side by side, coloured by error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import chain, cycle
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError, require
from memmlp.common.files import atomic_write
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FPS
from memmlp.report.pictures.canvas import FAINT, Sheet, png
from memmlp.report.pictures.clip_piece import ClipPiece
from memmlp.report.pictures.raster import NEUTRAL, draw, heat_colours

SUFFIXES = (".png", ".gif", ".mp4")
POSES = 6

# Sizes of a figure's panels and margins, pixels.
POSE_WIDTH, POSE_HEIGHT = 230, 330
HEAD, LEFT, COLOUR_BAR, CAPTION = 84, 40, 110, 26

# Sizes of a film's panels and margins, pixels.
WIDTH, HEIGHT = 340, 480
TOP, RIGHT, BOTTOM = 88, 112, 44

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
            atomic_write(path, png(draw_poses(piece, poses)))
        else:
            atomic_write(path, {".gif": encode_gif, ".mp4": encode_mp4}[suffix](draw_film(piece)))
    except OSError as error:
        raise InputError(f"{key} {path}: {error.strerror or error}") from None


def draw_poses(piece: ClipPiece, poses: int = POSES) -> np.ndarray:
    """Draw a heat-map figure like the paper's Figs. 6 and 9 to 13, as a picture (height, width, 3), uint8.

    The first row has the truth's poses, and each further row a prediction, coloured by error. Each pose is
    seen from the person's front, by the same camera in all rows. The mean error of the 22 joints is written
    under a prediction.
    """
    rows, step = 1 + len(piece.predictions), POSE_HEIGHT + CAPTION
    sheet = Sheet(LEFT + poses * POSE_WIDTH + COLOUR_BAR, HEAD + rows * step + 8)
    sheet.text(LEFT, 28, piece.title, 22, ha="left", weight="bold")
    for row, label in enumerate(["truth", *piece.predictions]):
        sheet.text(20, HEAD + row * step + POSE_HEIGHT / 2, label, 17, rotation=90, weight="bold")
    frames = np.linspace(0, len(piece.truth) - 1, poses + 2).round().astype(int)[1:-1]
    for column, frame in enumerate(progress_bar(frames.tolist(), "poses")):
        x = LEFT + column * POSE_WIDTH
        sheet.text(x + POSE_WIDTH / 2, HEAD - 16, f"{piece.seconds(frame):.2f} s", 17)
        camera = piece.camera(piece.azimuth(frame), piece.truth[frame, 0, :2], POSE_WIDTH, POSE_HEIGHT)
        for row, (joints, errors) in enumerate(piece.rows(frame)):
            panel = sheet.panel(x, HEAD + row * step, POSE_WIDTH, POSE_HEIGHT)
            panel.set_data(draw(camera, joints, errors, piece.floor))
        for row, errors in enumerate(piece.errors.values(), 2):
            mean = f"{errors[frame].mean():.1f} cm"
            sheet.text(x + POSE_WIDTH / 2, HEAD + row * step - CAPTION + 10, mean, 16, color=FAINT)
    tall = min(360, rows * step - 40)
    sheet.colour_bar(LEFT + poses * POSE_WIDTH + 18, HEAD + (rows * step - tall) // 2, 16, tall, piece.top)
    return sheet.pixels()


def draw_film(piece: ClipPiece) -> Iterator[np.ndarray]:
    """Yield a film's pictures (H, W, 3), uint8, 30 a second, with a progress bar."""
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
        label: sheet.text(x, TOP + HEIGHT + 18, "", 18, color=FAINT)
        for x, label in zip(middles[1:], labels[1:], strict=True)
    }
    sheet.colour_bar(len(labels) * WIDTH + 16, TOP + 60, 16, HEIGHT - 120, piece.top)
    path, azimuth = piece.path(), piece.azimuth(len(piece.truth) // 2)
    for frame in progress_bar(range(0, len(piece.truth), FPS // RATE), "pictures"):
        camera = piece.camera(azimuth, path[frame], WIDTH, HEIGHT)
        for panel, (joints, errors) in zip(panels, piece.rows(frame), strict=True):
            panel.set_data(draw(camera, joints, errors, piece.floor))
        for label, text in means.items():
            text.set_text(f"{piece.errors[label][frame].mean():.1f} cm")
        time.set_text(f"{piece.seconds(frame):.2f} s")
        yield sheet.pixels()


def encode_gif(pictures: Iterable[np.ndarray]) -> bytes:
    """Encode pictures as a GIF that repeats endlessly.

    All pictures have one palette, so that the film does not flicker: the heat map and the truth in light and
    shadow, and greys.
    """
    from PIL import Image

    hues = ((heat_colours(np.linspace(0, 1, 28)), 7), (np.array([NEUTRAL]), 36), (np.ones((1, 3)), 24))
    shades = [(np.linspace(0.3, 1, count)[:, None, None] * colours).reshape(-1, 3) for colours, count in hues]
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
