"""`memmlp data import`: clips from files of other skeletons."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import click

from memmlp.cli.data.printing import amount, show_skipped, show_some
from memmlp.cli.options import PATH
from memmlp.common.errors import InputError


@click.command("import")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="Folder for the npz files.")
@click.option(
    "--skeleton", help="A shipped skeleton map or the path of one; by default the joints' names decide."
)
@click.option("--fps", multiple=True, metavar="[FOLDER=]HZ", help="True frame rate, for all or one folder.")
@click.option(
    "--floor",
    "--ground",
    "floor",
    default="auto",
    show_default=True,
    metavar="auto|none|METRES",
    help="auto puts the lowest stable contact of the feet at 0; METRES is the floor's height in the files.",
)
@click.option("--up", type=click.Choice(["y", "z"]), help="The files' up axis; by default the map's.")
@click.option(
    "--take", multiple=True, metavar="REGEX", help="Clips that match alike share one floor; repeatable."
)
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
@click.option("--strict", is_flag=True, help="Stop at the first bad file instead of skipping it.")
@click.option(
    "--sound",
    is_flag=True,
    help="Skip faulty clips instead of writing them with a warning.",
)
def import_(
    source: Path,
    out: Path,
    skeleton: str | None,
    fps: tuple[str, ...],
    floor: str,
    up: str | None,
    take: tuple[str, ...],
    body: str,
    strict: bool,
    sound: bool,
) -> None:
    """Import BVH files, or exponential maps of the CMU layout (.txt), as AMASS npz.

    SOURCE is a folder or one file. The clips are brought to the 22-joint tree, and each is compared with its
    file; what looks wrong is said.
    """
    from memmlp.config.clip_groupings import grouping_to_choose
    from memmlp.motion.importing.import_folder import ImportSettings, import_folder

    rates = _rates(fps)
    how = ImportSettings(skeleton, rates, body, _height(floor), take, strict, sound, up)
    report = import_folder(source, out, how)
    for note in report.notes:
        click.echo(f"note: {note}")
    show_skipped([f"{file.file}: {file.reason}" for file in report.skipped])
    faulty = [clip for clip in report.clips if clip.faults]
    show_some([f"warning: {clip.source}: {'; '.join(clip.faults)}" for clip in faulty], "clips with warnings")
    seconds = sum(clip.frames / clip.fps for clip in report.clips)
    maps = ", ".join(sorted({clip.skeleton for clip in report.clips}))
    click.echo(f"{amount(len(report.clips), seconds)}, skeleton {maps}, in {out}")
    grouping = grouping_to_choose([Path(clip.clip).with_suffix("").as_posix() for clip in report.clips])
    chosen = [f"data/grouping@data.split={grouping}"] if grouping else []
    click.echo("next: " + shlex.join(["memmlp", "train", "data=mocap", f"data.root={out}", *chosen]))


def _rates(texts: Sequence[str]) -> dict[str, float]:
    """Parse all rates by folder. Raises InputError for a folder that has two."""
    rates = [_rate(text) for text in texts]
    if twice := [folder for folder, count in Counter(folder for folder, _ in rates).items() if count > 1]:
        raise InputError(f"--fps: {twice[0] or 'all'} twice; allowed: one rate for each folder")
    return dict(rates)


def _rate(text: str) -> tuple[str, float]:
    """Parse FOLDER=HZ or HZ into folder ("" for all) and rate. Raises InputError for anything else."""
    folder, _, rate = text.rpartition("=")
    try:
        return folder, float(rate)
    except ValueError:
        raise InputError(f"--fps {text}: no frame rate; allowed: HZ or FOLDER=HZ, such as salsa=60") from None


def _height(text: str) -> str | float:
    """Parse auto, none or metres. Raises InputError for anything else."""
    if text in ("auto", "none"):
        return text
    try:
        height = float(text)
    except ValueError:
        height = math.nan
    if not abs(height) <= 1000:
        raise InputError(f"--floor {text}: no height; allowed: auto, none, or metres up to 1000")
    return height
