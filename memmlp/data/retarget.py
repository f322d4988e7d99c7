"""BVH -> Clip on the 22-joint tree, by a skeleton's YAML map; the check of it; import of whole folders.

A source joint's global rotation, carried from the file's axes to the world (Z up), is the rotation of the
body joint it is mapped to, up to a constant correction K on the right: the bone that points along t in the
body's rest pose points along s = K t in the source's zero pose. Arms and legs get the least rotation from t
to s, so that they point as in the source in every frame. Wrists, ankles and feet move on with the bone
before them. The torso and the head stand upright in both poses and need no correction. A body joint without
a counterpart takes its parent's rotation.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from memmlp.body import JOINTS, PARENTS, load_rest_joints
from memmlp.data.bvh import Bvh, read_bvh
from memmlp.data.clip import FRAME_RATE_RANGE, Clip, read_clip, write_clip
from memmlp.errors import InputError
from memmlp.geometry import axis_angle_to_matrix, forward_kinematics
from memmlp.progress import track

SKELETONS = Path(__file__).parent / "skeletons"
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # Y-up axes to the world's: y becomes z
HIPS = (1, 2)
LEGS = {1: 4, 2: 5, 4: 7, 5: 8}  # joint: the joint its bone points to
LIMBS = LEGS | {16: 18, 17: 19, 18: 20, 19: 21}
FOLLOWERS = (7, 8, 10, 11, 20, 21)  # they keep the correction of the bone before them
REQUIRED = ("pelvis", "head", *(JOINTS[joint] for joint in sorted({*LIMBS, *LIMBS.values()})))
ZERO_POSE_LIMIT = 100.0  # degrees between a limb in the source's zero pose and in the T-pose
POSITION_LIMIT = 1e4  # metres, as `read_clip` has it
RECORD = "import.json"
HEADER = "the header's"


@dataclass(frozen=True)
class Skeleton:
    """A source skeleton's map.

    Attributes:
        name: its name.
        unit: metres in the file's unit.
        up: the file's up axis, `y` (zero pose facing +Z) or `z` (facing -Y); left is +X in both.
        calibration_frame: whether frame 0 is a calibration pose, not motion.
        rates: true frame rates, Hz, of folders whose headers are known to be wrong.
        joints: the BVH node (a joint, or `<joint>.end`) of each body joint that has one.
    """

    name: str
    unit: float
    up: str
    calibration_frame: bool
    joints: dict[str, str]
    rates: dict[str, float] = field(default_factory=dict)

    @property
    def upright(self) -> np.ndarray:
        """The rotation (3, 3) from the file's axes to Y-up axes."""
        return np.eye(3) if self.up == "y" else Z_UP.T


def shipped_skeletons() -> tuple[str, ...]:
    """Names of the maps in the package."""
    return tuple(sorted(path.stem for path in SKELETONS.glob("*.yaml")))


