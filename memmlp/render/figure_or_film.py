"""Writes a piece of a clip as a file: a figure or a film, depending on the name's suffix."""

from __future__ import annotations

from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.render.clip_piece import ClipPiece
from memmlp.render.film import film, pyav
from memmlp.render.heatmap import POSES, heatmap_png

SUFFIXES = (".png", ".gif", ".mp4")


def check_picture(path: Path, key: str = "path", suffixes: tuple[str, ...] = SUFFIXES) -> None:
    """Raise InputError for an invalid picture file, before any work is done.

    Args:
        path: the file to write.
        key: the option or argument that gave the path.
        suffixes: suffixes of the kinds of picture that can be made.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{key} {path}: no such kind of picture; allowed are {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise InputError(f"{key} {path}: there is no folder {path.parent}")
    if path.suffix.lower() == ".mp4":
        pyav()


def write_picture(path: Path, piece: ClipPiece, poses: int = POSES, key: str = "path") -> None:
    """Write a PNG of `poses` poses in a row, or a GIF or MP4 of all frames, completely or not at all.

    Raises InputError if the file can't be written.
    """
    try:
        if path.suffix.lower() == ".png":
            heatmap_png(path, piece, poses)
        else:
            film(path, piece)
    except OSError as error:
        raise InputError(f"{key} {path}: {error.strerror or error}") from None
