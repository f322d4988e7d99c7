"""`memmlp export`: the ONNX file of a finished run, checked against torch."""

from __future__ import annotations

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
@outputs_option
def export(run: str, out: Path, graph: str, outputs: Path) -> None:
    """Export a finished run (id, its beginning, or folder) as ONNX and check it on a whole test clip."""
    from memmlp.cli.build import build_experiment, config_of
    from memmlp.data.dataset import Frames
    from memmlp.errors import InputError
    from memmlp.export import TOLERANCE, parity
    from memmlp.export import export as write
    from memmlp.runs import find_run
    from memmlp.streaming import streaming

    found = find_run(outputs, run)
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    experiment = build_experiment(config_of(found))
    cache, _ = experiment.data.prepare()
    model = experiment.architecture.load(found)
    write(streaming(model) if graph == "streaming" else model, out, found.id)
    worst = parity(model, out, Frames.open(cache, "test").clip(0))
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, differs from torch by {worst:.1e} at most")
    if not worst <= TOLERANCE:
        raise click.ClickException(f"more than {TOLERANCE:.0e}")