def load_skeleton(which: str) -> Skeleton:
    """A shipped map by name, or a user's by its path. Raises InputError for a file that is no map."""
    path = SKELETONS / f"{which}.yaml" if which in shipped_skeletons() else Path(which)
    if not path.is_file():
        known = ", ".join(shipped_skeletons())
        raise InputError(f"skeleton: {which!r} is no file; allowed: {known}, or the path of a YAML map")
    try:
        content = yaml.load(path.read_text("utf-8"), _StrictLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        brief = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: {brief}; allowed: a readable YAML map") from error
    _check_map(path, content)
    return Skeleton(**content)


def find_skeleton(bvh: Bvh) -> Skeleton:
    """The one shipped map whose nodes the file has all. Raises InputError where there is none, or several."""
    maps = [load_skeleton(name) for name in shipped_skeletons()]
    fitting = [skeleton for skeleton in maps if set(skeleton.joints.values()) <= set(bvh.nodes)]
    if len(fitting) == 1:
        return fitting[0]
    state = "fits more than one skeleton" if fitting else "has an unknown skeleton"
    known = ", ".join(skeleton.name for skeleton in fitting or maps)
    listed = ", ".join(bvh.names[:60]) + (", ..." if len(bvh.names) > 60 else "")
    raise InputError(f"{bvh.path}: {state} with the joints {listed}; allowed: {known}, or a map by skeleton=")


class _StrictLoader(yaml.SafeLoader):
    """Plain YAML in which no key stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        twice = [key for key, count in keys.items() if count > 1]
        if twice:
            raise ValueError(f"the key {twice[0]!r} stands twice")
        return super().construct_mapping(node, deep)


def _check_map(path: Path, content: object) -> None:
    """Raise InputError unless the YAML has exactly what a Skeleton needs."""

    def require(good: bool, key: str, allowed: str) -> None:
        if not good:
            raise InputError(f"{path}: {key} is wrong or missing; allowed: {allowed}")

    keys = {"name", "unit", "up", "calibration_frame", "joints"}
    if not isinstance(content, dict) or not keys <= set(content) <= keys | {"rates"}:
        raise InputError(f"{path}: not the keys of a map; allowed: {', '.join(sorted(keys))}, and rates")
    joints, rates = content["joints"], content.get("rates", {})
    require(_is_text(content["name"]), "name", "text")
    require(_is_number(content["unit"], 1e-6, 1e3), "unit", "a number of metres from 1e-6 to 1000")
    require(content["up"] in ("y", "z"), "up", "y or z")
    require(isinstance(content["calibration_frame"], bool), "calibration_frame", "true or false")
    require(isinstance(rates, dict), "rates", "folder: Hz")
    for folder, rate in rates.items():
        good = _is_text(folder) and _is_number(rate, *FRAME_RATE_RANGE)
        require(good, f"rates.{folder}", "a folder's name and 1 to 1000 Hz")
    require(isinstance(joints, dict), "joints", f"{', '.join(JOINTS)}, each with the file's joint")
    for joint, node in joints.items():
        allowed = f"a joint of the file for each of {', '.join(JOINTS)}"
        require(joint in JOINTS and _is_text(node), f"joints.{joint}", allowed)
    for joint in REQUIRED:
        require(joint in joints, f"joints.{joint}", f"a joint's name; {', '.join(REQUIRED)} are needed")
    node, count = Counter(joints.values()).most_common(1)[0]
    require(count == 1, f"joints: {node}", "each of the file's joints once")


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isprintable() and value != ""


def _is_number(value: object, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


@dataclass(frozen=True)
class Retargeting:
    """What is constant between one BVH hierarchy and one body, in Y-up axes and metres.

    Attributes:
        nodes: the BVH node (22,) whose rotation each body joint takes; its parent's where it has none.
        corrections: K (22, 3, 3), on the right of the node's rotation.
        own_rest: rest positions (22, 3) of the source's own bones, in the corrected joint frames.
        scale: the body's leg length over the source's.
        anchor: from the scaled source root to the body's root (3,), in the root's frame, so that the hips
            of both have the same middle (a source's root may lie above or below SMPL's pelvis).
    """

    nodes: np.ndarray
    corrections: np.ndarray
    own_rest: np.ndarray
    scale: float
    anchor: np.ndarray


def fit(bvh: Bvh, skeleton: Skeleton, rest: np.ndarray) -> Retargeting:
    """Fit the hierarchy to a body's rest joints (22, 3), metres.

    Raises InputError where joints are missing or stand in another order than the body's, or where the zero
    pose is no upright pose of a person with bones of some length.
    """
    nodes = _nodes(bvh, skeleton)
    zero = (bvh.zero_pose() @ skeleton.upright.T * skeleton.unit)[nodes]
    _check_zero_pose(bvh.path, zero, rest)
    corrections = _corrections(zero, rest)
    scale = _leg_length(rest) / _leg_length(zero)
    anchor = scale * (zero[HIPS, :].mean(0) - zero[0]) - (rest[HIPS, :].mean(0) - rest[0])
    return Retargeting(nodes, corrections, _own_rest(zero, corrections), scale, anchor)


def retarget(
    bvh: Bvh, skeleton: Skeleton, rest: np.ndarray, *, name: str = "bvh", fps: float | None = None
) -> Clip:
    """The motion on a body with the rest joints (22, 3), metres, in the world (Z up).

    The rate is `fps`, or the header's; a calibration frame is dropped. Raises InputError as `fit` does, and
    where no frame is left or the person leaves the world.
    """
    fitted = fit(bvh, skeleton, rest)
    world = Z_UP @ skeleton.upright
    rotations, positions = (array[int(skeleton.calibration_frame) :] for array in bvh.kinematics())
    if len(rotations) == 0:
        raise InputError(f"{bvh.path}: only the calibration frame; allowed: two frames or more")
    turned = world @ rotations[:, fitted.nodes] @ (skeleton.upright.T @ fitted.corrections)
    root = fitted.scale * skeleton.unit * positions[:, fitted.nodes[0]] @ world.T
    trans = root + turned[:, 0] @ fitted.anchor - rest[0]
    if np.abs(trans).max() > POSITION_LIMIT:
        far = f"{np.abs(trans).max():.3g} m from the origin with the unit of {skeleton.name}"
        raise InputError(f"{bvh.path}: {far}; allowed: {POSITION_LIMIT:g} m")
    local = turned.copy()
    local[:, 1:] = turned[:, list(PARENTS[1:])].swapaxes(-1, -2) @ turned[:, 1:]
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), len(JOINTS), 3)
    return Clip(name, poses, trans, fps or bvh.fps)


def _nodes(bvh: Bvh, skeleton: Skeleton) -> np.ndarray:
    """Each body joint's node (22,), its parent's where it has none."""
    missing = sorted(set(skeleton.joints.values()) - set(bvh.nodes))
    if missing:
        lacking = f"no {', '.join(missing)}, which skeleton {skeleton.name} names"
        raise InputError(f"{bvh.path}: {lacking}; allowed: a map of the file's joints")
    nodes = np.zeros(len(JOINTS), int)
    for joint, parent in enumerate(PARENTS):
        node = skeleton.joints.get(JOINTS[joint])
        nodes[joint] = nodes[parent] if node is None else bvh.nodes.index(node)
        if nodes[parent] not in _line(bvh, nodes[joint]):
            wrong = f"{node} is not below {bvh.nodes[nodes[parent]]}, as skeleton {skeleton.name} has it"
            raise InputError(f"{bvh.path}: {wrong}; allowed: a map of the file's tree")
    return nodes


def _line(bvh: Bvh, node: int) -> list[int]:
    """The node and its ancestors."""
    line = [node]
    while bvh.node_parents[line[-1]] >= 0:
        line.append(bvh.node_parents[line[-1]])
    return line


def _check_zero_pose(path: Path, zero: np.ndarray, rest: np.ndarray) -> None:
    """Raise InputError unless each limb has a length and points roughly as in the T-pose."""
    for joint, child in LIMBS.items():
        bone = zero[child] - zero[joint]
        angle = math.degrees(_angles(bone, rest[child] - rest[joint]))
        if np.linalg.norm(bone) < 1e-3 or angle > ZERO_POSE_LIMIT:
            wrong = f"{JOINTS[joint]} to {JOINTS[child]} is {np.linalg.norm(bone):.3g} m in the zero pose"
            allowed = "a zero pose that stands upright, faces forward and has its left on +X"
            raise InputError(f"{path}: {wrong}, {angle:.0f} degrees off a T-pose; allowed: {allowed}")


def _corrections(zero: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """K (22, 3, 3) from the positions (22, 3) in the source's zero pose and in the body's rest pose."""
    corrections = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    for joint, child in LIMBS.items():
        corrections[joint] = _least_rotation(rest[child] - rest[joint], zero[child] - zero[joint])
    for joint in FOLLOWERS:
        corrections[joint] = corrections[PARENTS[joint]]
    return corrections


def _least_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) of one direction (3,) onto another that is not its opposite."""
    axis = np.cross(source, target)
    norm = np.linalg.norm(axis)
    angle = math.atan2(norm, source @ target)
    return Rotation.from_rotvec(axis * (angle / norm) if norm else axis).as_matrix()


def _own_rest(zero: np.ndarray, corrections: np.ndarray) -> np.ndarray:
    """Rest positions (22, 3) by which corrected rotations put the source's joints where the source does."""
    own = zero.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        own[joint] = own[parent] + corrections[parent].T @ (zero[joint] - zero[parent])
    return own


def _leg_length(positions: np.ndarray) -> float:
    """Thigh and shin of positions (22, 3), the mean of both sides."""
    return (
        sum(float(np.linalg.norm(positions[child] - positions[joint])) for joint, child in LEGS.items()) / 2
    )


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (...), radians, between directions (..., 3); accurate at 0."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


@dataclass(frozen=True)
class Fidelity:
    """How far an import is off its source, in the worst frame.

    Attributes:
        name: the file's path below the source folder.
        skeleton: the map.
        frames: frames compared.
        worst_mm: millimetres between a mapped joint in the file and in the import on the source's own bones.
        worst_joint: the body joint where that is.
        worst_degrees: between a limb (upper arm, forearm, thigh, shin) in the file and on the body.
    """

    name: str
    skeleton: str
    frames: int
    worst_mm: float
    worst_joint: str
    worst_degrees: float


def verify(path: Path, *, skeleton: str | None = None, body: str = "builtin", name: str = "") -> Fidelity:
    """Import one file to an npz, read it back, and compare with the file's own kinematics.

    On the file's side only `Bvh.kinematics`, on the other only the npz and `geometry.forward_kinematics`.
    A joint below an unmapped source joint that turns has no constant bone: the distance shows it.
    """
    bvh, rest = read_bvh(path), load_rest_joints(body)
    chosen = load_skeleton(skeleton) if skeleton else find_skeleton(bvh)
    with tempfile.TemporaryDirectory() as folder:
        write_clip(Path(folder) / "clip.npz", retarget(bvh, chosen, rest))
        clip = read_clip(Path(folder) / "clip.npz", name)
    fitted = fit(bvh, chosen, rest)
    nodes = bvh.kinematics()[1][int(chosen.calibration_frame) :, fitted.nodes]
    expected = chosen.unit * nodes @ (Z_UP @ chosen.upright).T
    local = axis_angle_to_matrix(torch.from_numpy(clip.poses))
    root = torch.from_numpy(rest[0] + clip.trans)
    own_root = (root - local[:, 0] @ torch.from_numpy(fitted.anchor)) / fitted.scale
    own = forward_kinematics(local, own_root, torch.from_numpy(fitted.own_rest))[1].numpy()
    distance = np.linalg.norm(own - expected, axis=-1).max(0)
    bodily = forward_kinematics(local, root, torch.from_numpy(rest))[1].numpy()
    start, end = list(LIMBS), list(LIMBS.values())
    angles = _angles(bodily[:, end] - bodily[:, start], expected[:, end] - expected[:, start])
    return Fidelity(
        name=name or path.name,
        skeleton=chosen.name,
        frames=len(clip),
        worst_mm=1000 * float(distance.max()),
        worst_joint=JOINTS[int(distance.argmax())],
        worst_degrees=math.degrees(float(angles.max())),
    )


def verify_folder(source: Path, *, skeleton: str | None = None, body: str = "builtin") -> list[Fidelity]:
    """`verify` for each BVH file of a folder (or one file). Raises InputError at the first bad file."""
    files = find_bvh(source)
    return [
        verify(path, skeleton=skeleton, body=body, name=relative.as_posix())
        for relative, path in track(files.items(), "verify", len(files))
    ]


@dataclass(frozen=True)
class Imported:
    """One imported clip: source and npz below their folders, what of it, at which rate, and why."""

    source: str
    sha256: str
    clip: str
    skeleton: str
    frames: int
    header_fps: float
    fps: float
    fps_reason: str


@dataclass(frozen=True)
class Skipped:
    """A file that could not be imported, and why."""

    source: str
    reason: str


@dataclass(frozen=True)
class ImportReport:
    """What an import wrote, the folders whose header rates it corrected, and what it skipped."""

    clips: tuple[Imported, ...]
    notes: tuple[str, ...]
    skipped: tuple[Skipped, ...]


def find_bvh(source: Path) -> dict[Path, Path]:
    """BVH files of a folder (or one file), sorted, by their path below it. Raises InputError for none."""
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; allowed: BVH files")
    top = source if source.is_dir() else source.parent
    paths = sorted(source.rglob("*")) if source.is_dir() else [source]
    files = {
        path.relative_to(top): path for path in paths if path.suffix.lower() == ".bvh" and path.is_file()
    }
    if not files:
        raise InputError(f"{source}: no BVH file found; allowed: a .bvh file, or a folder with some in it")
    return files


def import_folder(
    source: Path,
    out: Path,
    *,
    skeleton: str | None = None,
    fps: Mapping[str, float] = {},
    body: str = "builtin",
    strict: bool = False,
) -> ImportReport:
    """Write each BVH file of a folder (or one file) as out/<its path>.npz, and out/import.json about it.

    Args:
        source: folder or file.
        out: folder; other clips than this import's must not be in it.
        skeleton: a shipped map or the path of one; by default each file's joints decide.
        fps: true frame rates, Hz, by folder below source ("" for all), over the map's and the header's.
        body: `builtin`, or an SMPL-H model.npz.
        strict: raise for a bad file; otherwise it is skipped and reported.

    Raises InputError, with nothing written, for no files, files of the same name, a rate that fits no folder,
    and where no file at all could be imported.
    """
    files = find_bvh(source)
    _check_import(files, out, fps)
    rest, clips, skipped = load_rest_joints(body), [], []
    chosen = None if skeleton is None else load_skeleton(skeleton)
    with _staging(out) as staging:
        for relative, path in track(files.items(), "import", len(files)):
            try:
                clips.append(_import_file(path, relative, Path(staging), chosen, fps, rest))
            except InputError as error:
                if strict or len(files) == 1:
                    raise
                source_name = relative.as_posix()
                skipped.append(Skipped(source_name, str(error).replace(str(path), source_name)))
        if not clips:
            raise InputError(f"{source}: no usable BVH file of {len(files)}; the first: {skipped[0].reason}")
        notes = dict.fromkeys(_note(clip) for clip in clips if clip.fps != clip.header_fps)
        report = ImportReport(tuple(clips), tuple(notes), tuple(skipped))
        _publish(Path(staging), out, report, Path(body).name)
    return report


def _npz(relative: Path) -> Path:
    """The clip's path below out of a source's path below its folder."""
    return relative.with_suffix(".npz")


def _check_import(files: Mapping[Path, Path], out: Path, fps: Mapping[str, float]) -> None:
    """Raise InputError for two sources of one clip, foreign clips in out, or rates for no folder."""
    npz, count = Counter(_npz(relative) for relative in files).most_common(1)[0]
    if count > 1:
        raise InputError(f"{npz.with_suffix('').as_posix()}: {count} BVH files of this name; allowed: one")
    foreign = sorted({path.relative_to(out) for path in out.rglob("*.npz")} - {_npz(path) for path in files})
    if foreign or (out.exists() and not out.is_dir()):
        wrong = f"has other clips, such as {foreign[0].as_posix()}" if foreign else "is a file"
        raise InputError(f"{out}: {wrong}; allowed: a new folder, or that of the same import")
    folders = sorted({_key(folder) for relative in files for folder in relative.parents})
    for folder, rate in fps.items():
        if folder not in folders or not _is_number(rate, *FRAME_RATE_RANGE):
            allowed = f"1 to 1000 Hz for {', '.join(map(repr, folders))} ('' is all)"
            raise InputError(f"fps: {rate!r} for {folder!r}; allowed: {allowed}")


def _key(folder: Path) -> str:
    """A folder below source as `fps` names it."""
    return "" if folder == Path() else folder.as_posix()


def _staging(out: Path) -> tempfile.TemporaryDirectory:
    """A folder beside out, in which an import grows until it is whole."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}-")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); allowed: a new folder") from error


def _import_file(
    path: Path,
    relative: Path,
    folder: Path,
    skeleton: Skeleton | None,
    fps: Mapping[str, float],
    rest: np.ndarray,
) -> Imported:
    """Write one clip below the folder."""
    bvh = read_bvh(path)
    chosen = skeleton or find_skeleton(bvh)
    rate, reason = _rate(bvh, chosen, relative, fps)
    name = relative.with_suffix("").as_posix()
    clip = retarget(bvh, chosen, rest, name=name, fps=rate)
    write_clip(folder / _npz(relative), clip)
    return Imported(
        source=relative.as_posix(),
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        clip=_npz(relative).as_posix(),
        skeleton=chosen.name,
        frames=len(clip),
        header_fps=bvh.fps,
        fps=rate,
        fps_reason=reason,
    )


def _rate(bvh: Bvh, skeleton: Skeleton, relative: Path, fps: Mapping[str, float]) -> tuple[float, str]:
    """The true frame rate and where it is from: given (the nearest folder counts), known, or the header's."""
    for folder in relative.parents:
        if _key(folder) in fps:
            return float(fps[_key(folder)]), f"given for {_key(folder) or 'all'}"
    folder_name = bvh.path.resolve().parent.name
    known = float(skeleton.rates.get(folder_name, bvh.fps))
    if known != bvh.fps:
        return known, f"known of {folder_name} in {skeleton.name}"
    return bvh.fps, HEADER


def _note(clip: Imported) -> str:
    """One line about a folder's corrected rate."""
    folder = Path(clip.source).parent.as_posix()
    return f"{folder}: {clip.fps:g} Hz, {clip.fps_reason}; the header says {clip.header_fps:g} Hz"


def _publish(staging: Path, out: Path, report: ImportReport, body: str) -> None:
    """Move the clips from staging to out, with the record; drop what an earlier import had of the skipped."""
    record = {"body": body, **asdict(report)}
    (staging / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    try:
        for name in [*(clip.clip for clip in report.clips), RECORD]:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(staging / name, out / name)
        for skipped in report.skipped:
            (out / _npz(Path(skipped.source))).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); allowed: a folder to write to"
        ) from error
