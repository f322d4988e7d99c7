"""Figures and films: rows, colours, frames, and that an interrupted one leaves no file."""

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny
from PIL import Image

from memmlp.common.errors import InputError
from memmlp.evaluation.modes import extract_positions
from memmlp.motion.body import SPARSE_DIM
from memmlp.report.pictures import clip_pictures
from memmlp.report.pictures.clip_pictures import ClipPiece, check_picture_path, write_picture

TRUTH = extract_positions(tiny.clip(31)[:, SPARSE_DIM:]).numpy().astype(np.float64)
OFF = np.array([0.0, 0.0, 0.08])


def make_piece(frames: int = 31) -> ClipPiece:
    """Make a piece with a good and a bad prediction."""
    truth = TRUTH[:frames]
    return ClipPiece("clips/one", truth, {"good": truth + OFF / 8, "bad": truth + OFF}, start=60)


def colour(picture: np.ndarray) -> np.ndarray:
    """Return the mean colour (3,) of all pixels that are not white or grey."""
    vivid = picture.max(-1).astype(int) - picture.min(-1) > 60
    return picture[vivid].mean(0)


def test_a_figure_has_a_row_for_the_truth_and_each_prediction(tmp_path: Path):
    write_picture(tmp_path / "a.png", make_piece(), poses=2)
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    height, width = picture.shape[:2]
    assert width > 500
    rows = [picture[60 + i * (height - 60) // 3 :][: height // 4, : width - 150] for i in range(3)]
    vivid = [(row.max(-1).astype(int) - row.min(-1) > 60).mean() for row in rows]
    assert vivid[0] < 0.001 < vivid[1]
    assert colour(rows[1]).argmax() == 2
    assert colour(rows[2])[0] > 2 * colour(rows[1])[0]


@pytest.mark.slow
def test_films_have_thirty_pictures_a_second(tmp_path: Path):
    short = make_piece(7)
    write_picture(tmp_path / "a.gif", short)
    with Image.open(tmp_path / "a.gif") as image:
        durations = []
        for frame in range(image.n_frames):
            image.seek(frame)
            durations.append(image.info["duration"])
        assert (durations[:3], len(durations)) == ([30, 30, 40], 4)
        assert np.asarray(image.convert("RGB"))[90, 5].tolist() == [255, 255, 255]
    av = pytest.importorskip("av")
    write_picture(tmp_path / "a.mp4", short)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert (stream.average_rate, stream.codec_context.name, len(frames)) == (30, "h264", 4)
    width = frames[0].shape[1]
    good, bad = (colour(frames[3][80:, left : left + width // 4]) for left in (width // 3, 3 * width // 5))
    assert bad[0] > good[0]


@pytest.mark.slow
def test_an_interrupted_film_leaves_the_last_one(tmp_path, monkeypatch):
    name, whole = "a.gif", clip_pictures.draw_film

    def interrupted(piece: ClipPiece):
        yield from itertools.islice(whole(piece), 2)
        raise KeyboardInterrupt

    monkeypatch.setattr(clip_pictures, "draw_film", interrupted)
    (tmp_path / name).write_text("the last one")
    with pytest.raises(KeyboardInterrupt):
        write_picture(tmp_path / name, make_piece(7))
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "the last one")]


def test_bad_files_are_rejected(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    for write in (lambda path: check_picture_path(path), lambda path: write_picture(path, make_piece(7))):
        with pytest.raises(InputError, match=r"memmlp\[video\]"):
            write(tmp_path / "a.mp4")
    with pytest.raises(InputError, match=r"a\.pdf: must end in .*\.png"):
        check_picture_path(tmp_path / "a.pdf")
    with pytest.raises(InputError, match="there is no folder"):
        check_picture_path(tmp_path / "none" / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_the_camera_follows_the_person():
    moving = ClipPiece("walk", TRUTH + np.linspace(0, 4, 31)[:, None, None] * [1, 0, 0], {"a": TRUTH})
    apart = moving.smooth_camera_path() - moving.truth[:, 0, :2]
    assert np.abs(apart[10:21]).max() < 0.8
    assert np.ptp(moving.smooth_camera_path()[:, 0]) > 1.5
