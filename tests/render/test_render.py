"""Figures and films: their sizes, counts and colours, and that a broken one leaves no file."""

from __future__ import annotations

import io
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
from memmlp.motion.limb_shapes import LIMBS, ends
from memmlp.render import film, heatmap
from memmlp.render.clip_piece import ClipPiece
from memmlp.render.error_colours import HEAT, heat, scale
from memmlp.render.raster import Camera, draw

TRUTH = joint_positions(tiny.clip(31)[:, SPARSE_DIM:]).numpy().astype(np.float64)
OFF = np.array([0.0, 0.0, 0.08])


@pytest.fixture
def piece() -> ClipPiece:
    """Make a piece of half a second, with a good and a bad prediction."""
    return ClipPiece("clips/one", TRUTH, {"good": TRUTH + OFF / 8, "bad": TRUTH + OFF}, start=60)


@pytest.fixture
def short() -> ClipPiece:
    """Make a piece of a tenth of a second, for films."""
    return ClipPiece("clips/one", TRUTH[:7], {"good": TRUTH[:7] + OFF / 8, "bad": TRUTH[:7] + OFF}, start=60)


@pytest.fixture
def camera(piece: ClipPiece) -> Camera:
    return piece.camera(piece.azimuth(0), TRUTH[0, 0, :2], 120, 180)


def colour(picture: np.ndarray) -> np.ndarray:
    """Return the mean colour (3,) of all pixels that are not white or grey."""
    vivid = picture.max(-1).astype(int) - picture.min(-1) > 60
    return picture[vivid].mean(0)


def test_errors_colour_the_body(camera: Camera):
    blue, red = (colour(draw(camera, TRUTH[0], np.full(22, part), 0.0)) for part in (0.0, 1.0))
    assert blue.argmax() == 2
    assert red.argmax() == 0


def test_one_joints_error_colours_its_limbs_alone(camera: Camera):
    errors = np.zeros(22)
    plain = draw(camera, TRUTH[0], errors, 0.0)
    errors[7] = 1.0  # the left ankle
    picture = draw(camera, TRUTH[0], errors, 0.0)
    changed = (picture != plain).any(-1)
    rows, columns = np.nonzero(changed)
    ankle = camera.project(TRUTH[0, 7]) * camera.scale
    assert 20 < changed.sum() < 0.1 * changed.size
    assert np.hypot(columns - 60 - ankle[0], 90 - rows - ankle[1]).max() < 0.55 * camera.scale
    x, y, _ = (camera.project(TRUTH[0, [7, 4]]) * camera.scale).T
    at_ankle, at_knee = picture[np.round(90 - y).astype(int), np.round(60 + x).astype(int)]
    assert at_ankle.argmax() == 0
    assert at_knee.argmax() == 2


def test_the_truth_has_no_colour(camera: Camera):
    picture = draw(camera, TRUTH[0], None, 0.0).astype(int)
    assert (picture.max(-1) - picture.min(-1)).max() < 40
    assert (picture < 150).any()


def test_the_nearer_body_part_is_seen(camera: Camera):
    """A hand before the chest is seen there in its own colour, a hand behind it is not."""
    seen = []
    for away in (0.35, -0.35):
        joints = TRUTH[0].copy()
        joints[20] = joints[9] + away * camera.axes[2]
        errors = np.zeros(22)
        errors[20] = 1.0
        x, y, _ = camera.project(joints[20]) * camera.scale
        seen.append(draw(camera, joints, errors, 0.0)[round(90 - y), round(60 + x)])
    assert seen[0].argmax() == 0
    assert seen[1].argmax() == 2


def test_heat_goes_through_its_colours():
    shown = (255 * heat(np.linspace(0, 1, len(HEAT)))).round().astype(int)
    assert ["#" + "".join(f"{value:02x}" for value in row) for row in shown] == list(HEAT)
    assert np.array_equal(heat(np.array([7.0])), heat(np.array([1.0])))


def test_the_scale_is_round_and_leaves_few_above():
    errors = np.random.default_rng(0).gamma(2, 4, 5000)
    assert scale(errors) == 25 or scale(errors) == 30
    assert (errors > scale(errors)).mean() <= 0.02
    assert scale(np.zeros(3)) == 10
    assert scale(np.full(3, 1e6)) == 100


def test_tips_go_on_from_their_joint():
    tips = [limb for limb in LIMBS if limb.tip]
    assert len(tips) == 3
    for limb in tips:
        start, end = ends(limb, TRUTH[0])
        assert np.array_equal(start, TRUTH[0, limb.end])
        assert np.linalg.norm(end - start) == pytest.approx(limb.tip)


def test_the_camera_goes_along(piece: ClipPiece):
    moving = ClipPiece("walk", TRUTH + np.linspace(0, 4, 31)[:, None, None] * [1, 0, 0], {"a": TRUTH})
    apart = moving.path() - moving.truth[:, 0, :2]
    assert np.abs(apart[10:21]).max() < 0.8
    assert np.ptp(moving.path()[:, 0]) > 1.5


def test_a_hand_above_the_head_is_in_the_picture():
    raised = TRUTH.copy()
    raised[:, 20] = raised[:, 15] + [0.1, 0.1, 0.6]  # the left wrist, and the head
    away = np.full_like(TRUTH, np.nan)  # of a network that diverged
    tall = ClipPiece("clips/one", raised, {"bad": away})
    for frame in (0, 30):
        camera = tall.camera(tall.azimuth(frame), raised[frame, 0, :2], 230, 330)
        edge = 330 / 2 / camera.scale
        assert np.abs(camera.project(raised[frame])[:, 1]).max() < edge
    picture = draw(camera, raised[30], None, tall.floor)
    assert (picture[0] == 255).all()
    assert ClipPiece("clips/one", TRUTH, {}).metres < tall.metres < 2.9


def test_png(tmp_path: Path, piece: ClipPiece):
    heatmap.heatmap_png(tmp_path / "a.png", piece, poses=2)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (
            heatmap.LEFT + 2 * heatmap.WIDTH + heatmap.RIGHT,
            heatmap.TOP + 3 * (heatmap.HEIGHT + heatmap.CAPTION) + 8,
        )
        pixels = np.asarray(image.convert("RGB"))
    step = heatmap.HEIGHT + heatmap.CAPTION
    rows = [
        pixels[heatmap.TOP + row * step :][: heatmap.HEIGHT, heatmap.LEFT : -heatmap.RIGHT]
        for row in range(3)
    ]
    vivid = [(row.max(-1).astype(int) - row.min(-1) > 60).mean() for row in rows]
    assert vivid[0] < 0.001 < vivid[1]
    assert colour(rows[1]).argmax() == 2
    assert colour(rows[2])[0] > 2 * colour(rows[1])[0]


@pytest.mark.slow
def test_gif(tmp_path: Path, short: ClipPiece):
    film.film(tmp_path / "a.gif", short)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 4
        assert image.size == (3 * film.WIDTH + film.RIGHT, film.TOP + film.HEIGHT + film.BOTTOM)
        durations = []
        for frame in range(3):
            image.seek(frame)
            durations.append(image.info["duration"])
        assert sum(durations) == 100  # in hundredths of a second
        assert np.asarray(image.convert("RGB"))[5, 5].tolist() == [255, 255, 255]


@pytest.mark.slow
def test_mp4(tmp_path: Path, short: ClipPiece):
    av = pytest.importorskip("av")
    film.film(tmp_path / "a.mp4", short)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.average_rate == 30
        assert stream.codec_context.name == "h264"
    assert len(frames) == 4
    assert frames[0].shape == (612, 1132, 3)
    right = frames[3][film.TOP : -film.BOTTOM, 2 * film.WIDTH : 3 * film.WIDTH]
    assert colour(right)[0] > 80


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_nothing_is_left_of_a_film_that_was_broken_off(tmp_path, piece, monkeypatch, name: str):
    if name.endswith("mp4"):
        pytest.importorskip("av")

    def interrupted(piece: ClipPiece):
        yield from itertools.islice(whole(piece), 2)
        raise KeyboardInterrupt

    whole = film.pictures
    monkeypatch.setattr(film, "pictures", interrupted)
    (tmp_path / name).write_text("the last one")
    with pytest.raises(KeyboardInterrupt):
        film.film(tmp_path / name, piece)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "the last one"


def test_without_pyav_a_line_says_what_to_install(tmp_path, piece, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install 'memmlp\[video\]'"):
        film.film(tmp_path / "a.mp4", piece)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_demos_picture(tmp_path: Path):
    heatmap.poses_png(tmp_path / "poses.png", TRUTH, TRUTH + OFF, "one")
    assert Image.open(io.BytesIO((tmp_path / "poses.png").read_bytes())).size[0] > 1200
