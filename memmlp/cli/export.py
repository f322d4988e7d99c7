"""`memmlp export`: the ONNX file of a finished run, checked against torch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option, plugins_option

if TYPE_CHECKING:
    from torch import Tensor

    from memmlp.networks.streaming import StreamingGraph
    from memmlp.networks.window_model import WindowModel


@click.command("export")
@click.argument("run")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="ONNX file to write.")
@click.option(
    "--graph",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "streaming", "naive"]),
    help="Graph to export: streaming computes each frame's own share once and keeps it as state, naive is "
    "the network as it was trained; auto is the first that there is.",
)
@click.option(
    "--precision",
    default="fp32",
    show_default=True,
    type=click.Choice(["fp32", "int8"]),
    help="Precision of the weights: fp32, or int8, which is calibrated on training clips and measured on "
    "test clips.",
)
@click.option(
    "--max-growth",
    default=1.0,
    show_default=True,
    help="How much MPJPE may grow in int8, percent; no file is written where it grows more.",
)
@click.option(
    "--scope",
    default="network",
    show_default=True,
    type=click.Choice(["network", "full"]),
    help="What the file computes: the network alone, from its 54 inputs, or all of the way from the "
    "trackers' poses to the joints.",
)
@click.option(
    "--space",
    type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of poses, with --scope full.  [default: amass]",
)
@click.option(
    "--clips", default=1, show_default=True, help="How many test clips the file is checked on; 0 for all."
)
@plugins_option
@outputs_option
def export(
    run: str,
    out: Path,
    graph: str,
    precision: str,
    max_growth: float,
    scope: str,
    space: str | None,
    clips: int,
    outputs: Path,
) -> None:
    """Export a finished run (id, its beginning, or folder) as ONNX and check it on whole test clips."""
    from memmlp.common.errors import InputError
    from memmlp.common.progress import tell
    from memmlp.config.open_run import open_run
    from memmlp.deploy.deployment import GRAPHS
    from memmlp.networks.streaming import StreamingGraph
    from memmlp.runs.lookup import find_run

    found = find_run(outputs, run)
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    if scope == "network" and space:
        raise InputError(
            f"--space {space}: the network itself knows AMASS' world alone; allowed with --scope full"
        )
    _, experiment, data = open_run(outputs, run)
    model = experiment.architecture.load(found.weights())
    network = GRAPHS[graph](model)
    test = data.open("test").clips()
    if precision == "fp32":
        tell(f"export: write {out}, and compare it with torch on {len(test[: clips or None])} test clips")
        write_exact(
            model,
            network,
            out,
            found.id,
            test[: clips or None],
            full=space or "amass" if scope == "full" else None,
        )
    elif scope == "network" and isinstance(network, StreamingGraph):
        tell(f"export: write {out} in int8, and measure what that costs on {len(test)} test clips")
        write_int8(network, out, found.id, data.open("train").clips(), test, max_growth / 100)
    else:
        raise InputError("--precision int8: allowed with --scope network and a streaming graph")


def write_exact(
    model: WindowModel,
    network: WindowModel | StreamingGraph,
    out: Path,
    run_id: str,
    clips: list[Tensor],
    full: str | None,
) -> None:
    """Write the float32 ONNX file, provided that it computes on all clips what the trained model does.

    Args:
        model: the network as it was trained.
        network: the graph to export, the model itself or its streaming graph.
        out: the file to write.
        run_id: the run's id, for the file's metadata.
        clips: frames (N, 252) of each clip to compare on.
        full: the frame of reference of the poses, for a file that covers the whole way from trackers to
            joints; None for the network alone.

    Raises:
        ClickException: where file and model differ by more than the tolerance; nothing is written then.
    """
    import tempfile

    import numpy as np

    from memmlp.deploy.export import export as export_network
    from memmlp.deploy.parity import TOLERANCE, parity
    from memmlp.live.full_graph import export_full, full_parity

    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        path = Path(folder) / "step.onnx"
        if full:
            export_full(network, path, run_id, full)
            apart = [full_parity(model, path, clip, full) for clip in clips]
        else:
            export_network(network, path, run_id)
            apart = [parity(model, path, clip) for clip in clips]
        worst = float(np.max(apart))  # NaN as soon as one is NaN, unlike max()
        said = f"differs from torch by {worst:.1e} at most on {len(clips)} test clips"
        if not worst <= TOLERANCE:
            raise click.ClickException(f"{said}, more than {TOLERANCE:.0e}: not written")
        path.replace(out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {said}")


def write_int8(
    network: StreamingGraph,
    out: Path,
    run_id: str,
    train: list[Tensor],
    test: list[Tensor],
    max_growth: float,
) -> None:
    """Write the int8 ONNX file, provided that it is accurate enough, and say what it costs.

    Args:
        network: the streaming graph to quantise.
        out: the file to write.
        run_id: the run's id, for the file's metadata.
        train: frames (N, 252) of the clips that calibrate the quantisation.
        test: frames (N, 252) of the clips that the cost is measured on.
        max_growth: the fraction by which MPJPE may grow (0.01 is 1 %).

    Raises:
        ClickException: where MPJPE grows by more; nothing is written then.
    """
    import tempfile

    from memmlp.deploy.export import export as export_network
    from memmlp.deploy.quantization import compared, quantise

    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        exact, quantised = Path(folder) / "fp32.onnx", Path(folder) / "int8.onnx"
        export_network(network, exact, run_id)
        quantise(exact, quantised, network.ends, train)
        cost = compared(exact, quantised, network.normalizer, test)
        said = ", ".join(
            f"{name} {cost['fp32'][name]:.2f} -> {cost['int8'][name]:.2f}" for name in ("MPJPE", "Jitter")
        )
        if not cost["growth"] <= max_growth:
            raise click.ClickException(f"{said}: more than --max-growth {100 * max_growth:g} %, not written")
        quantised.replace(out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, on test clips {said}")
