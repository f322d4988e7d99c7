"""`memmlp export`: the ONNX file of a finished run, checked against torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option

if TYPE_CHECKING:
    from torch import Tensor

    from memmlp.streaming import Stream


@click.command("export")
@click.argument("run")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The ONNX file to write.")
@click.option(
    "--graph",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "streaming", "naive"]),
    help="With each frame's own share computed once and kept as state, or the network as it was trained; "
    "auto is the first that there is.",
)
@click.option(
    "--precision",
    default="fp32",
    show_default=True,
    type=click.Choice(["fp32", "int8"]),
    help="int8 is calibrated on training clips and measured on test clips.",
)
@click.option(
    "--max-growth",
    default=1.0,
    show_default=True,
    help="Percent by which MPJPE may grow in int8; no file is written where it grows more.",
)
@click.option(
    "--scope",
    default="network",
    show_default=True,
    type=click.Choice(["network", "full"]),
    help="The network alone, from its 54 inputs, or all of the way from the trackers' poses to the joints.",
)
@click.option(
    "--space",
    type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of scope full; amass by default.",
)
@click.option("--clips", default=1, show_default=True, help="Test clips to check it on; 0: all.")
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
    import tempfile
    from functools import partial

    import numpy as np

    from memmlp.avatar.full import export_full, full_parity
    from memmlp.cli.opened import opened
    from memmlp.data.dataset import Frames
    from memmlp.deployment import GRAPHS
    from memmlp.errors import InputError
    from memmlp.export import export as export_network
    from memmlp.parity import TOLERANCE, parity
    from memmlp.runs import find_run
    from memmlp.streaming import Stream

    found = find_run(outputs, run)
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    if scope == "network" and space:
        raise InputError(
            f"--space {space}: the network itself knows AMASS' world alone; allowed with --scope full"
        )
    write: Callable[..., None] = export_network
    check: Callable[..., float] = parity
    if scope == "full":
        write, check = (
            partial(export_full, space=space or "amass"),
            partial(full_parity, space=space or "amass"),
        )
    _, experiment, cache, _ = opened(outputs, run)
    model = experiment.architecture.load(found)
    network = GRAPHS[graph](model)
    test = Frames.open(cache, "test").clips()
    if precision == "int8":
        if scope == "full" or not isinstance(network, Stream):
            raise InputError("--precision int8: allowed with --scope network and a streaming graph")
        write_int8(network, out, found.id, Frames.open(cache, "train").clips(), test, max_growth / 100)
        return
    checked = test[: clips or None]
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        path = Path(folder) / "step.onnx"
        write(network, path, found.id)
        worst = float(np.max([check(model, path, clip) for clip in checked]))  # NaN, if one is
        said = f"differs from torch by {worst:.1e} at most on {len(checked)} test clips"
        if not worst <= TOLERANCE:
            raise click.ClickException(f"{said}, more than {TOLERANCE:.0e}: not written")
        path.replace(out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {said}")


def write_int8(
    network: Stream, out: Path, run_id: str, train: list[Tensor], test: list[Tensor], max_growth: float
) -> None:
    """Write the int8 file if it is as accurate as asked; say what it costs."""
    import tempfile

    from memmlp.export import export as export_network
    from memmlp.quantization import compared, quantise

    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        exact, quantised = Path(folder) / "fp32.onnx", Path(folder) / "int8.onnx"
        export_network(network, exact, run_id)
        quantise(exact, quantised, network.ends, train)
        cost = compared(exact, quantised, network.frame, test)
        said = ", ".join(
            f"{name} {cost['fp32'][name]:.2f} -> {cost['int8'][name]:.2f}" for name in ("MPJPE", "Jitter")
        )
        if not cost["growth"] <= max_growth:
            raise click.ClickException(f"{said}: more than --max-growth {100 * max_growth:g} %, not written")
        quantised.replace(out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, on test clips {said}")
