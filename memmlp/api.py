"""Functions for scripts and notebooks: open and compare finished runs, predict, draw and stream.

The package exports these names, such as `memmlp.load_run`. Runs and results are read without torch, which is
imported when a network is used.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, overload

import numpy as np

from memmlp.common.errors import InputError
from memmlp.evaluation.metric_facts import UNITS
from memmlp.live.stream import Stream
from memmlp.live.wearer import Offsets
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.runs.evaluation_file import COMBINED
from memmlp.runs.lookup import check_trained, find_run, is_trained, list_runs
from memmlp.runs.run import Run

if TYPE_CHECKING:
    import pandas as pd

    from memmlp.config.open_run import OpenedRun
    from memmlp.evaluation.ik import LBFGS
    from memmlp.live.spaces import SpaceName
    from memmlp.live.stream import RotationFormat
    from memmlp.networks.motion_model import MotionModel
    from memmlp.report.pictures.clip_pictures import ClipPiece

StrPath = str | os.PathLike[str]
Mode = Literal["stream", "window"]
Branch = Literal["rotation", "position"]

COLUMNS = ("run", "seed", "mode", "branch", "combined_by", "clip", "group", "frames", *UNITS)


def load_run(name: StrPath, outputs: StrPath | None = None, *, plugins: Sequence[str] = ()) -> TrainedRun:
    """Open the finished run of a motion network.

    Args:
        name: the run's id, the beginning of its id, its folder, or the name of a shipped network.
        outputs: the folder of runs; by default $MEMMLP_OUTPUTS or "outputs", like on the command line.
        plugins: packages with custom components; their code is imported. Installed packages with an entry
            point are used without this argument. A run's record never causes an import.

    Raises:
        InputError: if no run or several runs have this name, the run is not finished, or a package can't be
            imported.
    """
    _use(plugins)
    run = find_run(_find_outputs(outputs), os.fspath(name))
    check_trained(run)
    return TrainedRun(run)


class Runs(Sequence["TrainedRun"]):
    """The finished runs of motion networks below an outputs folder, the newest first.

    Runs that finish later are not included. A slice is a `Runs` object, too.

    Args:
        outputs: the folder of runs; by default $MEMMLP_OUTPUTS or "outputs", like on the command line.
        plugins: packages with custom components; see `load_run`.

    Raises:
        InputError: if `outputs` has no folder of runs, or a package can't be imported.
    """

    def __init__(self, outputs: StrPath | None = None, *, plugins: Sequence[str] = ()):
        _use(plugins)
        folder = _find_outputs(outputs)
        if not (folder / "runs").is_dir():
            raise InputError(f"outputs {folder}: has no folder runs; expected an outputs folder")
        self._runs = [TrainedRun(run) for run in list_runs(folder) if is_trained(run)]

    @overload
    def __getitem__(self, index: int) -> TrainedRun: ...

    @overload
    def __getitem__(self, index: slice) -> Runs: ...

    def __getitem__(self, index: int | slice) -> TrainedRun | Runs:
        """Return a run by its index, or the runs in a slice."""
        if isinstance(index, slice):
            part = object.__new__(Runs)
            part._runs = self._runs[index]
            return part
        return self._runs[index]

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self._runs)

    def __repr__(self) -> str:
        return f"Runs({self._runs})"

    def per_clip(self) -> pd.DataFrame:
        """Return the rows of all runs in one DataFrame (`TrainedRun.per_clip`)."""
        return _make_frame(row for run in self._runs for row in run._list_rows())


class TrainedRun(os.PathLike[str]):
    """A finished run of a motion network, with its config, its results and its network.

    `load_run` and `Runs` make these objects. Config and results need only the run's folder. `clips`, `model`
    and `predict` also need the run's data. Relative paths in the config start at the current folder, like in
    training.

    Attributes:
        id: 16 hex digits.
        folder: the run's folder, an absolute path.
    """

    def __init__(self, run: Run):
        self._run = Run(run.folder.resolve())
        self.id: str = self._run.id
        self.folder: Path = self._run.folder

    def __fspath__(self) -> str:
        """Return the folder, so that a run can be used wherever a path is expected."""
        return str(self.folder)

    def __repr__(self) -> str:
        return f"TrainedRun({self.id!r})"

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved config, a dict of dicts."""
        return self._run.config

    @property
    def seed(self) -> int:
        """The seed of the run's training."""
        return int(self.config["seed"])

    @property
    def results(self) -> dict[str, dict[str, dict[str, float]]]:
        """The mean results over the test clips: mode -> branch -> metric, in the units of `per_clip`.

        The branch "combined" has errors after inverse kinematics. If several kinds were evaluated, it has
        the kind in the run's config, or else the last kind. `combined_by` names the kind.

        Raises InputError if a result file is damaged.
        """
        return {
            mode: {branch: _convert_to_numbers(errors) for branch, errors in branches.items()}
            for mode, branches in sorted(load_measured_run(self.folder).means.items())
        }

    @property
    def combined_by(self) -> dict[str, str | None]:
        """The kind of inverse kinematics in the branch "combined", by mode, such as "arms" or "lbfgs-15".

        An unknown kind is None. Raises InputError if a result file is damaged.
        """
        return self._run.configured_evaluations.combined_solvers

    def per_clip(self) -> pd.DataFrame:
        """Return a DataFrame with one row for each mode, branch and test clip.

        The columns are run, seed, mode, branch, combined_by (the kind of inverse kinematics; None for other
        branches), clip, group (clips of the same take or subject share a group), the number of frames at
        60 Hz, and the metrics. Their units are in `.attrs["units"]`: MPJRE and geodesic in degrees (NaN in
        the position branch), MPJPE and the other PE in cm, MPJVE in cm/s, Jitter in 10^2 m/s^3. Lower is
        better, except for custom metrics that declare the opposite. If a network has no position branch,
        its position errors are the errors of the joints from its rotations.

        Raises:
            InputError: if pandas is not installed, or a result file is damaged.
        """
        return _make_frame(self._list_rows())

    @property
    def clips(self) -> list[str]:
        """The names of the run's test clips. Raises InputError if its data is missing or has changed."""
        return list(self._opened.test.names)

    @cached_property
    def model(self) -> MotionModel:
        """The trained network, a torch module in evaluation mode on the processor.

        Raises InputError if the network needs a package that can't be imported or is not in `plugins`.
        """
        return self._opened.network()

    def predict(self, clip: str, mode: Mode = "stream") -> Prediction:
        """Return the network's prediction for a test clip.

        Args:
            clip: one of `clips`.
            mode: "stream": frame by frame with the network's own past, like in live use; "window": in
                non-overlapping windows.

        Raises:
            InputError: for an unknown clip or mode, or if the run's data is missing or has changed.
        """
        from memmlp.config.open_run import find_clip
        from memmlp.evaluation.predictions import predict_clip

        _check("mode", mode, get_args(Mode))
        arrays = predict_clip(self.model, find_clip(self._opened.test, clip, "clip"), mode)
        learned = "position" in self.model.branches
        return Prediction(
            run=self.id,
            clip=clip,
            mode=mode,
            true_positions=arrays["true_positions"],
            true_rotations=arrays["true_rotations"],
            positions=arrays["predicted_positions"],
            rotations=arrays["predicted_rotations"],
            rest=self.model.normalizer.rest.double().numpy(),
            position_branch=arrays["predicted_positions_of_position_branch"] if learned else None,
        )

    def stream(
        self,
        *,
        space: SpaceName = "amass",
        rotations: RotationFormat = "matrix",
        offsets: Offsets | None = None,
        height: float | None = None,
        floor: float = 0.0,
        ik: LBFGS | None = None,
    ) -> Stream:
        """Return a live stream of the run's ONNX file; see `Stream` for the arguments.

        Raises InputError for the reasons in `Stream`, and if the run has no ONNX file.
        """
        return Stream(
            self._run, space=space, rotations=rotations, offsets=offsets, height=height, floor=floor, ik=ik
        )

    @cached_property
    def _opened(self) -> OpenedRun:
        from memmlp.config.open_run import open_existing_run

        return open_existing_run(self._run)

    def _list_rows(self) -> Iterator[dict[str, Any]]:
        measured, combined_by = load_measured_run(self.folder), self.combined_by
        for mode, branches in sorted(measured.means.items()):
            for branch in branches:
                by = combined_by.get(mode) if branch == COMBINED else None
                for clip, modes in measured.clips.items():
                    facts = {"clip": clip, "group": measured.get_group(clip), "frames": modes[mode]["frames"]}
                    about = {"run": self.id, "seed": self.seed, "mode": mode, "branch": branch}
                    yield about | {"combined_by": by} | facts | _convert_to_numbers(modes[mode][branch])


