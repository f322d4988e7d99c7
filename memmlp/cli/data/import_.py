"""`memmlp data import`: clips from files of other skeletons."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.data.show import show_skipped
from memmlp.cli.options import PATH
from memmlp.common.errors import InputError


@click.command("import")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="Folder for the npz files.")
@click.option(
    "--skeleton", help="A shipped joint map or the path of one; by default the joints' names decide."
)
@click.option("--fps", multiple=True, metavar="[FOLDER=]HZ", help="True frame rate, for all or one folder.")
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
@click.option("--strict", is_flag=True, help="Stop at the first bad file instead of skipping it.")
def import_(
    source: Path, out: Path, skeleton: str | None, fps: tuple[str, ...], body: str, strict: bool
) -> None:
    """Import BVH files as AMASS npz.

    SOURCE is a folder or one file. The clips are brought to the 22-joint tree.
    """
    from memmlp.motion.importing.folder import import_folder

    rates = dict(map(_rate, fps))
    report = import_folder(source, out, skeleton=skeleton, fps=rates, body=body, strict=strict)
    for note in report.notes:
        click.echo(f"note: {note}")
    show_skipped([f"{file.file}: {file.reason}" for file in report.skipped])
    minutes = sum(clip.frames / clip.fps for clip in report.clips) / 60
    maps = ", ".join(sorted({clip.skeleton for clip in report.clips}))
    click.echo(f"{len(report.clips)} clips, {minutes:.1f} minutes, skeleton {maps}, in {out}")
    click.echo(f"next: memmlp train data=mocap data.root={out}")


def _rate(text: str) -> tuple[str, float]:
    """Parse FOLDER=HZ or HZ into folder ("" for all) and rate. Raises InputError for anything else."""
    folder, _, rate = text.rpartition("=")
    try:
        return folder, float(rate)
    except ValueError:
        raise InputError(f"--fps {text}: no frame rate; allowed: HZ or FOLDER=HZ, such as salsa=60") from None
