"""A made-up person as ASF/AMC text, and its takes posed by SciPy, beside the package."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

# Bone, parent, direction and length in the zero pose, angles of its own axes, values in a frame.
SKELETON = """
lhipjoint root 0.66 -0.67 0.34 2.4 0 0 0
lfemur lhipjoint 0.34202 -0.939693 0 7.1 0 0 20 rx ry rz
ltibia lfemur 0.34202 -0.939693 0 7.4 0 0 20 rx
lfoot ltibia 0.1 -0.27 0.957 2.2 -90 0 20 rx rz
ltoes lfoot 0 0 1 1.1 -90 0 20 rx
rhipjoint root -0.66 -0.67 0.34 2.4 0 0 0
rfemur rhipjoint -0.34202 -0.939693 0 7.1 0 0 -20 rx ry rz
rtibia rfemur -0.34202 -0.939693 0 7.4 0 0 -20 rx
rfoot rtibia -0.1 -0.27 0.957 2.2 -90 0 -20 rx rz
rtoes rfoot 0 0 1 1.1 -90 0 -20 rx
lowerback root 0 1 -0.05 2.1 0 0 0 rx ry rz
upperback lowerback 0 1 -0.02 2.1 0 0 0 rx ry rz
thorax upperback 0 1 0 2.1 0 0 0 rx ry rz
lowerneck thorax 0 1 0 1.7 0 0 0 rx ry rz
upperneck lowerneck 0 0.93 -0.37 1.6 0 0 0 rx ry rz
head upperneck 0 0.99 -0.1 1.7 0 0 0 rx ry rz
lclavicle thorax 0.98 0.15 0.05 3.5 0 0 0 ry rz
lhumerus lclavicle 1 0 0 5.4 180 -30 -90 rx ry rz
lradius lhumerus 1 0 0 2.6 180 -30 -90 rx
lwrist lradius 1 0 0 1.3 -90 90 0 ry
lhand lwrist 1 0 0 0.7 -90 90 0 rx rz
lfingers lhand 1 0 0 0.6 -90 90 0 rx
lthumb lwrist 0.7 0 0.7 0.8 -90 45 0 rx rz
rclavicle thorax -0.98 0.15 0.05 3.5 0 0 0 ry rz
rhumerus rclavicle -1 0 0 5.4 180 30 90 rx ry rz
rradius rhumerus -1 0 0 2.6 180 30 90 rx
rwrist rradius -1 0 0 1.3 -90 -90 0 ry
rhand rwrist -1 0 0 0.7 -90 -90 0 rx rz
rfingers rhand -1 0 0 0.6 -90 -90 0 rx
rthumb rwrist -0.7 0 0.7 0.8 -90 -45 0 rx rz
"""
BONES = {name: rest for name, *rest in map(str.split, SKELETON.strip().splitlines())}
ANGLES = ("rx", "ry", "rz")
DOFS = {"root": ["tx", "ty", "tz", *ANGLES], **{name: rest[8:] for name, rest in BONES.items() if rest[8:]}}


def asf_text() -> str:
    """The skeleton's file, with comments, bytes of Latin-1 and limits as the databases have them."""
    lines = ["# made f\xfcr tests", ":version 1.10", ":name VICON", ":units", "  mass 1.0", "  length 0.45"]
    lines += ["  angle deg", ":documentation", "   a person", ":root", "   order TX TY TZ RX RY RZ"]
    lines += ["   axis XYZ", "   position 0 0 0  ", "   orientation 0 0 0 ", ":bonedata"]
    children: dict[str, list[str]] = {}
    for number, (name, (parent, x, y, z, length, *angles)) in enumerate(BONES.items(), start=1):
        children.setdefault(parent, []).append(name)
        lines += ["  begin", f"     id {number}", f"     name {name}", f"     direction {x} {y} {z}"]
        lines += [f"     length {length}", f"     axis {' '.join(angles[:3])}  XYZ"]
        if dofs := angles[3:]:
            limits = ["    limits (-160.0 20.0)", *["           (-70.0 70.0)"] * (len(dofs) - 1)]
            lines += [f"    dof {' '.join(dofs)}", *limits]
        lines.append("  end")
    lines += [":hierarchy", "  begin", *(f"    {p} {' '.join(c)}" for p, c in children.items()), "  end"]
    return "\n".join(lines) + "\n"


def amc_text(values: np.ndarray, first: int = 1) -> str:
    """A take with these values (N, 62), in the order of `DOFS`."""
    lines = ["#!OML:ASF X:\\f\xfcr tests\\person.ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for number, row in enumerate(values.tolist(), start=first):
        lines.append(str(number))
        for name, dofs in DOFS.items():
            own, row = row[: len(dofs)], row[len(dofs) :]
            lines.append(" ".join([name, *(f"{value:.6g}" for value in own)]))
    return "\n".join(lines) + "\n"


COLUMNS = [(name, dof) for name, dofs in DOFS.items() for dof in dofs]
"""Of values (N, 62)."""


def movement(frames: int, size: float = 20.0) -> np.ndarray:
    """Values (N, 62) of a person who stands, with all joints swinging: knees and elbows bend one way."""
    random = np.random.default_rng(1)
    phase, speed = random.uniform(0, 6, len(COLUMNS)), random.uniform(1, 3, len(COLUMNS))
    values = size * np.sin(phase + np.outer(np.arange(frames) / 20, speed))
    values[:, [name in ("ltibia", "rtibia", "lradius", "rradius") for name, _ in COLUMNS]] += size
    values[:, :3] = [0.3, 17.0, 0.8] + 0.02 * values[:, :3]
    return values


def write_take(folder: Path, values: np.ndarray, first: int = 1) -> Path:
    """Write SUBJECT.asf and SUBJECT_01.amc, where SUBJECT is the folder's name; return the take."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{folder.name}.asf").write_text(asf_text(), encoding="latin-1")
    take = folder / f"{folder.name}_01.amc"
    take.write_text(amc_text(values, first), encoding="latin-1")
    return take


def plain_positions(values: np.ndarray) -> dict[str, np.ndarray]:
    """The positions (N, 3), metres, of each bone's start, `BONE.end` being its end; by SciPy."""

    def turn(angles: np.ndarray) -> np.ndarray:
        return Rotation.from_euler("xyz", angles, degrees=True).as_matrix()

    scale = 2.54 / 0.45 / 100
    starts, rotations = {"root": scale * values[:, :3]}, {"root": turn(values[:, 3:6])}
    ends = {"root": starts["root"]}
    for name, (parent, *numbers) in BONES.items():
        direction, length, axis = np.split(np.array(numbers[:7], float), [3, 4])
        angles = np.zeros((len(values), 3))
        for column, (bone, dof) in enumerate(COLUMNS):
            if bone == name:
                angles[:, ANGLES.index(dof)] = values[:, column]
        rotations[name] = rotations[parent] @ turn(axis) @ turn(angles) @ turn(axis).T
        starts[name], ends[name] = ends[parent], ends[parent] + rotations[name] @ (scale * length * direction)
    return starts | {f"{name}.end": end for name, end in ends.items()}
