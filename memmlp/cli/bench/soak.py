"""`memmlp bench soak`: a live stream of many hours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option, plugins_option

if TYPE_CHECKING:
    from memmlp.live.soak import TrackedMotion
    from memmlp.motion.dataset import MotionDataset


@click.command("soak")
@click.argument("run", required=False)
@click.option(
    "--onnx", type=click.Path(path_type=Path), help="ONNX file to stream with.  [default: the run's own]"
)
@click.option("--hours", default=1.0, show_default=True, help="Least length of the streamed motion, hours.")
@plugins_option
@outputs_option
def soak(run: str | None, onnx: Path | None, hours: float, outputs: Path) -> None:
    """Stream for hours of motion without a reset.

    RUN's test clips are streamed one after the other and over again; without RUN the motion is synthetic. It
    is repeated as a whole, a multiple of ten times, so that every tenth holds the same frames. Printed are
    whether all numbers were finite, the MPJPE of the first and of the last tenth, and how much memory grew
    between their ends.
    """
    from memmlp.common.errors import InputError
    from memmlp.live.soak import repetitions
    from memmlp.live.soak import soak as soaked
    from memmlp.live.stream import Stream
    from memmlp.motion.body import FPS
    from memmlp.runs.lookup import find_run

    if run is not None and onnx is None:
        onnx = find_run(outputs, run).onnx
    if onnx is None:
        raise InputError("soak: neither RUN nor --onnx FILE; at least one is needed")
    stream = Stream(onnx)
    motion = _motion(_synthetic() if run is None else _test_clips(outputs, run))
    times = repetitions(len(motion.joints), round(hours * 3600 * FPS))
    result = soaked(stream, motion, times)
    first, last = result.errors[0], result.errors[-1]
    click.echo(f"{result.frames} frames ({result.frames / FPS / 3600:.2f} h): {times} x {len(motion.joints)}")
    click.echo(f"all finite: {'yes' if result.finite else 'NO'}")
    click.echo(f"MPJPE {first:.3f} cm in the first tenth, {last:.3f} cm in the last ({last - first:+.4f})")
    click.echo(f"memory {result.growth / 2**20:+.2f} MiB from the end of the first tenth to the end")


def _test_clips(outputs: Path, run: str) -> MotionDataset:
    """Return the test clips of a run's data."""
    from memmlp.config.build import build_experiment, config_of
    from memmlp.runs.lookup import find_run

    return build_experiment(config_of(find_run(outputs, run))).motion.prepare().open("test")


def _synthetic() -> MotionDataset:
    """Return test clips of synthetic motion."""
    import tempfile

    from memmlp.motion.dataset import MotionDataset
    from memmlp.motion.preparing.cache import ClipFolder, prepare
    from memmlp.motion.preparing.splits import SeededSplit
    from memmlp.motion.synthetic import synthesize

    with tempfile.TemporaryDirectory() as folder:
        synthesize(Path(folder) / "clips", minutes=10)
        prepare(ClipFolder(Path(folder) / "clips", SeededSplit()), Path(folder) / "cache")
        test = MotionDataset.open(Path(folder) / "cache", "test")
        return MotionDataset(test.frames.clone(), test.starts, test.lengths, test.names)


def _motion(clips: MotionDataset) -> TrackedMotion:
    """Join all clips into one motion of trackers and true joints."""
    from memmlp.live.soak import TrackedMotion
    from memmlp.live.trackers_to_body_graph import trackers_of
    from memmlp.motion.body import N_JOINTS, POSITION, SPARSE_DIM

    positions, rotations = trackers_of(clips.frames)
    joints = clips.frames[:, SPARSE_DIM:][:, POSITION].unflatten(-1, (N_JOINTS, 3))
    return TrackedMotion(*(part.double().numpy() for part in (positions[1:], rotations[1:], joints)))
