"""A trained network live: three trackers' poses in, a body's pose out, in the caller's frame of reference."""

from __future__ import annotations

import json
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.live.rotations import BodyTree, matrix_to_quaternion, sixd_to_matrix
from memmlp.live.spaces import SpaceName, space_of
from memmlp.live.tracker_input import OddSamples, TrackerPose, check_time, read_trackers
from memmlp.live.tracker_resampling import (
    TRACKERS,
    UPRIGHT,
    Features,
    Lost,
    TrackerFrames,
    heading_of,
    t_pose,
)
from memmlp.live.wearer import TILTED, Offsets, check_offsets, make_wearer
from memmlp.motion.body import FEATURES
from memmlp.runs.run import Run

if TYPE_CHECKING:
    from memmlp.evaluation.ik import LBFGS

APART = 0.1  # metres between the hands, at least, in a T-pose
FAR = 0.25  # metres; a device farther from a T-pose's joint is not attached there
ROUNDED = 5e-4  # metres by which heights may differ, as on a page that shows millimetres
FORGOTTEN = "the calibration was for another height and is forgotten"
NEEDED = ("joints", "parents", "rest", "fps", "T", "branches", "features")
AGAIN = "export it again with memmlp export RUN --out FILE.onnx"

RotationFormat = Literal["matrix", "quaternion"]


