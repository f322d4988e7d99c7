"""`memmlp data show`: a sheet of pictures of clips."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.data.printing import show_skipped
from memmlp.cli.options import PATH


@click.command("show")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="The sheet, a .png.")
@click.option("--clips", default=12, show_default=True, type=click.IntRange(1, 200), help="Clips at most.")
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
def show(source: Path, out: Path, clips: int, body: str) -> None:
    """Draw clips of a folder of npz files, or one clip, each at three moments.

    The clips are spread evenly over the folder's files in the order of their names.
    """
    from memmlp.common.files import atomic_write
    from memmlp.report.pictures.canvas import png
    from memmlp.report.pictures.clip_pictures import check_picture
    from memmlp.report.pictures.clip_sheet import clip_sheet, some_clips

    check_picture(out, "--out", (".png",))
    shown, skipped, total = some_clips(source, clips, body)
    show_skipped([f"{file.file}: {file.reason}" for file in skipped])
    atomic_write(out, png(clip_sheet(shown)))
    click.echo(f"{len(shown)} of {total} clips: {out}")
