"""A made-up person as ASF/AMC text, and such files posed by plain NumPy, beside the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plain_kinematics import about

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
    for number, (name, rest) in enumerate(BONES.items(), start=1):
        lines += [
            "  begin",
            f"     id {number}",
            f"     name {name}",
            f"     direction {' '.join(rest[1:4])}",
        ]
        lines += [f"     length {rest[4]}", f"     axis {' '.join(rest[5:8])}  XYZ"]
        if dofs := rest[8:]:
            limits = ["    limits (-160.0 20.0)", *["           (-70.0 70.0)"] * (len(dofs) - 1)]
            lines += [f"    dof {' '.join(dofs)}", *limits]
        lines.append("  end")
    children: dict[str, list[str]] = {}
    for name, (parent, *_) in BONES.items():
        children.setdefault(parent, []).append(name)
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


def movement(frames: int, size: float = 20.0) -> np.ndarray:
    """Values (N, 62) of a person who stands, with all joints swinging: knees and elbows bend one way."""
    random = np.random.default_rng(1)
    count = sum(map(len, DOFS.values()))
    phase, speed = random.uniform(0, 6, count), random.uniform(1, 3, count)
    values = size * np.sin(phase + np.outer(np.arange(frames) / 20, speed))
    columns = [name for name, dofs in DOFS.items() for _ in dofs]
    for column, name in enumerate(columns):
        if name in ("ltibia", "rtibia", "lradius", "rradius"):
            values[:, column] += size
    values[:, :3] = [0.3, 17.0, 0.8] + 0.02 * values[:, :3]
    return values


def write_take(folder: Path, values: np.ndarray, first: int = 1) -> Path:
    """Write SUBJECT.asf and SUBJECT_01.amc, where SUBJECT is the folder's name; return the take."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{folder.name}.asf").write_text(asf_text(), encoding="latin-1")
    take = folder / f"{folder.name}_01.amc"
    take.write_text(amc_text(values, first), encoding="latin-1")
    return take


def plain_positions(asf: Path, amc: Path) -> dict[str, np.ndarray]:
    """Pose a take: the positions (N, 3), metres, of each bone's start, `BONE.end` being its end."""
    words = [line.split("#")[0].split() for line in asf.read_text("latin-1").splitlines()]
    words = [line for line in words if line]
    bones, bone, parents, inside = {}, {}, {}, False
    for line in words:
        inside = line[0] == ":hierarchy" or (inside and line[0][0] != ":")
        if inside and line[0] not in ("begin", "end"):
            parents |= dict.fromkeys(line[1:], line[0])
        elif line[0] == "begin":
            bone = {}
        elif line[0] == "name":
            bones[line[1]] = bone
        bone[line[0]] = line[1:]
    scale = 2.54 / 0.45 / 100
    frames: list[dict[str, list[float]]] = []
    for line in amc.read_text("latin-1").splitlines():
        own = line.split()
        if not own or own[0][0] in "#:":
            continue
        if len(own) == 1:
            frames.append({})
        else:
            frames[-1][own[0]] = [float(number) for number in own[1:]]

    def turn(angles: np.ndarray) -> np.ndarray:
        x, y, z = (about(axis, np.radians(angles[:, axis])) for axis in range(3))
        return z @ y @ x

    root = np.array([frame["root"] for frame in frames])
    starts, rotations = {"root": scale * root[:, :3]}, {"root": turn(root[:, 3:])}
    ends = {"root": starts["root"]}
    for name, parent in parents.items():
        own = bones[name]
        angles = np.zeros((len(frames), 3))
        for column, dof in enumerate(own.get("dof", [])):
            angles[:, ANGLES.index(dof)] = [frame[name][column] for frame in frames]
        axes = turn(np.array([own["axis"][:3]], float))[0]
        rotations[name] = rotations[parent] @ axes @ turn(angles) @ axes.T
        bone_vector = scale * float(own["length"][0]) * np.array(own["direction"], float)
        starts[name], ends[name] = ends[parent], ends[parent] + rotations[name] @ bone_vector
    return starts | {f"{name}.end": end for name, end in ends.items()}
