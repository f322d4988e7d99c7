"""A trained network live: three trackers' poses in, a body's out, in the caller's frame of reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from memmlp.common.errors import InputError
from memmlp.live.exported import ExportedNetwork
from memmlp.live.rotations import matrix_to_quaternion, quaternion_to_matrix, sixd_to_matrix
from memmlp.live.spaces import SpaceName, space_of
from memmlp.live.trackers import Features, Lost, Trackers, t_pose
from memmlp.runs.run import Run

if TYPE_CHECKING:
    from memmlp.evaluation.ik import LBFGS

TRACKERS = ("head", "left", "right")
IDENTITY = np.eye(3)
NOTHING = np.full((3, 12), np.nan)
NEUTRAL = np.concatenate([np.zeros(3), IDENTITY.reshape(9)])
FARTHEST = 1e6  # metres
LATEST = 1e10  # seconds; at much more frames of 1/60 s can't be told apart
UNIT = 1e-2  # by how much a quaternion's norm, or a matrix' columns, may be off

Tracker = tuple[ArrayLike, ArrayLike] | None
RotationFormat = Literal["matrix", "quaternion"]


class Pose(NamedTuple):
    """A person at a time, in the caller's frame of reference.

    Attributes:
        time: of the frame, seconds of the caller's clock.
        positions: of the joints (22, 3), metres: forward kinematics of the rotations, head on its tracker.
        rotations: local rotations (22, 3, 3), or quaternions xyzw (22, 4); the root's is global.
        joints: (22, 3), metres, from the network's position branch; where it has none, they follow from its
            rotations.
        held: which of "head", "left", "right" are lost at this sample, and held.
        fresh: whether this call made a frame; if not, the pose is the last frame's.
        restarted: whether the network began anew at this frame: the first, and those after `reset` or a gap.
    """

    time: float
    positions: np.ndarray
    rotations: np.ndarray
    joints: np.ndarray
    held: tuple[str, ...]
    fresh: bool
    restarted: bool


class Offsets(NamedTuple):
    """Where the joints are on the devices, in the axes of the caller's space: joint = device @ offset.

    Attributes:
        positions: (3, 3) metres in the devices' axes. rotations: (3, 3, 3). Head, left and right wrist.
    """

    positions: np.ndarray
    rotations: np.ndarray


OUTPUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "matrix": lambda matrices: matrices,
    "quaternion": matrix_to_quaternion,
}


class Stream:
    """A trained network, fed live.

    A tracker's rotation is that of SMPL's joint (head, wrists): the turn from a T-pose, see
    `memmlp.live.spaces`. Devices that sit otherwise on the body differ by a constant offset, which
    `calibrate` finds or `offsets` gives. What happens at other rates than 60 Hz, to lost trackers and in gaps
    is said in `memmlp.live.trackers`.

    Args:
        source: a finished run or its folder, or an ONNX file as `memmlp export` writes it (--scope network).
        space: frame of reference of what goes in and comes out: amass, openxr or unity.
        rotations: how they come out: matrix or quaternion (xyzw).
        offsets: of the joints from the devices; none by default.
        ik: inverse kinematics towards the position branch (`memmlp.evaluation.ik.LBFGS()`); needs torch.

    Raises:
        InputError: for anything else in these, in one line.
    """

    def __init__(
        self,
        source: str | PathLike[str] | Run,
        *,
        space: SpaceName = "amass",
        rotations: RotationFormat = "matrix",
        offsets: Offsets | None = None,
        ik: LBFGS | None = None,
    ):
        self.space = space_of(space)
        if rotations not in OUTPUTS:
            raise InputError(f"rotations={rotations}: allowed: {', '.join(OUTPUTS)}")
        self.network = ExportedNetwork(_file(source))
        if ik is not None and "position" not in self.network.branches:
            raise InputError(f"ik: {self.network.path} has no position branch to fit to; allowed is ik=None")
        self.offsets = None if offsets is None else checked_offsets(offsets)
        self.solve = None if ik is None else Solver(ik, self.network.skeleton.rest)
        self._output = OUTPUTS[rotations]
        self._trackers = Trackers(self.network.skeleton, self.network.fps)
        self._features = Features()
        self._sparse = self.network.sparse[0]
        self._last: Pose | None = None

    def reset(self) -> None:
        """A fresh start: the next sample is the first."""
        self._trackers.reset()
        self._restart()

    def step(self, head: Tracker, left: Tracker, right: Tracker, time: float | None = None) -> Pose:
        """Take one sample of the trackers in.

        Args:
            head, left, right: (position (3,) in metres, rotation (4,) xyzw or (3, 3)), or None for a lost
                tracker; so is one with NaN in it, with a quaternion of zeros, or more than 1,000 km away.
            time: of the sample, seconds of any clock; None for exactly one frame after the last.

        Returns:
            The newest frame's pose.

        Raises:
            InputError: for other shapes, what is no rotation, a time that is no number of seconds.
        """
        _check_time(time)
        positions, rotations, lost = read_trackers((head, left, right))
        if self.offsets is not None:
            positions = positions + (rotations @ self.offsets.positions[:, :, None])[..., 0]
            rotations = rotations @ self.offsets.rotations
        space = self.space
        frames, restarted = self._trackers.take(
            time, space.positions_in(positions), space.rotations_in(rotations), lost
        )
        if not frames:
            return self._again(lost)
        if restarted:
            self._restart()
        for frame in frames:
            first = self._features.last is None
            self._features.write(frame, self._sparse)
            if first:  # it has no velocity: shown, but not part of the network's past, as in its training
                self.network.peek()
            else:
                self.network.advance()
        self._last = self._pose(frames[-1].time, frames[-1].positions[0], _names(lost), restarted)
        return self._last

    def calibrate(self, head: Tracker, left: Tracker, right: Tracker) -> Offsets:
        """Learn the joints' offsets from a person who stands upright in T-pose, and use them from now on.

        The person's left is where the left tracker is from the right one; every joint's rotation is then
        known. The joints' positions are those of the network's body in that pose, where the devices are
        nearest (least squares), so that a person of other proportions moves a body of the network's.

        Returns:
            The offsets, to be given to later streams.

        Raises:
            InputError: for a lost tracker, or hands that are not apart.
        """
        positions, rotations, lost = read_trackers((head, left, right))
        if any(lost):
            raise InputError(f"calibrate: no pose of {', '.join(_names(lost))}; all three are needed")
        world = self.space.positions_in(positions)
        across = world[1] - world[2]
        if np.hypot(*across[:2]) < 0.1:
            raise InputError("calibrate: the hands are not apart; allowed is a T-pose, the arms to the sides")
        pose = t_pose(self.network.skeleton, world[0], float(np.arctan2(across[1], across[0])))
        joints = pose.positions + (world - pose.positions).mean(0)
        inverse = rotations.swapaxes(1, 2)
        away = self.space.positions_out(joints) - positions
        turned = inverse @ self.space.rotations_out(pose.rotations)
        self.offsets = Offsets((inverse @ away[:, :, None])[..., 0], turned)
        self.reset()
        return self.offsets

    def _restart(self) -> None:
        self.network.reset()
        self._features.reset()
        self._last = None

    def _again(self, lost: Lost) -> Pose:
        """The last frame's pose, where none was due."""
        assert self._last is not None  # the first sample always makes a frame
        return self._last._replace(held=_names(lost), fresh=False, restarted=False)

    def _pose(self, time: float, head: np.ndarray, held: tuple[str, ...], restarted: bool) -> Pose:
        """The network's last outputs as a pose of the caller's space."""
        network, space = self.network, self.space
        sixd = network.rotation6d
        if self.solve is not None:
            sixd = self.solve(sixd, network.position, self._sparse)
        local = sixd_to_matrix(sixd)
        positions = space.positions_out(network.skeleton.positions(local) + head)
        joints = space.positions_out(network.position)
        return Pose(time, positions, self._output(space.pose_out(local)), joints, held, True, restarted)


