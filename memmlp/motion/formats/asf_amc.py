"""Reads ASF/AMC, the format of the CMU and HDM05 databases. AMC files have motion; ASF files have skeletons.

A bone turns about its own axes. Its local rotation is C M C^-1: C is the bone's `axis`, and M is the product
of the frame's angles (degrees; the order X Y Z means Rz Ry Rx on column vectors). Each bone has a node at its
start with the bone's rotation. A bone without children also has an end site. Lengths are converted to metres.
In the file they are inches times the factor `length` of `:units`. Y is up.
"""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.formats.recording import END, LIMIT, Recording, fail, open_text

INCH = 0.0254  # metres
ROOT = "root"
ROTATIONS, POSITIONS = ("rx", "ry", "rz"), ("tx", "ty", "tz")


@dataclass(frozen=True)
class Bone:
    """A bone of an ASF file: its vector (3,) from start to end in the zero pose, metres, the rotation C of
    its axes, and its values in a frame, in the file's order: some of `rx`, `ry`, `rz`, and for the root also
    `tx`, `ty`, `tz`."""

    vector: np.ndarray
    axes: Rotation
    dofs: tuple[str, ...]


@dataclass(frozen=True)
class AsfAmc(Recording):
    """A take in ASF/AMC format, in metres. Its nodes are the root and the bones, which `bones` has in this
    order, and the end sites. `unit` is the file's length unit, metres. `first_frame` is above 1 in cut takes.
    """

    bones: tuple[Bone, ...]
    unit: float
    first_frame: int

    def compute_kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        rotations = np.empty((len(self.nodes), len(self), 3, 3))
        positions = np.zeros((len(self.nodes), len(self), 3))
        first = 0
        for node, parent in enumerate(self.node_parents):
            above = rotations[parent] if node else np.eye(3)
            rotations[node], local = above, np.eye(3)
            if node:
                positions[node] = positions[parent] + above @ self.offsets[node]
            if node < len(self.bones):
                bone = self.bones[node]
                values = self.values[:, first : first + len(bone.dofs)]
                first += len(bone.dofs)
                turns = [column for column, dof in enumerate(bone.dofs) if dof in ROTATIONS]
                order = "".join(bone.dofs[column][1] for column in turns)
                if order:
                    turned = Rotation.from_euler(order, values[:, turns], degrees=True)
                    local = (bone.axes * turned * bone.axes.inv()).as_matrix()
                for column, dof in enumerate(bone.dofs):
                    if dof in POSITIONS:
                        positions[node, :, POSITIONS.index(dof)] = self.unit * values[:, column]
            rotations[node] = above @ local
        return rotations.swapaxes(0, 1), positions.swapaxes(0, 1)

    def list_rest_values(self) -> list[list[float | None]]:
        return [[None if dof in ROTATIONS else 0.0 for dof in bone.dofs] for bone in self.bones]


# Reading


def read_amc(path: Path) -> AsfAmc:
    """Read a take and its skeleton, which is in the same folder (`05.asf` for `05_01.amc`). Raises InputError
    if the skeleton is missing or one of the files is damaged, such as by invalid numbers, missing bones, or a
    gap between frames. The message has the file and if possible the line."""
    names, parents, bones, unit = _read_asf(find_asf(path))
    ends = [node for node in range(len(names)) if node not in parents]
    offsets = [np.zeros(3), *(bones[parent].vector for parent in [*parents[1:], *ends])]
    widths = {name: len(bone.dofs) for name, bone in zip(names, bones, strict=True) if bone.dofs}
    first_frame, values = _read_frames(path, widths)
    return AsfAmc(
        path=path,
        nodes=(*names, *(names[node] + END for node in ends)),
        node_parents=(*parents, *ends),
        offsets=np.array(offsets),
        fps=None,
        values=values,
        bones=tuple(bones),
        unit=unit,
        first_frame=first_frame,
    )


