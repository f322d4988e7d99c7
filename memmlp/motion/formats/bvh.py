"""Reads BVH files, and computes their joints' global rotations and positions by forward kinematics.

Everything here is in the file's own units and axes. A joint's rotation is the product of its rotation
channels in the file's order (Z X Y means Rz Rx Ry, on column vectors, degrees in the file); its position
channels, if it has any, replace the numbers of its OFFSET.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path
from typing import NoReturn

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.clip import FRAME_RATE_RANGE
from memmlp.motion.frame_rates import USUAL_RATES

AXES = "XYZ"
CHANNELS = tuple(axis + kind for kind in ("position", "rotation") for axis in AXES)
END = ".end"  # an end site's name is that of its joint with this suffix
LIMIT = 1e6  # the largest size of any number in the file, in its units or degrees
MAX_JOINTS = 1000
MAX_BYTES = 2**29
MAX_HEAD = 2**22  # bytes before MOTION
MAX_LINE = 200_000  # bytes
MAX_VALUES = 2**24  # in all frames: 25 minutes of 93 channels at 120 Hz
RATE_DIGITS = 1e-4  # relative: 1 / 0.00833333 s is 120 Hz, as the header has no more digits
COARSEST = 0.05  # relative rounding of a frame time that still means one of them: two digits


@dataclass(frozen=True)
class EndSite:
    """The tip of a chain of joints.

    Attributes:
        name: `<joint>.end`.
        parent: index of the joint to which the end site belongs.
        offset: offset (3,) from that joint.
    """

    name: str
    parent: int
    offset: np.ndarray


@dataclass(frozen=True)
class Bvh:
    """A BVH file. Its nodes are its J joints, each after its parent, and then its E end sites.

    Attributes:
        path: the file's path, for messages.
        names: the J joints' names, all different.
        parents: index of each joint's parent; the root's is -1.
        offsets: joint minus parent in the zero pose (J, 3).
        channels: each joint's channels in the file's order, of `CHANNELS`.
        ends: the E end sites.
        frame_time: seconds between frames.
        values: channel values (N, C), degrees and the file's unit.
        rounding: half a unit of the last digit of the frame time in the header, seconds.
    """

    path: Path
    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    channels: tuple[tuple[str, ...], ...]
    ends: tuple[EndSite, ...]
    frame_time: float
    values: np.ndarray
    rounding: float = 0.0

    def __len__(self) -> int:
        return len(self.values)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the J joints and E end sites."""
        return self.names + tuple(end.name for end in self.ends)

    @property
    def node_parents(self) -> tuple[int, ...]:
        """Parents' indices of the J joints and E end sites."""
        return self.parents + tuple(end.parent for end in self.ends)

    @property
    def fps(self) -> float:
        """Frames per second, rounded to a whole number or a usual rate where the header's digits allow it.

        The header's time may be rounded to its last digit, or cut off after it: 0.0167 and 0.0166 are 60 Hz.
        """
        rate, coarsest = 1 / self.frame_time, COARSEST * self.frame_time
        if abs(rate - round(rate)) <= RATE_DIGITS * rate:
            return float(round(rate))
        usual = min(USUAL_RATES, key=lambda usual: abs(1 / usual - self.frame_time))
        lacking, digit = 1 / usual - self.frame_time, 2 * self.rounding
        rounded = abs(lacking) <= self.rounding <= coarsest
        cut_off = 0 < lacking < digit <= coarsest
        return float(usual) if rounded or cut_off else rate

    def zero_pose(self) -> np.ndarray:
        """Return positions (J+E, 3) of the nodes with all rotations zero and the root at the origin."""
        offsets = np.concatenate([self.offsets, *(end.offset[None] for end in self.ends)])
        positions = np.zeros_like(offsets)
        for node, parent in enumerate(self.node_parents[1:], start=1):
            positions[node] = positions[parent] + offsets[node]
        return positions

    def kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes' global rotations (N, J+E, 3, 3) and positions (N, J+E, 3).

        An end site has its joint's rotation.
        """
        rotations = np.empty((len(self.nodes), len(self), 3, 3))
        positions = np.empty((len(self.nodes), len(self), 3))
        for joint, parent in enumerate(self.parents):
            above = rotations[parent] if joint else np.eye(3)
            values = self._joint_values(joint)
            positions[joint] = np.einsum("...ij,...j->...i", above, self._shift(joint, values))
            positions[joint] += positions[parent] if joint else 0.0
            rotations[joint] = above
            for name, angles in zip(self.channels[joint], np.radians(values).T, strict=True):
                if name.endswith("rotation"):
                    _turn(rotations[joint], AXES.index(name[0]), angles)
        for node, end in enumerate(self.ends, start=len(self.names)):
            rotations[node] = rotations[end.parent]
            positions[node] = positions[end.parent] + rotations[end.parent] @ end.offset
        return rotations.swapaxes(0, 1), positions.swapaxes(0, 1)

    def posed(self, angles: Mapping[str, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes' global rotations (J+E, 3, 3) and positions (J+E, 3) in a pose.

        Args:
            angles: joint -> the values of its rotation channels, degrees, in the file's order; other joints
                have zeros, and so do the root's position channels.

        Raises:
            InputError: if there is no such joint, or it has another number of channels.
        """
        values = []
        for joint, name in enumerate(self.names):
            turns = [channel for channel in self.channels[joint] if channel.endswith("rotation")]
            told = iter(angles.get(name, [0.0] * len(turns)))
            if len(angles.get(name, turns)) != len(turns):
                wrong = f"{len(angles[name])} rotations for {name}"
                raise InputError(
                    f"{self.path}: {wrong}; allowed: {len(turns)}, one for each rotation channel"
                )
            for channel in self.channels[joint]:
                shift = 0.0 if joint == 0 else self.offsets[joint][AXES.index(channel[0])]
                values.append(next(told) if channel.endswith("rotation") else shift)
        rotations, positions = replace(self, values=np.array([values])).kinematics()
        return rotations[0], positions[0]

    def _joint_values(self, joint: int) -> np.ndarray:
        """Return the values (N, c) of a joint's channels."""
        first = sum(map(len, self.channels[:joint]))
        return self.values[:, first : first + len(self.channels[joint])]

    def _shift(self, joint: int, values: np.ndarray) -> np.ndarray:
        """Return a joint's position (N, 3) in its parent's frame."""
        shift = np.tile(self.offsets[joint], (len(values), 1))
        for name, column in zip(self.channels[joint], values.T, strict=True):
            if name.endswith("position"):
                shift[:, AXES.index(name[0])] = column
        return shift