class Solver:
    """Inverse kinematics of one frame; imports torch."""

    def __init__(self, ik: LBFGS, rest: np.ndarray):
        import torch

        from memmlp.motion.coordinates import World
        from memmlp.motion.normalizer import Normalizer

        self.ik, self.normalizer = ik, Normalizer.raw(World(), torch.tensor(rest))

    def __call__(self, rotation6d: np.ndarray, position: np.ndarray, sparse: np.ndarray) -> np.ndarray:
        """Rotations (22, 6) nearest to positions (22, 3), from rotations (22, 6), at inputs (54,)."""
        import torch

        motion = torch.from_numpy(np.concatenate([rotation6d.reshape(1, -1), position.reshape(1, -1)], 1))
        return self.ik.solve(self.normalizer, motion, torch.from_numpy(sparse[None])).numpy().reshape(-1, 6)


def read_trackers(trackers: Sequence[Tracker]) -> tuple[np.ndarray, np.ndarray, Lost]:
    """Positions (3, 3), rotations (3, 3, 3) and which are lost, of trackers as users give them."""
    read, quaternions = NOTHING.copy(), {}
    for index, (name, tracker) in enumerate(zip(TRACKERS, trackers, strict=True)):
        if tracker is not None:
            read[index, :3], rotation = _arrays(name, tracker)
            if rotation.shape == (4,):
                quaternions[index] = rotation
            else:
                read[index, 3:] = rotation.reshape(9)
    if quaternions:
        read[list(quaternions), 3:] = _matrices(quaternions).reshape(-1, 9)
    lost = tuple((~(np.abs(read) <= FARTHEST).all(1)).tolist())
    if any(lost):
        read[list(lost)] = NEUTRAL
    positions, rotations = read[:, :3], read[:, 3:].reshape(3, 3, 3)
    _check_rotations(TRACKERS, rotations)
    return positions, rotations, lost