@dataclass(frozen=True, eq=False)
class Prediction:
    """A network's prediction for a test clip of N frames at 60 Hz, with the truth.

    Positions are in metres in AMASS' world (Z up). Rotations are local matrices; the root's is global.

    Attributes:
        run: the run's id; clip: the clip's name; mode: "stream" or "window".
        true_positions, true_rotations: the truth's joints (N, 22, 3) and rotations (N, 22, 3, 3).
        positions: joints of the rotation branch (N, 22, 3), by forward kinematics with the head on its
            tracker.
        rotations: rotations of the rotation branch (N, 22, 3, 3).
        rest: rest joints of the body (22, 3), SMPL's body frame: Y up, the person faces +Z.
        position_branch: joints of the position branch (N, 22, 3); None for a network without this branch.
    """

    run: str
    clip: str
    mode: Mode
    true_positions: np.ndarray = field(repr=False)
    true_rotations: np.ndarray = field(repr=False)
    positions: np.ndarray = field(repr=False)
    rotations: np.ndarray = field(repr=False)
    rest: np.ndarray = field(repr=False)
    position_branch: np.ndarray | None = field(repr=False)

    def __len__(self) -> int:
        """Return N, the number of frames."""
        return len(self.true_positions)

    def errors(self, branch: Branch = "rotation") -> np.ndarray:
        """Return the distance of each predicted joint from the true joint (N, 22), cm.

        The mean is the clip's MPJPE. Raises InputError if the network does not have this branch.
        """
        return self._make_piece(branch).errors[branch]

    def draw(
        self,
        path: StrPath,
        *,
        branch: Branch = "rotation",
        begin: float = 0.0,
        end: float | None = None,
        poses: int = 6,
    ) -> Path:
        """Draw the truth and the prediction, coloured by error.

        Args:
            path: FILE.png for `poses` poses in a row; FILE.gif or .mp4 for a film at 30 pictures per second.
            branch: the branch whose joints are drawn.
            begin, end: beginning and end of the drawn piece, seconds; by default the whole clip.
            poses: number of poses in a PNG, evenly spaced, 1 to 20.

        Returns:
            The file's path.

        Raises:
            InputError: for an unknown suffix, a missing folder, a missing branch, a piece without frames, a
                number of poses out of range, or an MP4 without PyAV.
        """
        from memmlp.report.pictures.clip_pictures import check_picture_path, find_frame_range, write_picture

        file = Path(path)
        check_picture_path(file)
        if poses not in range(1, 21):
            raise InputError(f"poses {poses}: must be 1 to 20")
        first, last = find_frame_range(len(self), self.clip, begin, end)
        write_picture(file, self._make_piece(branch, first, last), poses)
        return file

    def save(self, path: StrPath, *, truth: bool = False) -> Path:
        """Write the rotation branch, or the truth at the same frames, as a motion file for other programs.

        Args:
            path: FILE.bvh (centimetres, Y up), FILE.glb (glTF: metres, Y up, with a mannequin), or
                FILE.npz (AMASS' layout: metres, Z up; poses, trans and mocap_framerate).
            truth: whether to write the truth instead of the prediction.

        Returns:
            The file's path.

        Raises:
            InputError: for an unknown suffix, or if the file can't be written.
        """
        from memmlp.evaluation.predictions import make_clip
        from memmlp.motion.exporting import find_format, write_motion

        file = Path(path)
        chosen = find_format(file)
        rotations = self.true_rotations if truth else self.rotations
        positions = self.true_positions if truth else self.positions
        write_motion(file, make_clip(self.clip, rotations, positions, self.rest), self.rest, chosen)
        return file

    def _make_piece(self, branch: Branch, first: int = 0, last: int | None = None) -> ClipPiece:
        from memmlp.report.pictures.clip_pictures import ClipPiece

        branches = {"rotation": self.positions}
        branches |= {} if self.position_branch is None else {"position": self.position_branch}
        _check("branch", branch, branches)
        joints = branches[branch]
        return ClipPiece(
            self.clip, self.true_positions[first:last], {branch: joints[first:last]}, start=first
        )