def _turn(rotations: np.ndarray, axis: int, angles: np.ndarray) -> None:
    """Multiply rotations (N, 3, 3), in place and on the right, by turns of (N,) radians about an axis."""
    second, third = (axis + 1) % 3, (axis + 2) % 3
    sine, cosine = np.sin(angles)[:, None], np.cos(angles)[:, None]
    a, b = rotations[:, :, second].copy(), rotations[:, :, third].copy()
    rotations[:, :, second] = cosine * a + sine * b
    rotations[:, :, third] = cosine * b - sine * a


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file; line ends, blanks and letter case of keywords may vary, nothing else.

    Raises:
        InputError: for anything damaged (braces, numbers, counts, names, channels, an absurd frame time, more
            than 1000 joints, bytes that are no text); the message names the file and where possible the line.
    """
    lines = _lines(path)
    hierarchy = _Hierarchy(_Words(path, _head(path, lines)))
    frame_time, rounding, values = _motion(path, lines, sum(map(len, hierarchy.channels)))
    return Bvh(
        path=path,
        names=tuple(hierarchy.names),
        parents=tuple(hierarchy.parents),
        offsets=np.array(hierarchy.offsets),
        channels=tuple(hierarchy.channels),
        ends=tuple(hierarchy.ends),
        frame_time=frame_time,
        values=values,
        rounding=rounding,
    )


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the file's lines with their numbers, whatever the line ends (LF, CRLF or CR)."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: too large; allowed: a BVH of at most {MAX_BYTES >> 20} MiB")
        with open(path, encoding="latin-1") as file:  # Latin-1 gives every byte back
            for number, line in enumerate(iter(lambda: file.readline(MAX_LINE), ""), start=1):
                if len(line) == MAX_LINE:
                    _fail(path, number, "too long", f"{MAX_LINE} bytes")
                yield number, line.encode("latin-1")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); allowed: a BVH file") from error


def _head(path: Path, lines: Iterator[tuple[int, bytes]]) -> list[bytes]:
    """Take the lines up to MOTION from the file's lines; return those before it."""
    head: list[bytes] = []
    size = 0
    for _, line in lines:
        if line.strip().upper() == b"MOTION":
            return head
        head.append(line)
        size += len(line)
        if size > MAX_HEAD:
            raise InputError(
                f"{path}: no MOTION line in its first {MAX_HEAD >> 20} MiB; allowed: HIERARCHY, then MOTION"
            )
    raise InputError(f"{path}: no MOTION line, so truncated or no BVH; allowed: HIERARCHY, then MOTION")


