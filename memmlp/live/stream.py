"""A trained network live: three trackers' poses in, a body's pose out, in the caller's frame of reference."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from memmlp.common.errors import InputError
from memmlp.live.exported import ExportedNetwork
from memmlp.live.rotations import matrix_to_quaternion, quaternion_to_matrix, sixd_to_matrix
from memmlp.live.sample_warnings import OddSamples, SampleWarning
from memmlp.live.spaces import SpaceName, space_of
from memmlp.live.tracker_resampling import (
    TRACKERS,
    UPRIGHT,
    Features,
    Lost,
    TrackerFrames,
    heading_of,
    t_pose,
)
from memmlp.live.wearer import wearer
from memmlp.runs.run import Run

if TYPE_CHECKING:
    from memmlp.evaluation.ik import LBFGS

IDENTITY = np.eye(3)
NOTHING = np.full((3, 12), np.nan)
NEUTRAL = np.concatenate([np.zeros(3), IDENTITY.reshape(9)])
FARTHEST = 1e6  # metres; a tracker farther from the origin is taken as lost
LATEST = 1e10  # seconds; at much later times floats can't tell frames of 1/60 s apart
TILTED = np.radians(60)  # from upright; which way a device that is tilted further looks, nobody knows
FAR = 0.25  # metres from a T-pose's joint, beyond which a device is not worn there
ROUNDED = 5e-4  # metres by which a height may be given otherwise, as a page does that shows millimetres
FORGOTTEN = "the calibration was of another height, and is forgotten"
TOLERANCE = 1e-2  # how far a quaternion's norm may be from 1, or a matrix from orthonormal

TrackerPose = tuple[ArrayLike, ArrayLike] | None
RotationFormat = Literal["matrix", "quaternion"]


class Pose(NamedTuple):
    """A person's pose at a time, in the caller's frame of reference.

    Attributes:
        time: the frame's time, seconds of the caller's clock.
        positions: the joints (22, 3), metres, by forward kinematics of the rotations, the head on its
            tracker.
        rotations: local rotations (22, 3, 3), or quaternions xyzw (22, 4); the root's is global.
        position_branch: the joints (22, 3), metres, from the network's position branch; where it has none,
            they follow from its rotations.
        held: which of "head", "left", "right" are lost at this sample, and held at their last poses.
        fresh: whether this call made a new frame; if not, the pose is the last frame's.
        restarted: whether the network began anew at this frame, as it does at the first one, and after
            `reset` or a gap.
    """

    time: float
    positions: np.ndarray
    rotations: np.ndarray
    position_branch: np.ndarray
    held: tuple[str, ...]
    fresh: bool
    restarted: bool

    @property
    def joints(self) -> np.ndarray:
        """Deprecated: the name of `position_branch` in version 0.1."""
        warnings.warn("Pose.joints is now Pose.position_branch", DeprecationWarning, stacklevel=2)
        return self.position_branch


class Offsets(NamedTuple):
    """Where the joints are on the devices: joint = device @ offset, for head, left and right wrist.

    Attributes:
        positions: (3, 3), metres, in each device's own axes.
        rotations: (3, 3, 3), in each device's own axes.
    """

    positions: np.ndarray
    rotations: np.ndarray

    @property
    def distances(self) -> np.ndarray:
        """How far each device is from its joint (3,), metres."""
        distances: np.ndarray = np.linalg.norm(self.positions, axis=1)
        return distances

    @property
    def doubt(self) -> str | None:
        """What is odd about a head's device that is far from upright, in words; None for one that is not."""
        tilt = float(np.arccos(np.clip(self.rotations[0, 1, 1], -1, 1)))  # Y is up in every space's body axes
        if tilt <= TILTED:
            return None
        return (
            f"the head's device is {np.degrees(tilt):.0f} degrees from upright; "
            "are quaternions xyzw, and is `space` right?"
        )


ROTATION_FORMATS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "matrix": lambda matrices: matrices,
    "quaternion": matrix_to_quaternion,
}