def _find_outputs(given: StrPath | None) -> Path:
    return Path(os.environ.get("MEMMLP_OUTPUTS", "outputs") if given is None else given).expanduser()


def _use(plugins: Sequence[str]) -> None:
    """Use the user's packages. Raises InputError for a text instead of a list, or if an import fails."""
    if isinstance(plugins, str):
        raise InputError(f"plugins {plugins!r}: expected a list of names, [{plugins!r}]")
    if plugins:
        from memmlp.config.plugins import activate

        activate(plugins)


def _check(key: str, value: object, allowed: Iterable[object]) -> None:
    known = list(allowed)
    if value not in known:
        raise InputError(f"{key} {value}: must be one of {', '.join(map(str, known))}")


def _convert_to_numbers(errors: Mapping[str, Any]) -> dict[str, float]:
    """Convert metrics to numbers; in files, NaN is text."""
    return {name: float(value) for name, value in errors.items()}


def _make_frame(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """Make a pandas DataFrame from rows, with the metrics' units. Raises InputError without pandas."""
    try:
        import pandas as pd
    except ImportError:
        raise InputError("per_clip: needs pandas: pip install 'memmlp[notebook]', or use results") from None
    every = list(rows)
    own = {name: None for row in every for name in row if name not in COLUMNS}  # custom metrics
    frame = pd.DataFrame(every, columns=[*COLUMNS, *own])
    frame.attrs["units"] = dict(UNITS)
    return frame