def find_asf(path: Path) -> Path:
    """Find the skeleton of a take: an ASF file in the same folder, such as `05.asf` for `05_01.amc`. Raises
    InputError without such a file."""
    files = [file for file in path.parent.glob("*") if file.suffix.lower() == ".asf"]
    matches = [file for file in files if path.stem.lower().startswith(f"{file.stem}_".lower())]
    if not matches:
        expected = f"{path.stem.partition('_')[0]}.asf"
        raise InputError(f"{path}: no skeleton in the same folder; expected {expected}")
    return max(matches, key=lambda file: len(file.stem))


def _read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and words of each line, without comments and blank lines."""
    with open_text(path, "latin-1") as file:  # comments may have any encoding
        for number, line in enumerate(file, start=1):
            if words := line.partition("#")[0].split():
                yield number, words


def _parse_numbers(path: Path, line: int, words: Sequence[str], count: int, key: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(number) <= LIMIT for number in numbers):
        expected = f"{count} numbers of at most {LIMIT:g} in absolute value"
        fail(path, line, f"{key} {' '.join(words)[:60]}", expected)
    return numbers


# The skeleton


def _read_asf(path: Path) -> tuple[list[str], list[int], list[Bone], float]:
    """Read node names, their parents' indices, the bones, and the length unit in metres."""
    sections: dict[str, list[tuple[int, list[str]]]] = {}
    for line, words in _read_lines(path):
        if words[0].startswith(":"):
            sections[words[0].lower()] = rows = []
        elif not sections:
            fail(path, line, words[0][:40], "a section, such as :units")
        else:
            rows.append((line, words))
    if missing := [key for key in (":units", ":root", ":bonedata", ":hierarchy") if not sections.get(key)]:
        raise InputError(f"{path}: has no {missing[0]}; expected :units, :root, :bonedata and :hierarchy")
    unit = _read_unit(path, sections[":units"])
    bones = {ROOT: _read_root(path, sections[":root"]), **_read_bones(path, sections[":bonedata"], unit)}
    names, parents = _read_hierarchy(path, sections[":hierarchy"], bones)
    return names, parents, [bones[name] for name in names], unit


def _read_unit(path: Path, rows: Sequence[tuple[int, list[str]]]) -> float:
    values = {words[0].lower(): (line, words[1:]) for line, words in rows}
    line, angle = values.get("angle", (rows[0][0], []))
    if angle != ["deg"]:
        fail(path, line, f"angle {' '.join(angle)}", "angle deg")
    line, length = values.get("length", (rows[0][0], []))
    (factor,) = _parse_numbers(path, line, length, 1, "length")
    if factor <= 0:
        fail(path, line, f"length {factor:g}", "a factor above 0")
    return INCH / factor


def _read_root(path: Path, rows: Sequence[tuple[int, list[str]]]) -> Bone:
    values = {words[0].lower(): (line, words[1:]) for line, words in rows}
    for key in ("position", "orientation"):
        line, words = values.get(key, (rows[0][0], []))
        if any(_parse_numbers(path, line, words, 3, key)):
            fail(path, line, f"{key} {' '.join(words)}", "0 0 0")
    line, order = values.get("order", (rows[0][0], []))
    axis_line, axis = values.get("axis", (rows[0][0], []))
    axes = _parse_axes(path, axis_line, ["0", "0", "0", *axis])
    return Bone(np.zeros(3), axes, _parse_dofs(path, line, order, (*POSITIONS, *ROTATIONS)))


def _read_bones(path: Path, rows: Sequence[tuple[int, list[str]]], unit: float) -> dict[str, Bone]:
    bones: dict[str, Bone] = {}
    values: dict[str, tuple[int, list[str]]] = {}
    inside = False
    for line, words in rows:
        key = words[0].lower()
        if (key == "begin") == inside:
            fail(path, line, words[0][:40], "begin, then the lines of one bone, then end")
        inside = key != "end"
        if key not in ("begin", "end"):
            values[key] = line, words[1:]
        elif key == "end":
            name, bone = _read_bone(path, line, values, unit)
            if name in bones or name == ROOT:
                fail(path, line, f"a second bone {name}", "a unique name for each bone")
            bones[name], values = bone, {}
    if inside:
        raise InputError(f"{path}: the last bone of :bonedata has no end; expected an end line")
    return bones


