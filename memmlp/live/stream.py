"""Live use of a trained network: poses of three trackers in, body poses out, in the caller's axes."""

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
from memmlp.live.spaces import SpaceName, find_space
from memmlp.live.tracker_input import OddSamples, TrackerPose, TrackerReader, check_time
from memmlp.live.tracker_resampling import (
    TRACKERS,
    UPRIGHT,
    FeatureWriter,
    Lost,
    TrackerFrames,
    compute_heading,
    make_t_pose,
)
from memmlp.live.wearer import TILTED, Offsets, check_offsets, make_wearer
from memmlp.motion.body import FEATURES
from memmlp.runs.lookup import find_shipped, list_shipped
from memmlp.runs.run import Run

if TYPE_CHECKING:
    from memmlp.evaluation.ik import LBFGS

APART = 0.1  # minimum distance between the hands in a T-pose, metres
FAR = 0.25  # maximum distance of a device from its joint in a T-pose, metres
ROUNDED = 5e-4  # metres; heights with a smaller difference are equal, since the page rounds to millimetres
FORGOTTEN = "the calibration was for another height and was removed"
NEEDED = ("rest", "fps", "T", "branches", "features")
AGAIN = "export it again with memmlp export RUN --out FILE.onnx"

RotationFormat = Literal["matrix", "quaternion"]


class ExportedNetwork(OnnxStream):
    """An exported network with scope `step`, and its metadata. `OnnxStream` runs the steps. `sparse` is the
    input (1, 54); `rotation6d` (22, 6) and `position` (22, 3) are the outputs, which the next step
    overwrites. `frames` is the window's length T. Raises InputError if the file is not an exported network
    with scope `step`, or its metadata are incomplete."""

    def __init__(self, path: Path):
        super().__init__(path)
        meta = self.session.get_modelmeta().custom_metadata_map
        if "tracker_positions" in self.inputs:
            raise InputError(f"{path}: has scope full; expected an ONNX file with scope step")
        if "sparse" not in self.inputs or "fps" not in meta:
            raise InputError(f"{path}: is not a memmlp network; expected a file from memmlp export")
        if missing := [key for key in NEEDED if key not in meta]:
            raise InputError(f"{path}: metadata are missing: {', '.join(missing)}; {AGAIN}")
        if meta["features"] != FEATURES:
            raise InputError(f"{path}: has inputs of another memmlp version; {AGAIN}")
        try:
            self.body = BodyTree(np.array(json.loads(meta["rest"]), np.float64))
            self.fps, self.frames = float(meta["fps"]), int(meta["T"])
            self.has_position_branch = "position" in json.loads(meta["branches"])
        except (ValueError, TypeError, LookupError):
            raise InputError(f"{path}: has damaged metadata; {AGAIN}") from None
        if not 1 <= self.fps <= 1000:
            raise InputError(f"{path}: has damaged metadata (fps={self.fps:g}); {AGAIN}")
        self.sparse = self.inputs["sparse"]
        self.rotation6d, self.position = self.outputs["rotation6d"][0], self.outputs["position"][0]


class Pose(NamedTuple):
    """The pose of a person at one time, in the caller's frame of reference.

    Attributes:
        time: the frame's time, seconds of the caller's clock.
        positions: joints (22, 3), metres, by forward kinematics of the rotations, with the head on its
            tracker.
        rotations: local rotations (22, 3, 3), or quaternions xyzw (22, 4); the root rotation is global.
        position_branch: joints (22, 3), metres, from the network's position branch. Networks without this
            branch use forward kinematics.
        held: the lost trackers of this sample ("head", "left", "right"). They are held at their last poses.
        fresh: whether this call produced a new frame. If False, the pose is from the previous frame.
        restarted: whether the network restarted at this frame: at the first frame, and after `reset` or a
            gap.
    """

    time: float
    positions: np.ndarray
    rotations: np.ndarray
    position_branch: np.ndarray
    held: tuple[str, ...]
    fresh: bool
    restarted: bool


class BodyFrame(NamedTuple):
    """The user's body at one time, in AMASS' conventions, with the floor at height zero; see `Pose`."""

    time: float
    local: np.ndarray  # local rotations (22, 3, 3); the root rotation is global
    positions: np.ndarray
    position_branch: np.ndarray
    rest: np.ndarray  # rest joints (22, 3), metres, SMPL's body frame, scaled to the user's height
    scale: float  # the network's body height divided by the user's
    held: tuple[str, ...]
    fresh: bool
    restarted: bool


ROTATION_FORMATS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "matrix": lambda matrices: matrices,
    "quaternion": matrix_to_quaternion,
}