def _fail(path: Path, line: int, wrong: str, allowed: str) -> NoReturn:
    raise InputError(f"{path}: line {line}: {wrong}; allowed: {allowed}")


def _number(word: str) -> float:
    """Parse a number as BVH writes it; NaN for anything else, also for `1_0` or `Infinity`."""
    try:
        return float(word) if re.fullmatch(r"[-+.0-9eE]+", word) else float("nan")
    except ValueError:
        return float("nan")


def _show(word: str) -> str:
    """Quote a word of the file for a message, shortened to 40 characters."""
    return repr(word)[:40]


class _Words:
    """The words of the hierarchy, one after the other; `line` is the line of the last one."""

    def __init__(self, path: Path, lines: list[bytes]) -> None:
        self.path = path
        self.line = 1
        self._words = self._split(lines)

    def _split(self, lines: list[bytes]) -> Iterator[str]:
        for self.line, line in enumerate(lines, start=1):
            try:
                text = line.decode("utf-8-sig" if self.line == 1 else "utf-8")
            except UnicodeDecodeError as error:
                self.fail(f"byte {line[error.start]:#04x} is no text", "UTF-8")
            yield from text.replace("{", " { ").replace("}", " } ").split()

    def fail(self, wrong: str, allowed: str) -> NoReturn:
        _fail(self.path, self.line, wrong, allowed)

    def next(self, allowed: str) -> str:
        """Return the next word; `allowed` says what it may be, for the message."""
        word = next(self._words, None)
        return word if word is not None else self.fail("the hierarchy ends before its time", allowed)

    def expect(self, *keywords: str) -> str:
        """Return the next word in capitals, which must be one of the keywords."""
        word = self.next(" or ".join(keywords))
        return word.upper() if word.upper() in keywords else self.fail(_show(word), " or ".join(keywords))

    def offset(self) -> np.ndarray:
        """Read three numbers."""
        return np.array([self._coordinate() for _ in range(3)])

    def _coordinate(self) -> float:
        allowed = f"three numbers up to {LIMIT:g} in size after OFFSET"
        word = self.next(allowed)
        return _number(word) if abs(_number(word)) <= LIMIT else self.fail(_show(word), allowed)

    def channels(self) -> tuple[str, ...]:
        """Read a count, and that many different channels."""
        allowed = f"0 to {len(CHANNELS)} and as many different ones of {', '.join(CHANNELS)} after CHANNELS"
        count = self.next(allowed)
        if count not in map(str, range(len(CHANNELS) + 1)):
            self.fail(_show(count), allowed)
        names = tuple(self.next(allowed).capitalize() for _ in range(int(count)))
        wrong = next((name for name in names if name not in CHANNELS or names.count(name) > 1), None)
        return names if wrong is None else self.fail(_show(wrong), allowed)

    def finish(self) -> None:
        """Check that no further word follows."""
        word = next(self._words, None)
        if word is not None:
            self.fail(_show(word), "MOTION after the root's last }")