class Stream:
    """A trained network that is fed live.

    A tracker's rotation is that of SMPL's joint (head, wrists): the turn from a T-pose, see
    `memmlp.live.spaces`. Devices that are worn in other orientations or places differ from the joints by
    constant offsets, which `calibrate` finds or `offsets` gives. `memmlp.live.tracker_resampling` says what
    happens at other rates than 60 Hz, to lost trackers and after gaps.

    Args:
        source: a finished run or its folder, or an ONNX file as `memmlp export` writes it (--scope step).
        space: the frame of reference of inputs and outputs: amass, openxr or unity.
        rotations: the format of the output rotations: matrix or quaternion (xyzw).
        offsets: the offsets of the joints from the devices; None for none.
        height: the wearer's body height, metres; None for the height of the network's body.
        floor: the height of the floor in the space, metres.
        ik: inverse kinematics towards the position branch (`memmlp.evaluation.ik.LBFGS()`), which needs
            torch; None for none.

    Attributes:
        wearer: height and floor (`memmlp.live.wearer`), as `fit` sets them.
        step_seconds: how long the exported step, the network with its features, took in the last `step`:
            the sum over all frames that the sample made.
        odd: warns, once of each kind, of samples that are hardly metres or seconds (`SampleWarning`).

    Raises:
        InputError: if an argument is not one of the above; its message is one line.
    """

    def __init__(
        self,
        source: str | PathLike[str] | Run,
        *,
        space: SpaceName = "amass",
        rotations: RotationFormat = "matrix",
        offsets: Offsets | None = None,
        height: float | None = None,
        floor: float = 0.0,
        ik: LBFGS | None = None,
    ):
        self.space = space_of(space)
        if rotations not in ROTATION_FORMATS:
            raise InputError(f"rotations={rotations}: allowed: {', '.join(ROTATION_FORMATS)}")
        self.network = ExportedNetwork(_file(source))
        if ik is not None and "position" not in self.network.branches:
            raise InputError(f"ik: {self.network.path} has no position branch to fit to; allowed is ik=None")
        self.offsets = None if offsets is None else checked_offsets(offsets)
        self.wearer = wearer(self.network.body, height, floor)
        self.step_seconds = 0.0
        self.odd = OddSamples()
        self.solve = None if ik is None else Solver(ik, self.network.body.rest)
        self._output = ROTATION_FORMATS[rotations]
        self._trackers = TrackerFrames(self.network.body, self.network.fps)
        self._features = Features()
        self._sparse = self.network.sparse[0]  # the network's inputs, in place: written before each step
        self._last: Pose | None = None

    @property
    def rest(self) -> np.ndarray:
        """The wearer's joints in the rest pose (22, 3), metres, SMPL's body frame."""
        return self.network.body.rest / self.wearer.scale

    def fit(self, height: float | None = None, floor: float = 0.0) -> None:
        """Set another body height (metres; None for the network's) and floor (metres), and begin anew.

        Offsets of another height are forgotten, with a `SampleWarning`: kept, they would hold the hands some
        centimetres away. Calibrate again, or set `offsets` after this.

        Raises:
            InputError: if the height is no person's, or the floor is no height.
        """
        if self.refit(height, floor):
            warnings.warn(f"offsets: {FORGOTTEN}", SampleWarning, stacklevel=2)

    def refit(self, height: float | None, floor: float) -> bool:
        """Do as `fit` does, without the warning; return whether offsets were forgotten."""
        before = self.wearer.height
        self.wearer = wearer(self.network.body, height, floor)
        self.reset()
        if self.offsets is None or abs(self.wearer.height - before) <= ROUNDED:
            return False
        self.offsets = None
        return True

    def reset(self) -> None:
        """Begin anew: the next sample counts as the first."""
        self._trackers.reset()
        self._restart()

    def step(
        self, head: TrackerPose, left: TrackerPose, right: TrackerPose, time: float | None = None
    ) -> Pose:
        """Take in one sample of the trackers.

        Args:
            head, left, right: (position (3,) in metres, rotation (4,) xyzw or (3, 3)), or None for a lost
                tracker. A tracker is also lost with NaN in it, a quaternion of zeros, or a number above 1e6
                (1,000 km).
            time: the sample's time, seconds of any clock; None for exactly one frame after the last.

        Returns:
            The newest frame's pose.

        Raises:
            InputError: for arrays of other shapes, for numbers that are no rotation, or for a time that is no
                number of seconds.
        """
        _check_time(time)
        positions, rotations, lost = read_trackers((head, left, right))
        if self.offsets is not None:
            positions = positions + (rotations @ self.offsets.positions[:, :, None])[..., 0]
            rotations = rotations @ self.offsets.rotations
        self.step_seconds = 0.0
        world = self._positions_in(positions)
        self.odd.take(time, world, lost)
        frames, restarted = self._trackers.take(time, world, self.space.rotations_in(rotations), lost)
        if not frames:
            return self._again(lost)
        if restarted:
            self._restart()
        for frame in frames:
            first = self._features.last is None
            self._features.write(frame, self._sparse)
            began = perf_counter()
            if first:  # it has no velocity, so it is shown but kept out of the past, as in training
                self.network.peek()
            else:
                self.network.advance()
            self.step_seconds += perf_counter() - began
        self._last = self._pose(frames[-1].time, frames[-1].positions[0], _names(lost), restarted)
        return self._last

    def calibrate(self, head: TrackerPose, left: TrackerPose, right: TrackerPose) -> Offsets:
        """Learn the offsets from a person who stands upright in T-pose, and use them from now on.

        The line from the right to the left tracker tells which way the person looks, and thereby every
        joint's rotation. The joints' positions are those of the network's body in that pose, at the wearer's
        height, placed as near to the devices as possible (least squares). So a person with other proportions
        moves a body with the network's proportions. A head's device far from upright is taken, with a
        `SampleWarning`: it may be mounted so, but quaternions of another order look like that, too.

        Args:
            head, left, right: the devices' poses, as in `step`.

        Returns:
            The offsets, which can be passed to later streams.

        Raises:
            InputError: for a lost tracker, hands that are not apart, a head that looks backwards with respect
                to the hands, or a device that is more than 25 cm from where a T-pose has its joint. The
                offsets of before stay.
        """
        positions, rotations, lost = read_trackers((head, left, right))
        if any(lost):
            raise InputError(f"calibrate: no pose of {', '.join(_names(lost))}; all three are needed")
        world = self._positions_in(positions)
        across = world[1] - world[2]
        if np.hypot(*across[:2]) < 0.1:
            raise InputError("calibrate: the hands are not apart; allowed is a T-pose, the arms to the sides")
        heading = float(np.arctan2(across[1], across[0]))
        if _looks_back(self.space.rotations_in(rotations)[0], heading):
            raise InputError(
                "calibrate: the head looks backwards as seen from the hands; left and right look exchanged, "
                "or the head's device is mounted backwards; allowed is neither"
            )
        pose = t_pose(self.network.body, world[0], heading)
        joints = pose.positions + (world - pose.positions).mean(0)
        inverse = rotations.swapaxes(1, 2)
        away = self._positions_out(joints) - positions
        turned = inverse @ self.space.rotations_out(pose.rotations)
        offsets = Offsets((inverse @ away[:, :, None])[..., 0], turned)
        _check_worn(offsets)
        if offsets.doubt:
            self.odd.take_calibration(offsets.doubt)
        self.offsets = offsets
        self.reset()
        return offsets

    def _positions_in(self, positions: np.ndarray) -> np.ndarray:
        """Convert the wearer's positions (..., 3) from the caller's space to the network's world."""
        return self.wearer.positions_in(self.space.positions_in(positions))

    def _positions_out(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions (..., 3) from the network's world to the wearer's size, in the caller's space."""
        return self.space.positions_out(self.wearer.positions_out(positions))

    def _restart(self) -> None:
        self.network.reset()
        self._features.reset()
        self._last = None

    def _again(self, lost: Lost) -> Pose:
        """Return the last frame's pose again, for a sample with which no frame is due."""
        assert self._last is not None  # the first sample always makes a frame
        return self._last._replace(held=_names(lost), fresh=False, restarted=False)

    def _pose(self, time: float, head: np.ndarray, held: tuple[str, ...], restarted: bool) -> Pose:
        """Return the network's last outputs as a pose in the caller's space."""
        network, space = self.network, self.space
        sixd = network.rotation6d
        if self.solve is not None:
            sixd = self.solve(sixd, network.position, self._sparse)
        local = sixd_to_matrix(sixd)
        positions = self._positions_out(network.body.positions(local) + head)
        branch = self._positions_out(network.position)
        return Pose(time, positions, self._output(space.pose_out(local)), branch, held, True, restarted)


class Solver:
    """Inverse kinematics of one frame; this class imports torch."""

    def __init__(self, ik: LBFGS, rest: np.ndarray):
        import torch

        from memmlp.motion.network_coordinates import World
        from memmlp.motion.normalizer import Normalizer

        self.ik, self.normalizer = ik, Normalizer.raw(World(), torch.tensor(rest))

    def __call__(self, rotation6d: np.ndarray, position: np.ndarray, sparse: np.ndarray) -> np.ndarray:
        """Return rotations (22, 6) whose joints are as near as possible to positions (22, 3).

        The search starts from the given rotations (22, 6); `sparse` (54,) are the frame's inputs, which have
        the head's position.
        """
        import torch

        motion = torch.from_numpy(np.concatenate([rotation6d.reshape(1, -1), position.reshape(1, -1)], 1))
        return self.ik.solve(self.normalizer, motion, torch.from_numpy(sparse[None])).numpy().reshape(-1, 6)


def read_trackers(trackers: Sequence[TrackerPose]) -> tuple[np.ndarray, np.ndarray, Lost]:
    """Return positions (3, 3), rotations (3, 3, 3) and which trackers are lost, from a user's trackers.

    A lost tracker has the identity in place of its pose. Raises InputError if a tracker is malformed.
    """
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
    """Return the position (3,) and rotation (4,) or (3, 3) of a tracker. Raises InputError otherwise."""
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
    """Convert trackers' quaternions (4,), xyzw, to matrices (n, 3, 3).

    Zeros, which runtimes give for a lost tracker, become NaN. Raises InputError for another norm than 1.
    """
    array = np.array(list(quaternions.values()))
    norms = np.sqrt(np.einsum("ni,ni->n", array, array))
    for index, norm in zip(quaternions, norms.tolist(), strict=True):
        if abs(norm - 1) > TOLERANCE and norm != 0 and math.isfinite(norm):
            raise InputError(f"{TRACKERS[index]}: a quaternion of norm {norm:.3g}; allowed is 1 (xyzw)")
    norms[norms == 0] = np.nan
    return quaternion_to_matrix(array / norms[:, None])


def _check_rotations(names: Sequence[str], rotations: np.ndarray) -> None:
    """Raise InputError for matrices (3, 3, 3) that are no rotations: not orthonormal, or mirror images."""
    product = rotations @ rotations.swapaxes(1, 2)
    if np.abs(product - IDENTITY).max() <= TOLERANCE and np.linalg.det(rotations).min() > 0:
        return
    for name, matrix in zip(names, rotations, strict=True):
        if np.abs(matrix @ matrix.T - IDENTITY).max() > TOLERANCE:
            raise InputError(f"{name}: the matrix is not orthonormal; allowed is a rotation (3, 3)")
        if np.linalg.det(matrix) < 0:
            raise InputError(f"{name}: the matrix is a mirror image; allowed is a rotation (3, 3)")


def _check_time(time: float | None) -> None:
    """Raise InputError for anything but a time in seconds or None."""
    if time is None:
        return
    if not isinstance(time, (int, float, np.integer, np.floating)) or not abs(time) <= LATEST:
        raise InputError(
            f"time={time}: allowed is a number of seconds, at most {LATEST:g}, or None for one frame"
        )


def _looks_back(head: np.ndarray, heading: float) -> bool:
    """Return whether a head's device (3, 3), in AMASS' world, looks more than 90 degrees away from a heading.

    The heading is in radians. The answer is False for a device far from upright, which is no headset.
    """
    upright = (head @ UPRIGHT.T)[2, 2] > np.cos(TILTED)
    return bool(upright and np.cos(heading_of(head) - heading) < 0)


def _check_worn(offsets: Offsets) -> None:
    """Raise InputError if a device is farther from its joint than it can be on a person in T-pose."""
    worst = int(offsets.distances.argmax())
    if offsets.distances[worst] > FAR:
        raise InputError(
            f"calibrate: {TRACKERS[worst]} is {100 * offsets.distances[worst]:.0f} cm from where a T-pose "
            f"has it; allowed are {100 * FAR:.0f}: stand upright, arms straight to the sides, and give the "
            "body height; positions are in metres"
        )


def checked_offsets(offsets: Offsets) -> Offsets:
    """Return the offsets as float64 arrays. Raises InputError if they are malformed."""
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
    """Return the names of the lost trackers."""
    return tuple(name for name, gone in zip(TRACKERS, lost, strict=True) if gone)


def _file(source: str | PathLike[str] | Run) -> Path:
    """Return the ONNX file of a run or of its folder; an ONNX file is returned as it is."""
    if not isinstance(source, Run | str | PathLike) or not str(source):
        raise InputError(f"source={source!r}: allowed are a run, its folder, or an ONNX file")
    run = source if isinstance(source, Run) else Run(Path(source))
    return run.preferred_onnx if run.folder.is_dir() else run.folder
