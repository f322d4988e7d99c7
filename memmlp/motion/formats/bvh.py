"""Reads and writes BVH files, and computes the joints' global rotations and positions.

A joint's rotation is the product of its rotation channels in the file's order (degrees; Z X Y means Rz Rx Ry
on column vectors). Position channels replace the numbers in OFFSET.

Written files have 22 joints with end sites, centimetres, Y up, and the body's T-pose as zero pose.
"""

import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import NoReturn

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_file
from memmlp.motion.body import CHILDREN, JOINTS, PARENTS
from memmlp.motion.clip import FRAME_RATE_RANGE, USUAL_RATES, Clip, convert_to_y_up
from memmlp.motion.formats.recording import END, LIMIT, Recording, fail, open_text

AXES = "XYZ"
CHANNELS = tuple(axis + kind for kind in ("position", "rotation") for axis in AXES)
WORD = re.compile(r"(?<![^\s{}])(ROOT|JOINT)\s+([^{}]*[^{}\s])|([{}]|[^\s{}]+)", re.IGNORECASE)
"""A word of the hierarchy, or a keyword with a name; names may contain blanks."""
MAX_JOINTS = 1000
RATE_DIGITS = 1e-4  # relative: 1 / 0.00833333 s is 120 Hz, because the header has few digits
COARSEST = 0.05  # relative: a more coarsely rounded frame time does not identify a usual rate

CENTIMETRES = 100.0  # per metre
NUMBER = "%.6f"  # 1e-8 m and 1e-6 degrees: more precise than a clip's float32
TIPS = {
    "left_foot": (0.0, 0.0, 0.06), "right_foot": (0.0, 0.0, 0.06), "head": (0.0, 0.18, 0.0),
    "left_wrist": (0.17, 0.0, 0.0), "right_wrist": (-0.17, 0.0, 0.0),
}  # fmt: skip
"""Vectors from the last joints to the tips of toes, head and fingers, metres, body frame."""


@dataclass(frozen=True)
class Bvh(Recording):
    """A BVH file. Its nodes are the joints, followed by the end sites. `channels` are those of each joint, in
    the file's order, without end sites."""

    channels: tuple[tuple[str, ...], ...]

    def compute_kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        rotations = np.empty((len(self.nodes), len(self), 3, 3))
        positions = np.empty((len(self.nodes), len(self), 3))
        first = 0
        for joint, channels in enumerate(self.channels):
            parent, values = self.node_parents[joint], self.values[:, first : first + len(channels)]
            first += len(channels)
            shift = np.tile(self.offsets[joint], (len(self), 1))
            for name, column in zip(channels, values.T, strict=True):
                if name.endswith("position"):
                    shift[:, AXES.index(name[0])] = column
            above = rotations[parent] if joint else np.eye(3)
            positions[joint] = np.einsum("...ij,...j->...i", above, shift)
            positions[joint] += positions[parent] if joint else 0.0
            rotations[joint] = above
            for name, angles in zip(channels, np.radians(values).T, strict=True):
                if name.endswith("rotation"):
                    _rotate(rotations[joint], AXES.index(name[0]), angles)
        for node in range(len(self.channels), len(self.nodes)):
            parent = self.node_parents[node]
            rotations[node] = rotations[parent]
            positions[node] = positions[parent] + rotations[parent] @ self.offsets[node]
        return rotations.swapaxes(0, 1), positions.swapaxes(0, 1)

    def list_rest_values(self) -> list[list[float | None]]:
        shifts = [np.zeros(3), *self.offsets[1 : len(self.channels)]]
        return [
            [None if name.endswith("rotation") else shift[AXES.index(name[0])] for name in channels]
            for channels, shift in zip(self.channels, shifts, strict=True)
        ]


def _rotate(rotations: np.ndarray, axis: int, angles: np.ndarray) -> None:
    """Multiply rotations (N, 3, 3) on the right by rotations about an axis (N,), radians, in place."""
    second, third = (axis + 1) % 3, (axis + 2) % 3
    sine, cosine = np.sin(angles)[:, None], np.cos(angles)[:, None]
    a, b = rotations[:, :, second].copy(), rotations[:, :, third].copy()
    rotations[:, :, second] = cosine * a + sine * b
    rotations[:, :, third] = cosine * b - sine * a