def _arrays(name: str, tracker: tuple[ArrayLike, ArrayLike]) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and rotation (4,) or (3, 3) of a tracker."""
    try:
        position, rotation = (np.asarray(part, np.float64) for part in tracker)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: allowed is (position, rotation), arrays of numbers, or None") from error
    if position.shape != (3,):
        raise InputError(f"{name}: a position of shape {position.shape}; allowed is (3,), metres")
    if rotation.shape not in ((4,), (3, 3)):
        raise InputError(f"{name}: a rotation of shape {rotation.shape}; allowed is (4,) xyzw or (3, 3)")
    return position, rotation


def _matrices(quaternions: dict[int, np.ndarray]) -> np.ndarray:
    """Quaternions (4,) xyzw of trackers as matrices (n, 3, 3); NaN for zeros, as runtimes give if lost."""
    array = np.array(list(quaternions.values()))
    norms = np.sqrt(np.einsum("ni,ni->n", array, array))
    for index, norm in zip(quaternions, norms.tolist(), strict=True):
        if abs(norm - 1) > UNIT and norm != 0 and math.isfinite(norm):
            raise InputError(f"{TRACKERS[index]}: a quaternion of norm {norm:.3g}; allowed is 1 (xyzw)")
    norms[norms == 0] = np.nan
    return quaternion_to_matrix(array / norms[:, None])


def _check_rotations(names: Sequence[str], rotations: np.ndarray) -> None:
    """Refuse matrices (3, 3, 3) that are no rotations: not orthonormal, or mirror images."""
    product = rotations @ rotations.swapaxes(1, 2)
    if np.abs(product - IDENTITY).max() <= UNIT and np.linalg.det(rotations).min() > 0:
        return
    for name, matrix in zip(names, rotations, strict=True):
        if np.abs(matrix @ matrix.T - IDENTITY).max() > UNIT:
            raise InputError(f"{name}: the matrix is not orthonormal; allowed is a rotation (3, 3)")
        if np.linalg.det(matrix) < 0:
            raise InputError(f"{name}: the matrix is a mirror image; allowed is a rotation (3, 3)")


def _check_time(time: float | None) -> None:
    """Refuse what is no time."""
    if time is None:
        return
    if not isinstance(time, (int, float, np.integer, np.floating)) or not abs(time) <= LATEST:
        raise InputError(
            f"time={time}: allowed is a number of seconds, at most {LATEST:g}, or None for one frame"
        )


def checked_offsets(offsets: Offsets) -> Offsets:
    """Offsets as float64 arrays. Raises InputError where they are none."""
    try:
        positions, rotations = (np.asarray(part, np.float64) for part in offsets)
    except (TypeError, ValueError):
        raise InputError(
            "offsets: allowed are memmlp.Offsets, positions (3, 3) and rotations (3, 3, 3)"
        ) from None
    if positions.shape != (3, 3) or rotations.shape != (3, 3, 3):
        shapes = f"{positions.shape} and {rotations.shape}"
        raise InputError(f"offsets: shapes {shapes}; allowed are positions (3, 3) and rotations (3, 3, 3)")
    if not (np.isfinite(positions).all() and np.isfinite(rotations).all()):
        raise InputError("offsets: NaN or infinity; allowed are numbers")
    _check_rotations([f"offsets of {name}" for name in TRACKERS], rotations)
    return Offsets(positions, rotations)


def _names(lost: Lost) -> tuple[str, ...]:
    """The names of the trackers that are lost."""
    return tuple(name for name, gone in zip(TRACKERS, lost, strict=True) if gone)


def _file(source: str | PathLike[str] | Run) -> Path:
    """The ONNX file of a run, of its folder, or itself."""
    if not isinstance(source, Run | str | PathLike) or not str(source):
        raise InputError(f"source={source!r}: allowed are a run, its folder, or an ONNX file")
    run = source if isinstance(source, Run) else Run(Path(source))
    return run.deployed if run.folder.is_dir() else run.folder