class Stream:
    """A trained network that runs on live trackers.

    A tracker gives the pose of an SMPL joint (head or wrist). Its rotation is relative to a T-pose; see
    `memmlp.live.spaces`. Real devices have constant offsets from these joints. `calibrate` measures the
    offsets, or the argument `offsets` sets them. `memmlp.live.tracker_resampling` describes the handling of
    other rates than 60 Hz, of lost trackers and of gaps.

    Args:
        source: the name of a shipped network (`memmlp models`), a finished run, its folder, or an ONNX file
            from `memmlp export --scope step`.
        space: frame of reference of inputs and outputs: amass, openxr or unity.
        rotations: format of the output rotations: matrix or quaternion (xyzw).
        offsets: offsets from the devices to the joints; None for zero offsets.
        height: the user's body height, metres; None for the height of the network's body.
        floor: height of the floor in the space, metres.
        ik: inverse kinematics towards the position branch (`memmlp.evaluation.ik.LBFGS()`); needs torch.

    Attributes:
        wearer: the user's height and floor (`memmlp.live.wearer`). `fit` changes them.
        step_seconds: computation time of the network in the last `step`, summed over the sample's frames.
        odd: warns about implausible units and times (`SampleWarning`), once per kind.
        reader: reads the trackers, and finds the lost ones.

    Raises:
        InputError: if an argument is invalid.
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
        self.space = find_space(space)
        if rotations not in ROTATION_FORMATS:
            raise InputError(f"rotations={rotations}: must be one of {', '.join(ROTATION_FORMATS)}")
        if not isinstance(source, Run | str | PathLike) or not str(source):
            raise InputError(f"source={source!r}: must be a run, its folder, an ONNX file or a shipped name")
        run = source if isinstance(source, Run) else Run(Path(source))
        if not run.folder.exists():
            run = find_shipped(str(source)) or run
        if not run.folder.exists():
            names = ", ".join(list_shipped())
            raise InputError(f"source={source}: must be a run's folder, an ONNX file, or one of {names}")
        self.network = ExportedNetwork(run.preferred_onnx if run.folder.is_dir() else run.folder)
        if ik is not None and not self.network.has_position_branch:
            raise InputError(f"ik: must be None; {self.network.path} does not have a position branch")
        self.ik = ik
        self.offsets = None if offsets is None else check_offsets(offsets)
        self.wearer = make_wearer(self.network.body, height, floor)
        self.step_seconds = 0.0
        self.odd = OddSamples()
        self._output = ROTATION_FORMATS[rotations]
        self.reader = TrackerReader(self.network.fps)
        self._trackers = TrackerFrames(self.network.body, self.network.fps)
        self._features = FeatureWriter()
        self._sparse = self.network.sparse[0]  # the network's input array; written before each step
        self._last: BodyFrame | None = None

    def __repr__(self) -> str:
        height = self.wearer.height
        return f"Stream({str(self.network.path)!r}, {self.network.fps:g} Hz, height {height:.2f} m)"

    @property
    def rest(self) -> np.ndarray:
        """The rest joints (22, 3) at the user's height, metres, SMPL's body frame."""
        return self.network.body.rest / self.wearer.scale

    def fit(self, height: float | None = None, floor: float = 0.0) -> None:
        """Set the body height (metres; None for the network's height) and the floor (metres), and restart. A
        new height removes the offsets and causes a `SampleWarning`, because they would move the hands by some
        centimetres. Calibrate again, or set `offsets` after this call. Raises InputError if height or floor
        is out of range."""
        before = self.wearer.height
        self.wearer = make_wearer(self.network.body, height, floor)
        self.reset()
        if self.offsets is not None and abs(self.wearer.height - before) > ROUNDED:
            self.offsets = None
            self.odd.report(f"offsets: {FORGOTTEN}")

    def reset(self) -> None:
        """Restart the stream. The next sample counts as the first sample."""
        self.reader = TrackerReader(self.network.fps)
        self._trackers.reset()
        self._restart()

    def step(
        self, head: TrackerPose, left: TrackerPose, right: TrackerPose, time: float | None = None
    ) -> Pose:
        """Process one sample of the trackers.

        Args:
            head, left, right: (position (3,) in metres, rotation (4,) xyzw or (3, 3)), or None for a lost
                tracker. A tracker also counts as lost with NaN, numbers above 1e6, a position of zeros, a
                rotation of zeros, or the same pose for half a second while another tracker moves.
            time: the sample's time, seconds of any clock; None for one frame after the previous sample.

        Returns:
            The pose of the newest frame.

        Raises:
            InputError: for arrays with another shape, an invalid rotation or an invalid time.
        """
        frame, space = self.step_body(head, left, right, time), self.space
        floor = self.wearer.floor
        return Pose(
            frame.time,
            space.convert_positions_from_amass(move_up(frame.positions, floor)),
            self._output(space.convert_pose_from_amass(frame.local)),
            space.convert_positions_from_amass(move_up(frame.position_branch, floor)),
            frame.held,
            frame.fresh,
            frame.restarted,
        )

    def step_body(
        self, head: TrackerPose, left: TrackerPose, right: TrackerPose, time: float | None = None
    ) -> BodyFrame:
        """Process one sample like `step`, and return the newest frame in AMASS' conventions."""
        check_time(time)
        positions, rotations, lost = self.reader.take((head, left, right), time)
        if self.offsets is not None:
            positions = positions + (rotations @ self.offsets.positions[:, :, None])[..., 0]
            rotations = rotations @ self.offsets.rotations
        self.step_seconds = 0.0
        held = _list_lost(lost)
        world = self.wearer.scale_to_network(self.space.convert_positions_to_amass(positions))
        self.odd.take(time, world, lost)
        turned = self.space.convert_rotations_to_amass(rotations)
        frames, restarted = self._trackers.take(time, world, turned, lost)
        if not frames:
            assert self._last is not None  # the first sample always makes a frame
            return self._last._replace(held=held, fresh=False, restarted=False)
        if restarted:
            self._restart()
        for frame in frames:
            first = self._features.last is None
            self._features.write(frame, self._sparse)
            began = perf_counter()
            if first:  # without velocities, it gives a pose but does not change the state, like in training
                self.network.peek()
            else:
                self.network.advance()
            self.step_seconds += perf_counter() - began
        local, scale = sixd_to_matrix(self._compute_rotations()), self.wearer.scale
        self._last = BodyFrame(
            frames[-1].time,
            local,
            (self.network.body.compute_positions(local) + frames[-1].positions[0]) / scale,
            self.network.position / scale,
            self.rest,
            scale,
            held,
            True,
            restarted,
        )
        return self._last

    def _compute_rotations(self) -> np.ndarray:
        """Return the rotations (22, 6) of the last step, after inverse kinematics if `ik` is set."""
        sixd: np.ndarray = self.network.rotation6d
        if self.ik is None:
            return sixd
        import torch

        from memmlp.motion.network_coordinates import World
        from memmlp.motion.normalizer import Normalizer

        world = Normalizer.from_coordinates(World(), torch.tensor(self.network.body.rest))
        motion = np.concatenate([sixd.reshape(1, -1), self.network.position.reshape(1, -1)], 1)
        solved = self.ik.solve(world, *map(torch.from_numpy, (motion, self._sparse[None])))
        return np.asarray(solved).reshape(-1, 6)

    def calibrate(self, head: TrackerPose, left: TrackerPose, right: TrackerPose) -> Offsets:
        """Measure the offsets of a person who stands upright in a T-pose, and use them in this stream.

        The line from the right to the left tracker gives the person's heading, and so the rotation of each
        joint. The joint positions come from the network's body in this pose, scaled to the user's height.
        They are fitted to the devices by least squares. So a person with other proportions moves a body with
        the network's proportions. If the head's device is far from upright, there is a `SampleWarning`.
        Either the device is mounted with this tilt, or the quaternions are not xyzw.

        Args:
            head, left, right: the poses of the devices, see `step`.

        Returns:
            The offsets, which can be passed to later streams.

        Raises:
            InputError: for a lost tracker, hands close together, a head that looks backwards relative to the
                hands, or a device more than 25 cm from its joint in a T-pose. The stream keeps its old
                offsets.
        """
        positions, rotations, lost = self.reader.read((head, left, right))
        if any(lost):
            raise InputError(f"calibrate: needs all three trackers; lost: {', '.join(_list_lost(lost))}")
        world = self.wearer.scale_to_network(self.space.convert_positions_to_amass(positions))
        across = world[1] - world[2]
        if np.hypot(*across[:2]) < APART:
            raise InputError("calibrate: the hands are not apart; stand in a T-pose, arms to the sides")
        heading = float(np.arctan2(across[1], across[0]))
        device = self.space.convert_rotations_to_amass(rotations)[0]
        upright = (device @ UPRIGHT.T)[2, 2] > np.cos(TILTED)
        if upright and np.cos(compute_heading(device) - heading) < 0:
            raise InputError(
                "calibrate: the head looks backwards relative to the hands; check that left and right are "
                "not exchanged, and that the head's device is not mounted backwards"
            )
        pose = make_t_pose(self.network.body, world[0], heading)
        joints = pose.positions + (world - pose.positions).mean(0)
        inverse = rotations.swapaxes(1, 2)
        target = move_up(joints / self.wearer.scale, self.wearer.floor)
        away = self.space.convert_positions_from_amass(target) - positions
        turned = inverse @ self.space.convert_rotations_from_amass(pose.rotations)
        offsets = Offsets((inverse @ away[:, :, None])[..., 0], turned)
        worst = int(offsets.distances.argmax())
        if offsets.distances[worst] > FAR:
            raise InputError(
                f"calibrate: {TRACKERS[worst]} is {100 * offsets.distances[worst]:.0f} cm from its joint in "
                f"a T-pose; must be at most {100 * FAR:.0f} cm. Stand upright with straight arms to the "
                "sides, and check the body height and that positions are in metres"
            )
        if offsets.tilt_warning:
            self.odd.report(f"calibrate: {offsets.tilt_warning}")
        self.offsets = offsets
        self.reset()
        return offsets

    def _restart(self) -> None:
        self.network.reset()
        self._features = FeatureWriter()
        self._last = None


def move_up(positions: np.ndarray, height: float) -> np.ndarray:
    """Return positions (..., 3), metres, Z up, moved up by `height`."""
    raised: np.ndarray = positions + np.array([0.0, 0.0, height], positions.dtype)
    return raised


def _list_lost(lost: Lost) -> tuple[str, ...]:
    return tuple(name for name, gone in zip(TRACKERS, lost, strict=True) if gone)