# Reading


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file. Line ends, blanks and the letter case of keywords may vary. Raises InputError if the
    file is damaged (braces, numbers, counts, names, channels, frame time, encoding), has more than 1000
    joints, or is larger than 256 MiB. The message has the file and if possible the line."""
    try:
        with open_text(path, "utf-8-sig") as file:
            lines = enumerate(file, start=1)
            names, parents, offsets, channels = _read_hierarchy(_WordReader(path, lines))
            fps, values = _read_motion(path, lines, sum(map(len, channels)))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: invalid byte {error.object[error.start]:#04x}; must be UTF-8") from error
    return Bvh(path, tuple(names), tuple(parents), np.array(offsets), fps, values, tuple(channels))


class _WordReader:
    """Reads the hierarchy word by word. `line` is the line number of the last word."""

    def __init__(self, path: Path, lines: Iterator[tuple[int, str]]) -> None:
        self.path, self.line = path, 1
        self._words = self._split(lines)

    def _split(self, lines: Iterator[tuple[int, str]]) -> Iterator[str]:
        for self.line, line in lines:
            if line.strip().upper() == "MOTION":
                return
            for match in WORD.finditer(line):
                yield from filter(None, match.groups())
        raise InputError(f"{self.path}: has no MOTION line; expected HIERARCHY, then MOTION")

    def fail(self, wrong: str, expected: str) -> NoReturn:
        fail(self.path, self.line, wrong, expected)

    def read_next(self) -> str | None:
        return next(self._words, None)

    def read_word(self, expected: str) -> str:
        return self.read_next() or self.fail("the hierarchy ends too early", expected)

    def read_keyword(self, *keywords: str) -> str:
        """Read one of the keywords, and return it in capitals."""
        word = self.read_word(" or ".join(keywords))
        return word.upper() if word.upper() in keywords else self.fail(_quote(word), " or ".join(keywords))

    def read_offset(self) -> list[float]:
        self.read_keyword("OFFSET")
        expected = f"three numbers of at most {LIMIT:g} in absolute value after OFFSET"
        words = [self.read_word(expected) for _ in range(3)]
        wrong = [word for word in words if not abs(_parse_number(word)) <= LIMIT]
        return list(map(_parse_number, words)) if not wrong else self.fail(_quote(wrong[0]), expected)

    def read_channels(self) -> tuple[str, ...]:
        self.read_keyword("CHANNELS")
        expected = f"a count from 0 to {len(CHANNELS)} and that many of {', '.join(CHANNELS)} after CHANNELS"
        count = self.read_word(expected)
        if count not in map(str, range(len(CHANNELS) + 1)):
            self.fail(_quote(count), expected)
        names = tuple(self.read_word(expected).capitalize() for _ in range(int(count)))
        wrong = next((name for name in names if name not in CHANNELS or names.count(name) > 1), None)
        return names if wrong is None else self.fail(_quote(wrong), expected)


def _read_hierarchy(
    words: _WordReader,
) -> tuple[list[str], list[int], list[list[float]], list[tuple[str, ...]]]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[tuple[str, ...]] = []
    ends: dict[str, tuple[int, list[float]]] = {}
    open_joints: list[int] = []  # joints before their closing }

    def check(name: str) -> str:
        if name in ("{", "}") or name in names or name in ends:
            words.fail(f"name {_quote(name)}", "a unique name, and at most one end site per joint")
        return name

    words.read_keyword("HIERARCHY")
    keyword = words.read_keyword("ROOT")
    while keyword != "}" or len(open_joints) > 1:
        if keyword == "}":
            open_joints.pop()
        elif keyword == "END":
            name = check(names[open_joints[-1]] + END)
            words.read_keyword("SITE")
            words.read_keyword("{")
            ends[name] = open_joints[-1], words.read_offset()
            words.read_keyword("}")
        else:
            if len(names) == MAX_JOINTS:
                words.fail("too many joints", f"at most {MAX_JOINTS} joints")
            names.append(check(words.read_word("a joint's name")))
            parents.append(open_joints[-1] if open_joints else -1)
            open_joints.append(len(names) - 1)
            words.read_keyword("{")
            offsets.append(words.read_offset())
            channels.append(words.read_channels())
        keyword = words.read_keyword("JOINT", "END", "}")
    if (word := words.read_next()) is not None:
        words.fail(_quote(word), "MOTION after the root's closing }")
    parents += [joint for joint, _ in ends.values()]
    offsets += [offset for _, offset in ends.values()]
    return [*names, *ends], parents, offsets, channels


def _read_motion(path: Path, lines: Iterator[tuple[int, str]], width: int) -> tuple[float, np.ndarray]:
    """Read frame rate and values (N, width) from the lines after MOTION. Blank lines are ignored."""
    rows = ((number, line.strip()) for number, line in lines if line.strip())
    first, second = next(rows, None), next(rows, None)
    if first is None or second is None or width == 0:
        expected = "channels, Frames:, Frame Time: and the values of all frames"
        raise InputError(f"{path}: has no motion; expected {expected}")
    frames = _read_header(path, *first, "Frames:")
    if not re.fullmatch(r"0*[1-9]\d{0,8}", frames, re.ASCII):
        fail(path, first[0], f"Frames: {_quote(frames)}", "a whole number of at least 1")
    low, high = FRAME_RATE_RANGE
    frame_time = _read_header(path, *second, "Frame Time:")
    if not 1 / high <= _parse_number(frame_time) <= 1 / low:
        fail(path, second[0], f"Frame Time: {_quote(frame_time)}", f"{1 / high:g} to {1 / low:g} s")
    values = array("d")  # a list of rows would need much more memory
    for number, line in rows:
        values.extend(_read_frame(path, number, line.split(), width))
    if len(values) != int(frames) * width:
        wrong = f"Frames: {int(frames)}, but {len(values) // width} lines of values follow"
        fail(path, first[0], wrong, "one line per frame")
    return _parse_rate(frame_time), np.array(values).reshape(-1, width)


def _parse_rate(frame_time: str) -> float:
    """Convert a frame time to a rate, Hz. If the rate is nearly a whole number, it is rounded. A frame time
    with few digits gives the matching usual rate: both 0.0167 (rounded) and 0.0166 (cut off) are 60 Hz."""
    seconds = _parse_number(frame_time)
    if abs(1 / seconds - round(1 / seconds)) <= RATE_DIGITS / seconds:
        return float(round(1 / seconds))
    digit = 10.0 ** int(Decimal(frame_time).as_tuple().exponent)
    usual = min(USUAL_RATES, key=lambda usual: abs(1 / usual - seconds))
    lacking, coarsest = 1 / usual - seconds, COARSEST * seconds
    rounded = abs(lacking) <= 0.5 * digit <= coarsest
    cut_off = 0 < lacking < digit <= coarsest
    return float(usual) if rounded or cut_off else 1 / seconds


def _read_header(path: Path, number: int, line: str, key: str) -> str:
    """Return the value in a line `key: value`. Letter case and blanks may vary."""
    pattern = key.replace(" ", r"\s*").replace(":", r"\s*:\s*(\S+)")
    match = re.fullmatch(pattern, line, re.IGNORECASE)
    return match[1] if match else fail(path, number, _quote(line), f"{key} and one number")


def _read_frame(path: Path, number: int, words: list[str], width: int) -> list[float]:
    if len(words) != width:
        fail(path, number, f"{len(words)} values", f"{width}, one per channel")
    try:
        values = list(map(float, words))
    except ValueError:
        values = [float("nan")]
    if not all(abs(value) <= LIMIT for value in values) or any("_" in word for word in words):
        wrong = next((word for word in words if not abs(_parse_number(word)) <= LIMIT), words[0])
        fail(path, number, _quote(wrong), f"numbers of at most {LIMIT:g} in absolute value")
    return values


def _parse_number(word: str) -> float:
    """Parse a decimal number; invalid text, such as `1_0` or `Infinity`, gives NaN."""
    try:
        return float(word) if re.fullmatch(r"[-+.0-9eE]+", word) else float("nan")
    except ValueError:
        return float("nan")


def _quote(word: str) -> str:
    return repr(word)[:40]


# Writing


def write_bvh(path: Path, clip: Clip, rest: np.ndarray) -> None:
    """Write a clip on a body with rest joints `rest` (22, 3), metres, atomically. `memmlp data import`
    recognises the joints as skeleton `smpl_words`. The skeleton `memmlp` also has unit and axes, for clips
    without a standing person."""
    with atomic_file(path) as file:
        for line in ("HIERARCHY", *_format_joint(0, rest, ""), *_format_motion(clip, rest)):
            file.write(f"{line}\n".encode())


def _format_joint(joint: int, rest: np.ndarray, indent: str) -> Iterator[str]:
    """Yield the lines of a joint and of all joints below it. The root's offset is zero, because only some
    programs add it to the position channels."""
    offset = rest[joint] - rest[max(PARENTS[joint], 0)]
    position = "" if joint else "Xposition Yposition Zposition "
    yield f"{indent}{'JOINT' if joint else 'ROOT'} {JOINTS[joint]}"
    yield f"{indent}{{"
    yield f"{indent}\tOFFSET {_format_centimetres(offset)}"
    yield f"{indent}\tCHANNELS {3 if joint else 6} {position}Zrotation Xrotation Yrotation"
    for child in CHILDREN[joint]:
        yield from _format_joint(child, rest, indent + "\t")
    if JOINTS[joint] in TIPS:
        tip = _format_centimetres(np.array(TIPS[JOINTS[joint]]))
        yield from (f"{indent}\t{line}" for line in ("End Site", "{", f"\tOFFSET {tip}", "}"))
    yield f"{indent}}}"


def _format_centimetres(metres: np.ndarray) -> str:
    return " ".join(NUMBER % value for value in CENTIMETRES * metres)


def _format_motion(clip: Clip, rest: np.ndarray) -> Iterator[str]:
    yield from ("MOTION", f"Frames: {len(clip)}", f"Frame Time: {1 / clip.fps:.12f}")

    def list_subtree(joint: int) -> Iterator[int]:  # in the hierarchy's order
        yield joint
        for child in CHILDREN[joint]:
            yield from list_subtree(child)

    order, previous_angles = list(list_subtree(0)), None
    for piece in clip.split_into_pieces():
        rotations, root = convert_to_y_up(piece, rest)
        angles = compute_euler_zxy(rotations, previous_angles)
        previous_angles = angles[-1]
        values = np.concatenate([CENTIMETRES * root, angles[:, order].reshape(len(piece), -1)], 1)
        form = " ".join([NUMBER] * values.shape[1])
        yield from (form % tuple(row) for row in values.tolist())


def compute_euler_zxy(rotations: np.ndarray, previous_angles: np.ndarray | None = None) -> np.ndarray:
    """Return angles (N, ..., 3), degrees, with Rz Rx Ry = rotations (N, ..., 3, 3), valid also in gimbal
    lock. A rotation has two triples of angles, apart from full turns. Each frame gets the one nearest to the
    previous frame (..., 3), so that programs can interpolate between frames."""
    z = np.arctan2(-rotations[..., 0, 1], rotations[..., 1, 1])
    cosine, sine = np.cos(z)[..., None], np.sin(z)[..., None]
    first = cosine * rotations[..., 0, :] + sine * rotations[..., 1, :]  # rows of Rz^T R = Rx Ry
    second = cosine * rotations[..., 1, :] - sine * rotations[..., 0, :]
    x = np.arctan2(rotations[..., 2, 1], second[..., 1])
    y = np.arctan2(first[..., 2], first[..., 0])
    angles = np.stack([z, x, y], -1)
    if previous_angles is None:
        return np.degrees(_make_continuous(angles))
    return np.degrees(_make_continuous(np.concatenate([np.radians(previous_angles)[None], angles]))[1:])


def _make_continuous(angles: np.ndarray) -> np.ndarray:
    """Return equivalent angles Z X Y (N, ..., 3), radians, without jumps between frames."""

    def remove_full_turns(angles: np.ndarray) -> np.ndarray:
        return np.remainder(angles + np.pi, 2 * np.pi) - np.pi

    others = np.array([np.pi, np.pi, np.pi]) + np.array([1, -1, 1]) * angles  # equivalent angles
    steps = remove_full_turns(angles[1:] - angles[:-1])
    changed = remove_full_turns(others[1:] - angles[:-1])
    changes = np.abs(changed).sum(-1) < np.abs(steps).sum(-1)
    second = np.zeros(angles.shape[:-1], bool)
    second[1:] = np.cumsum(changes, axis=0) % 2  # the second change selects the first triple again
    return np.unwrap(np.where(second[..., None], others, angles), axis=0)
