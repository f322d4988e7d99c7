"""Figures and films: their sizes, counts and colours, and that an interrupted one leaves no file."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny
from PIL import Image

from memmlp.common.errors import InputError
from memmlp.evaluation.modes import joint_positions
from memmlp.motion.body import SPARSE_DIM
from memmlp.report.pictures import clip_pictures
from memmlp.report.pictures.clip_pictures import check_picture, draw_poses, write_picture
from memmlp.report.pictures.clip_piece import ClipPiece

TRUTH = joint_positions(tiny.clip(31)[:, SPARSE_DIM:]).numpy().astype(np.float64)
OFF = np.array([0.0, 0.0, 0.08])
FIGURE_STEP = clip_pictures.POSE_HEIGHT + clip_pictures.CAPTION


@pytest.fixture
def piece() -> ClipPiece:
    """Make a piece of half a second, with a good and a bad prediction."""
    return ClipPiece("clips/one", TRUTH, {"good": TRUTH + OFF / 8, "bad": TRUTH + OFF}, start=60)


@pytest.fixture
def short() -> ClipPiece:
    """Make a piece of a tenth of a second, for films."""
    return ClipPiece("clips/one", TRUTH[:7], {"good": TRUTH[:7] + OFF / 8, "bad": TRUTH[:7] + OFF}, start=60)


def colour(picture: np.ndarray) -> np.ndarray:
    """Return the mean colour (3,) of all pixels that are not white or grey."""
    vivid = picture.max(-1).astype(int) - picture.min(-1) > 60
    return picture[vivid].mean(0)


def test_a_figure_has_a_row_for_the_truth_and_each_prediction(piece: ClipPiece):
    picture = draw_poses(piece, poses=2)
    width = clip_pictures.LEFT + 2 * clip_pictures.POSE_WIDTH + clip_pictures.COLOUR_BAR
    assert picture.shape == (clip_pictures.HEAD + 3 * FIGURE_STEP + 8, width, 3)
    rows = [
        picture[clip_pictures.HEAD + row * FIGURE_STEP :][
            : clip_pictures.POSE_HEIGHT, clip_pictures.LEFT : -clip_pictures.COLOUR_BAR
        ]
        for row in range(3)
    ]
    vivid = [(row.max(-1).astype(int) - row.min(-1) > 60).mean() for row in rows]
    assert vivid[0] < 0.001 < vivid[1]
    assert colour(rows[1]).argmax() == 2
    assert colour(rows[2])[0] > 2 * colour(rows[1])[0]


@pytest.mark.slow
def test_gif(tmp_path: Path, short: ClipPiece):
    write_picture(tmp_path / "a.gif", short)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 4
        assert image.size == (1132, 612)
        durations = []
        for frame in range(3):
            image.seek(frame)
            durations.append(image.info["duration"])
        assert sum(durations) == 100  # in hundredths of a second
        assert np.asarray(image.convert("RGB"))[5, 5].tolist() == [255, 255, 255]


@pytest.mark.slow
def test_mp4(tmp_path: Path, short: ClipPiece):
    av = pytest.importorskip("av")
    write_picture(tmp_path / "a.mp4", short)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.average_rate == 30
        assert stream.codec_context.name == "h264"
    assert len(frames) == 4
    assert frames[0].shape == (612, 1132, 3)
    right = frames[3][clip_pictures.TOP : -clip_pictures.BOTTOM, 680:1020]
    assert colour(right)[0] > 80


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_nothing_is_left_of_a_film_that_was_interrupted(tmp_path, piece, monkeypatch, name: str):
    if name.endswith("mp4"):
        pytest.importorskip("av")

    def interrupted(piece: ClipPiece):
        yield from itertools.islice(whole(piece), 2)
        raise KeyboardInterrupt

    whole = clip_pictures.draw_film
    monkeypatch.setattr(clip_pictures, "draw_film", interrupted)
    (tmp_path / name).write_text("the last one")
    with pytest.raises(KeyboardInterrupt):
        write_picture(tmp_path / name, piece)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "the last one"


def test_without_pyav_a_line_says_what_to_install(tmp_path, piece, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    for write in (lambda path: check_picture(path), lambda path: write_picture(path, piece)):
        with pytest.raises(InputError, match=r"memmlp\[video\]"):
            write(tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []
