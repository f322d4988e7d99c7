"""Exponential maps: the kinematics against the published recursion, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from memmlp.common.errors import InputError
from memmlp.motion.formats import expmap
from memmlp.motion.formats.expmap import NODES, OFFSETS, PARENTS, WIDTH, read_expmap


def text(values: np.ndarray) -> str:
    return "".join(",".join(f"{number:.9g}" for number in row) + "\n" for row in values)


def motion(frames: int = 3, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (frames, WIDTH))


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "walking_1.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def published(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint by joint with row vectors, whose matrices are the transposes of those on columns."""
    places: list[np.ndarray] = []
    turns: list[np.ndarray] = []
    for node, parent in enumerate(PARENTS):
        x, y, z = row[3 + 3 * node : 6 + 3 * node]
        turn = expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        places.append(row[:3] if parent < 0 else OFFSETS[node] @ turns[parent] + places[parent])
        turns.append(turn if parent < 0 else turn @ turns[parent])
    return np.stack(turns).swapaxes(-1, -2), np.stack(places)


def test_kinematics_are_those_of_the_published_code(tmp_path):
    file = read_expmap(write(tmp_path, text(motion())))
    assert (len(file), file.fps, len(file.nodes)) == (3, 120.0, 38)
    rotations, positions = file.kinematics()
    for frame in range(3):
        turns, places = published(file.values[frame])
        np.testing.assert_allclose(rotations[frame], turns, atol=1e-9)
        np.testing.assert_allclose(positions[frame], places, atol=1e-9)


def test_the_zero_pose_stands_and_a_pose_is_told_as_the_file_does(tmp_path):
    values = np.zeros((1, WIDTH))
    values[0, 3 + 3 * NODES.index("LeftLeg") :][:3] = [0.7, 0.1, -0.2]
    file = read_expmap(write(tmp_path, text(values)))
    zero = dict(zip(NODES, file.zero_pose(), strict=True))
    assert zero["Head"][1] > 0 > zero["LeftLeg"][1] > zero["LeftFoot"][1]
    assert zero["LeftHand"][0] > 0 > zero["RightHand"][0]
    rotations, positions = file.pose({"LeftLeg": [0.7, 0.1, -0.2]})
    np.testing.assert_allclose(rotations, file.kinematics()[0][0])
    np.testing.assert_allclose(positions, file.kinematics()[1][0])
    with pytest.raises(InputError, match=r"rest\.Tail"):
        file.pose({"Tail": [0, 0, 0]})


def test_line_ends_and_blank_lines_do_not_count(tmp_path):
    plain = text(motion())
    expected = read_expmap(write(tmp_path, plain)).values
    for other in (
        plain.replace("\n", "\r\n"),
        plain.replace("\n", "\r"),
        plain.replace("\n", "\n\n").strip(),
    ):
        np.testing.assert_array_equal(read_expmap(write(tmp_path, other)).values, expected)


@pytest.mark.parametrize(
    ("content", "match"),
    [("", "no frames"), ("\n\n", "no frames"), (text(np.zeros((2, 99))), "line 1: 99 values"),
     (text(motion()) + "1,2\n", "line 4: 2 values"), (text(motion()).replace(",", " "), "line 1: 1 values"),
     (text(motion()).replace("\n", ",\n"), "line 1: 118 values"), ("1_0" + ",0" * 116, "line 1"),
     ("nan" + ",0" * 116, "line 1"), ("1e5" + ",0" * 116, "line 1"), (b"\x00\xff" * 9000, "line 1"),
     ("1," * 1_000_000, "line 1"), ("x" + ",0" * 116, "line 1")],
)  # fmt: skip
def test_anything_else_is_one_line_that_says_where(content, match, tmp_path):
    with pytest.raises(InputError, match=rf"walking_1\.txt: {match}") as caught:
        read_expmap(write(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_sizes_have_limits(tmp_path, monkeypatch):
    path = write(tmp_path, text(motion()))
    monkeypatch.setattr(expmap, "MAX_BYTES", 100)
    with pytest.raises(InputError, match="too large"):
        read_expmap(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_expmap(tmp_path / "none.txt")
