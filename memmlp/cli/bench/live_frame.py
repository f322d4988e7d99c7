"""`memmlp bench live-frame`: the time of a live frame, from trackers to the avatar's pose."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option, plugins_option

if TYPE_CHECKING:
    from memmlp.live.spaces import SpaceName
    from memmlp.live.stream import RotationFormat


@click.command("live-frame")
@click.option("--run", help="Finished run to time.  [default: a network with random weights]")
@click.option("--onnx", type=click.Path(path_type=Path), help="ONNX file to time, in place of a run.")
@click.option("--frames", default=300, show_default=True, help="How many frames a round has.")
@click.option("--rounds", default=5, show_default=True, help="How many rounds are timed.")
@click.option(
    "--space",
    default="amass",
    show_default=True,
    help="Frame of reference of the poses: amass, openxr or unity.",
)
@click.option(
    "--rotations",
    default="matrix",
    show_default=True,
    help="Format of the rotations that come out: matrix or quaternion.",
)
@plugins_option
@outputs_option
@click.argument("overrides", nargs=-1)
def live_frame(
    run: str | None,
    onnx: Path | None,
    frames: int,
    rounds: int,
    space: SpaceName,
    rotations: RotationFormat,
    outputs: Path,
    overrides: tuple[str, ...],
) -> None:
    """Time a frame of the live stream.

    It is timed beside the network's session alone: milliseconds, and the ratio. The two take turns, frame by
    frame. OVERRIDES are those of `memmlp train`, for random weights; the default is profile=paper. Their
    graph is the streaming one, where the network has it.
    """
    import tempfile

    import numpy as np

    from memmlp.common.errors import InputError
    from memmlp.deploy.onnx_stream import OnnxStream
    from memmlp.live.pose_latency import alternate
    from memmlp.live.stream import Stream
    from memmlp.runs.lookup import find_run

    if sum([run is not None, onnx is not None, bool(overrides)]) > 1:
        raise InputError("--run, --onnx, overrides: each says what is timed; allowed is one of them")
    with tempfile.TemporaryDirectory() as folder:
        if run is not None:
            onnx = find_run(outputs, run).onnx
        elif onnx is None:
            onnx = _random(overrides, Path(folder) / "step.onnx")
        stream = Stream(onnx, space=space, rotations=rotations)
        network = OnnxStream(onnx)
        timed = [alternate(stream, network, frames) for _ in range(rounds + 1)][1:]  # one to warm up
        medians = 1000 * np.median(timed, 1)
    ratios = medians[:, 1] / medians[:, 0]
    session, whole = np.median(medians, 0)
    click.echo(f"session.run  {session:7.3f} ms a frame")
    click.echo(f"Stream.step  {whole:7.3f} ms a frame")
    spread = f"{ratios.min():.3f} to {ratios.max():.3f} over {rounds} rounds of {frames} frames"
    click.echo(f"ratio {np.median(ratios):.3f} ({spread})")


def _random(overrides: tuple[str, ...], path: Path) -> Path:
    """Export a network with random weights to an ONNX file, and return the file."""
    from memmlp.config.build import untrained
    from memmlp.deploy.deployment import GRAPHS
    from memmlp.deploy.export import export

    export(GRAPHS["auto"](untrained(("profile=paper", *overrides))), path, "random")
    return path