def _read_bone(
    path: Path, end: int, values: Mapping[str, tuple[int, list[str]]], unit: float
) -> tuple[str, Bone]:
    if missing := [key for key in ("name", "direction", "length", "axis") if key not in values]:
        fail(path, end, f"a bone without {missing[0]} ends here", "name, direction, length and axis")
    line, words = values["name"]
    if len(words) != 1:
        fail(path, line, f"name {' '.join(words)[:40]}", "one word")
    direction = _parse_numbers(path, *values["direction"], 3, "direction")
    (length,) = _parse_numbers(path, *values["length"], 1, "length")
    axes = _parse_axes(path, *values["axis"])
    dofs = _parse_dofs(path, *values["dof"], ROTATIONS) if "dof" in values else ()
    return words[0], Bone(unit * length * np.array(direction), axes, dofs)


def _parse_axes(path: Path, line: int, words: Sequence[str]) -> Rotation:
    order = words[-1].lower() if words else ""
    if sorted(order) != ["x", "y", "z"]:
        fail(path, line, f"axis {' '.join(words)[:60]}", "an order of axes at the end, such as XYZ")
    return Rotation.from_euler(order, _parse_numbers(path, line, words[:-1], 3, "axis"), degrees=True)


def _parse_dofs(path: Path, line: int, words: Sequence[str], choices: Sequence[str]) -> tuple[str, ...]:
    dofs = tuple(word.lower() for word in words)
    if not dofs or not set(dofs) <= set(choices) or len(set(dofs)) < len(dofs):
        expected = f"one or more of {' '.join(choices)} without repetition"
        fail(path, line, " ".join(words)[:60] or "no values", expected)
    return dofs


def _read_hierarchy(
    path: Path, rows: Sequence[tuple[int, list[str]]], bones: Mapping[str, Bone]
) -> tuple[list[str], list[int]]:
    names, parents = [ROOT], [-1]
    for line, (parent, *children) in rows:
        if parent.lower() in ("begin", "end") and not children:
            continue
        if parent not in names:
            fail(path, line, parent[:40], "root, or a bone that is a child in an earlier line")
        for child in children:
            if child not in bones or child in names:
                fail(path, line, child[:40], "a bone of :bonedata without a parent in an earlier line")
            names.append(child)
            parents.append(names.index(parent))
    if left := sorted(set(bones) - set(names)):
        raise InputError(f"{path}: {left[0]} is missing in :hierarchy; expected every bone of :bonedata")
    return names, parents


# The motion


def _read_frames(path: Path, widths: Mapping[str, int]) -> tuple[int, np.ndarray]:
    """Read the number of the first frame, and the values (N, C) in the order of `widths`."""
    values, frame = array("d"), dict[str, list[float]]()
    first = last = line = 0

    def finish() -> None:
        if missing := [name for name in widths if name not in frame]:
            fail(path, line, f"frame {last} without {missing[0]}", f"{len(widths)} bones in each frame")
        for name in widths:
            values.extend(frame[name])
        frame.clear()

    for line, (word, *numbers) in _read_lines(path):
        if word.isdigit() and not numbers:
            if last:
                finish()
            if int(word) != last + 1 and last:
                fail(path, line, f"frame {word} after frame {last}", f"frame {last + 1}")
            first, last = first or int(word), int(word)
        elif word.startswith(":"):
            if last or word.upper() == ":RADIANS":
                fail(path, line, word[:40], "frames in degrees, after all keywords")
        elif not last or word not in widths or word in frame:
            expected = "a bone with angles, at most once per frame" if last else "a frame number"
            fail(path, line, word[:40], expected)
        else:
            frame[word] = _parse_numbers(path, line, numbers, widths[word], word)
    if not last:
        raise InputError(f"{path}: has no frames; expected a frame number, then one line per bone")
    finish()
    return first, np.array(values).reshape(-1, sum(widths.values()))
