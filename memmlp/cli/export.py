"""`memmlp export`: the ONNX file of a finished run, checked against torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from memmlp.cli.options import outputs_option


@click.command("export")
@click.argument("run")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The ONNX file to write.")
@click.option(
    "--graph",
    default="whole",
    show_default=True,
    type=click.Choice(["whole", "streaming"]),
    help="The network as it was trained, or with all that one frame needs computed once and kept as state.",
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
@outputs_option
def export(run: str, out: Path, graph: str, scope: str, space: str | None, outputs: Path) -> None:
    """Export a finished run (id, its beginning, or folder) as ONNX and check it on a whole test clip."""
    from functools import partial

    from memmlp.avatar.full import export_full, full_parity
    from memmlp.cli.build import build_experiment, config_of
    from memmlp.data.dataset import Frames
    from memmlp.errors import InputError
    from memmlp.export import TOLERANCE, parity
    from memmlp.export import export as export_network
    from memmlp.runs import find_run
    from memmlp.streaming import streaming

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
    experiment = build_experiment(config_of(found))
    cache, _ = experiment.data.prepare()
    model = experiment.architecture.load(found)
    write(streaming(model) if graph == "streaming" else model, out, found.id)
    worst = check(model, out, Frames.open(cache, "test").clip(0))
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, differs from torch by {worst:.1e} at most")
    if not worst <= TOLERANCE:
        raise click.ClickException(f"more than {TOLERANCE:.0e}")