class ExportedNetwork(OnnxStream):
    """An ONNX file of scope `step`, whose steps are those of `OnnxStream`.

    Attributes:
        sparse: the input (1, 54), to be written before a step.
        rotation6d, position: outputs (22, 6) and (22, 3) of the last step, overwritten by the next.
        body: its joints, their tree and the rest pose.
        fps: frames per second.
        frames: the window's length T.
        has_position_branch: whether the network predicts positions itself.

    Raises:
        InputError: if the file is not such a network, or lacks some of its metadata.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        meta = self.session.get_modelmeta().custom_metadata_map
        if "tracker_positions" in self.inputs:
            raise InputError(f"{path}: is an ONNX file of scope full; expected one of scope step")
        if "sparse" not in self.inputs or "fps" not in meta:
            raise InputError(f"{path}: is not a network of memmlp; expected a file that memmlp export writes")
        if missing := [key for key in NEEDED if key not in meta]:
            raise InputError(f"{path}: its metadata lack {', '.join(missing)}; {AGAIN}")
        if meta["features"] != FEATURES:
            raise InputError(f"{path}: its inputs are not those of this version of memmlp; {AGAIN}")
        try:
            rest = np.array(json.loads(meta["rest"]), np.float64)
            self.body = BodyTree(json.loads(meta["joints"]), json.loads(meta["parents"]), rest)
            self.fps, self.frames = float(meta["fps"]), int(meta["T"])
            self.has_position_branch = "position" in json.loads(meta["branches"])
        except (ValueError, TypeError, LookupError):
            raise InputError(f"{path}: its metadata are damaged; {AGAIN}") from None
        if not 1 <= self.fps <= 1000:
            raise InputError(f"{path}: fps={self.fps:g} in its metadata, which are damaged; {AGAIN}")
        self.sparse = self.inputs["sparse"]
        self.rotation6d, self.position = self.outputs["rotation6d"][0], self.outputs["position"][0]


class Pose(NamedTuple):
    """A person's pose at a time, in the caller's frame of reference.

    Attributes:
        time: the frame's time, seconds of the caller's clock.
        positions: the joints (22, 3), metres, by forward kinematics of the rotations, the head on its
            tracker.
        rotations: local rotations (22, 3, 3), or quaternions xyzw (22, 4); the root's is global.
        position_branch: the joints (22, 3), metres, from the network's position branch; without one, they
            follow from its rotations.
        held: which of "head", "left", "right" are lost at this sample, and held at their last poses.
        fresh: whether this call made a new frame; if not, the pose is the last frame's.
        restarted: whether the network restarted at this frame, as it does at the first one, and after
            `reset` or a gap.
    """

    time: float
    positions: np.ndarray
    rotations: np.ndarray
    position_branch: np.ndarray
    held: tuple[str, ...]
    fresh: bool
    restarted: bool


class BodyFrame(NamedTuple):
    """The wearer's body at a time, in AMASS' conventions, with the floor at height zero.

    Attributes:
        time: seconds of the trackers' clock.
        local: rotations (22, 3, 3), relative to the parents, except for the root's, which is global.
        positions: the joints (22, 3), metres, by forward kinematics of the rotations.
        position_branch: the joints (22, 3), metres, from the position branch.
        rest: the joints in the rest pose (22, 3), metres, SMPL's body frame, at the wearer's height.
        scale: the network's body height divided by the wearer's.
        held, fresh, restarted: as in `Pose`.
    """

    time: float
    local: np.ndarray
    positions: np.ndarray
    position_branch: np.ndarray
    rest: np.ndarray
    scale: float
    held: tuple[str, ...]
    fresh: bool
    restarted: bool


ROTATION_FORMATS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "matrix": lambda matrices: matrices,
    "quaternion": matrix_to_quaternion,
}


class Stream:
    """A trained network that is fed live.

    A tracker's rotation is that of SMPL's joint (head, wrists): the turn from a T-pose, see
    `memmlp.live.spaces`. Devices that are attached in other orientations or places differ from the joints by
    constant offsets, which `calibrate` finds or `offsets` gives. `memmlp.live.tracker_resampling` describes
    other rates than 60 Hz, lost trackers and gaps.

    Args:
        source: a finished run or its folder, or an ONNX file that `memmlp export` writes (--scope step).
        space: the frame of reference of inputs and outputs: amass, openxr or unity.
        rotations: the format of the output rotations: matrix or quaternion (xyzw).
        offsets: the offsets of the joints from the devices; None for zero offsets.
        height: the wearer's body height, metres; None for the height of the network's body.
        floor: the height of the floor in the space, metres.
        ik: inverse kinematics towards the position branch (`memmlp.evaluation.ik.LBFGS()`); needs torch.

    Attributes:
        wearer: height and floor (`memmlp.live.wearer`), as `fit` sets them.
        step_seconds: the time that the exported step, the network with its features, took in the last
            `step`: the sum over all frames of the sample.
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
            raise InputError(f"rotations={rotations}: must be one of {', '.join(ROTATION_FORMATS)}")
        if not isinstance(source, Run | str | PathLike) or not str(source):
            raise InputError(f"source={source!r}: expected a run, its folder, or an ONNX file")
        run = source if isinstance(source, Run) else Run(Path(source))
        self.network = ExportedNetwork(run.preferred_onnx if run.folder.is_dir() else run.folder)
        if ik is not None and not self.network.has_position_branch:
            raise InputError(f"ik: must be None; {self.network.path} does not have a position branch")
        self.ik = ik
        self.offsets = None if offsets is None else check_offsets(offsets)
        self.wearer = make_wearer(self.network.body, height, floor)
        self.step_seconds = 0.0
        self.odd = OddSamples()
        self._output = ROTATION_FORMATS[rotations]
        self._trackers = TrackerFrames(self.network.body, self.network.fps)
        self._features = Features()
        self._sparse = self.network.sparse[0]  # the network's inputs, in place: written before each step
        self._last: BodyFrame | None = None

    @property
    def rest(self) -> np.ndarray:
        """The wearer's joints in the rest pose (22, 3), metres, SMPL's body frame."""
        return self.network.body.rest / self.wearer.scale

    def fit(self, height: float | None = None, floor: float = 0.0) -> None:
        """Set another body height (metres; None for the network's) and floor (metres), and restart.

        Offsets for another height are forgotten, with a `SampleWarning`: kept, they would hold the hands some
        centimetres away. Calibrate again, or set `offsets` after this.

        Raises:
            InputError: if height or floor are out of range.
        """
        before = self.wearer.height
        self.wearer = make_wearer(self.network.body, height, floor)
        self.reset()
        if self.offsets is not None and abs(self.wearer.height - before) > ROUNDED:
            self.offsets = None
            self.odd.report(f"offsets: {FORGOTTEN}")

    def reset(self) -> None:
        """Restart: the next sample counts as the first."""
        self._trackers.reset()
        self._restart()

    def step(
        self, head: TrackerPose, left: TrackerPose, right: TrackerPose, time: float | None = None
    ) -> Pose:
        """Take one sample of the trackers.

        Args:
            head, left, right: (position (3,) in metres, rotation (4,) xyzw or (3, 3)), or None for a lost
                tracker. A tracker is also lost with NaN in it, a quaternion of zeros, or a number above 1e6
                (1,000 km).
            time: the sample's time, seconds of any clock; None for exactly one frame after the last.

        Returns:
            The newest frame's pose.

        Raises:
            InputError: for arrays of other shapes, matrices or quaternions that are not rotations, or a time
                that is not a number of seconds.
        """
        frame, space = self.step_body(head, left, right, time), self.space
        floor = self.wearer.floor
        return Pose(
            frame.time,
            space.positions_out(raise_by(frame.positions, floor)),
            self._output(space.pose_out(frame.local)),
            space.positions_out(raise_by(frame.position_branch, floor)),
            frame.held,
            frame.fresh,
            frame.restarted,
        )

    def step_body(
        self, head: TrackerPose, left: TrackerPose, right: TrackerPose, time: float | None = None
    ) -> BodyFrame:
        """Take one sample as `step` does, and return the newest frame in AMASS' conventions."""
        check_time(time)
        positions, rotations, lost = read_trackers((head, left, right))
        if self.offsets is not None:
            positions = positions + (rotations @ self.offsets.positions[:, :, None])[..., 0]
            rotations = rotations @ self.offsets.rotations
        self.step_seconds = 0.0
        held = _names(lost)
        world = self.wearer.positions_in(self.space.positions_in(positions))
        self.odd.take(time, world, lost)
        frames, restarted = self._trackers.take(time, world, self.space.rotations_in(rotations), lost)
        if not frames:
            assert self._last is not None  # the first sample always makes a frame
            return self._last._replace(held=held, fresh=False, restarted=False)
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
        local, scale = sixd_to_matrix(self._rotations()), self.wearer.scale
        self._last = BodyFrame(
            frames[-1].time,
            local,
            (self.network.body.positions(local) + frames[-1].positions[0]) / scale,
            self.network.position / scale,
            self.rest,
            scale,
            held,
            True,
            restarted,
        )
        return self._last

    def _rotations(self) -> np.ndarray:
        """Return the last step's rotations (22, 6), after inverse kinematics if there is any."""
        sixd: np.ndarray = self.network.rotation6d
        if self.ik is None:
            return sixd
        import torch

        from memmlp.motion.network_coordinates import World
        from memmlp.motion.normalizer import Normalizer

        world = Normalizer.raw(World(), torch.tensor(self.network.body.rest))
        motion = torch.from_numpy(
            np.concatenate([sixd.reshape(1, -1), self.network.position.reshape(1, -1)], 1)
        )
        solved = self.ik.solve(world, motion, torch.from_numpy(self._sparse[None]))
        return np.asarray(solved).reshape(-1, 6)

    def calibrate(self, head: TrackerPose, left: TrackerPose, right: TrackerPose) -> Offsets:
        """Learn the offsets from a person who stands upright in T-pose, and use them from now on.

        The line from the right to the left tracker gives the person's heading, and thereby every joint's
        rotation. The joints' positions are those of the network's body in that pose, at the wearer's height,
        placed as near to the devices as possible (least squares). So a person with other proportions moves a
        body with the network's proportions. A head's device far from upright is accepted, with a
        `SampleWarning`: it may be mounted so, but quaternions of another order look like that, too.

        Args:
            head, left, right: the devices' poses, as in `step`.

        Returns:
            The offsets, which can be passed to later streams.

        Raises:
            InputError: for a lost tracker, hands that are not apart, a head that looks backwards with respect
                to the hands, or a device that is more than 25 cm from its joint in a T-pose. The offsets stay
                unchanged then.
        """
        positions, rotations, lost = read_trackers((head, left, right))
        if any(lost):
            raise InputError(f"calibrate: lost {', '.join(_names(lost))}; all three trackers are needed")
        world = self.wearer.positions_in(self.space.positions_in(positions))
        across = world[1] - world[2]
        if np.hypot(*across[:2]) < APART:
            raise InputError("calibrate: the hands are not apart; stand in T-pose, the arms to the sides")
        heading = float(np.arctan2(across[1], across[0]))
        device = self.space.rotations_in(rotations)[0]
        upright = (device @ UPRIGHT.T)[2, 2] > np.cos(TILTED)
        if upright and np.cos(heading_of(device) - heading) < 0:
            raise InputError(
                "calibrate: the head looks backwards as seen from the hands; are left and right exchanged, "
                "or is the head's device mounted backwards?"
            )
        pose = t_pose(self.network.body, world[0], heading)
        joints = pose.positions + (world - pose.positions).mean(0)
        inverse = rotations.swapaxes(1, 2)
        worn = raise_by(joints / self.wearer.scale, self.wearer.floor)
        away = self.space.positions_out(worn) - positions
        turned = inverse @ self.space.rotations_out(pose.rotations)
        offsets = Offsets((inverse @ away[:, :, None])[..., 0], turned)
        worst = int(offsets.distances.argmax())
        if offsets.distances[worst] > FAR:
            raise InputError(
                f"calibrate: {TRACKERS[worst]} is {100 * offsets.distances[worst]:.0f} cm from its joint in "
                f"a T-pose; must be at most {100 * FAR:.0f}: stand upright, arms straight to the sides, "
                "and give the body height; positions are in metres"
            )
        if offsets.doubt:
            self.odd.report(f"calibrate: {offsets.doubt}")
        self.offsets = offsets
        self.reset()
        return offsets

    def _restart(self) -> None:
        self.network.reset()
        self._features.reset()
        self._last = None


def raise_by(positions: np.ndarray, height: float) -> np.ndarray:
    """Return positions (..., 3), metres, Z up, moved up by a height."""
    raised: np.ndarray = positions + np.array([0.0, 0.0, height], positions.dtype)
    return raised


def _names(lost: Lost) -> tuple[str, ...]:
    return tuple(name for name, gone in zip(TRACKERS, lost, strict=True) if gone)