@dataclass
class _Hierarchy:
    """The joints as they are read, without recursion; `open` holds those whose closing } is still to come."""

    words: _Words
    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[np.ndarray] = field(default_factory=list)
    channels: list[tuple[str, ...]] = field(default_factory=list)
    ends: list[EndSite] = field(default_factory=list)
    open: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.words.expect("HIERARCHY")
        self.words.expect("ROOT")
        self._joint()
        while self.open:
            keyword = self.words.expect("JOINT", "END", "}")
            if keyword == "JOINT":
                self._joint()
            elif keyword == "END":
                self._end()
            else:
                self.open.pop()
        self.words.finish()

    def _joint(self) -> None:
        """Read `name { OFFSET x y z CHANNELS n ...`; the joint's children follow later."""
        if len(self.names) == MAX_JOINTS:
            self.words.fail("one joint more", f"up to {MAX_JOINTS} joints")
        self.names.append(self._new_name(self.words.next("a joint's name")))
        self.parents.append(self.open[-1] if self.open else -1)
        self.open.append(len(self.names) - 1)
        self.words.expect("{")
        self.words.expect("OFFSET")
        self.offsets.append(self.words.offset())
        self.words.expect("CHANNELS")
        self.channels.append(self.words.channels())

    def _end(self) -> None:
        """Read `Site { OFFSET x y z }`, which follows `End`."""
        joint = self.open[-1]
        name = self._new_name(self.names[joint] + END)
        for keyword in ("SITE", "{", "OFFSET"):
            self.words.expect(keyword)
        self.ends.append(EndSite(name, joint, self.words.offset()))
        self.words.expect("}")

    def _new_name(self, name: str) -> str:
        if name in ("{", "}") or name in self.names or any(name == end.name for end in self.ends):
            self.words.fail(f"name {_show(name)}", "a name for each joint, and no name (or end site) twice")
        return name


def _motion(path: Path, lines: Iterator[tuple[int, bytes]], width: int) -> tuple[float, float, np.ndarray]:
    """Read frame time, its rounding and values (N, width) from the lines after MOTION, without blank ones."""
    rows = ((number, line) for number, line in lines if line.strip())
    first, second = next(rows, None), next(rows, None)
    if first is None or second is None or width == 0:
        raise InputError(f"{path}: no motion; allowed: channels, Frames:, Frame Time: and the frames")
    frames = _header(path, *first, "Frames:")
    if not re.fullmatch(r"0*[1-9]\d{0,8}", frames, re.ASCII):
        _fail(path, first[0], f"Frames: {_show(frames)}", "a whole number from 1")
    low, high = FRAME_RATE_RANGE
    seconds = _number(word := _header(path, *second, "Frame Time:"))
    if not 1 / high <= seconds <= 1 / low:
        _fail(path, second[0], f"Frame Time: {_show(word)}", f"{1 / high:g} to {1 / low:g} s")
    values = array("d")  # a list of rows would be much larger than its numbers
    for number, line in rows:
        values.extend(_values(path, number, line, width))
        if len(values) > MAX_VALUES:
            _fail(path, number, "too many frames", f"{MAX_VALUES} values")
    if len(values) != int(frames) * width:
        wrong = f"Frames: {int(frames)}, but {len(values) // width} lines of values follow"
        _fail(path, first[0], wrong, "one line for each frame")
    rounding = 0.5 * 10.0 ** int(Decimal(word).as_tuple().exponent)
    return seconds, rounding, np.array(values).reshape(-1, width)


def _header(path: Path, number: int, line: bytes, key: str) -> str:
    """Return the value of `key: value`; letter case and blanks may vary."""
    text = line.decode("latin-1").strip()
    pattern = key.replace(" ", r"\s*").replace(":", r"\s*:\s*(\S+)")
    match = re.fullmatch(pattern, text, re.IGNORECASE)
    return match[1] if match else _fail(path, number, _show(text), f"{key} and one number")


def _values(path: Path, number: int, line: bytes, width: int) -> np.ndarray:
    """Parse the numbers (width,) of a frame's line."""
    words = line.split()
    if len(words) != width:
        _fail(path, number, f"{len(words)} values", f"{width}, one for each channel")
    try:
        values = np.array([float("nan")] if b"_" in line else list(map(float, words)))
    except ValueError:
        values = np.array([float("nan")])
    if not (np.abs(values) <= LIMIT).all():
        texts = line.decode("latin-1").split()
        wrong = next((text for text in texts if not abs(_number(text)) <= LIMIT), texts[0])
        _fail(path, number, _show(wrong), f"numbers up to {LIMIT:g} in size")
    return values
