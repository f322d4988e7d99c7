"""`memmlp data export`: clips as files that other programs open."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.data.printing import show_exported
from memmlp.cli.options import PATH, Finite, format_option, strict_option


@click.command("export")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="A file for a file, a folder for a folder.")
@format_option
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
@click.option("--fps", type=Finite(1, 1000), metavar="HZ", help="Resample the clips.  [default: their rate]")
@strict_option
def export(source: Path, out: Path, format_: str | None, body: str, fps: float | None, strict: bool) -> None:
    """Write AMASS npz as BVH or glTF.

    SOURCE is an npz file or a folder of such. BVH is in centimetres, glTF in metres, both with Y up; npz
    (AMASS' layout, hands at rest) is for another frame rate.
    """
    from memmlp.motion.exporting.export_folder import export as run
    from memmlp.motion.exporting.export_folder import plan_export

    show_exported(run(plan_export(source, out, format_), body=body, fps=fps, strict=strict), out)
