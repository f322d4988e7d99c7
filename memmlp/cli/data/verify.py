"""`memmlp data verify`: imports files on trial, and compares each result with its file."""

from __future__ import annotations

from pathlib import Path

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from memmlp.cli.options import PATH


@click.command("verify")
@click.argument("source", type=PATH)
@click.option("--skeleton", help="A shipped skeleton map or the path of one.")
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
@click.option("--up", type=click.Choice(["y", "z"]), help="The files' up axis; by default the map's.")
@click.option("--all", "every", is_flag=True, help="Show every file and not only those with faults.")
def verify(source: Path, skeleton: str | None, body: str, up: str | None, every: bool) -> None:
    """Check imports against the files themselves.

    Each file is imported, and what would be kept is compared with the file's own joints: "worst mm" is the
    largest distance of any mapped joint on the file's own bones, "worst degrees" the largest angle between a
    segment (trunk, neck, arms, legs, feet) on the body and in the file. A body that no person has is a fault
    too: the head below the pelvis, knees that bend forward, feet that point backward or hang above the floor,
    odd lengths. Goes on past bad files; exits with 1 if any file has a fault or can't be imported.
    """
    from memmlp.motion.importing.verify_files import Unusable, verify_folder

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("file", overflow="fold")
    table.add_column("skeleton")
    for name in ("frames", "worst\nmm", "worst\ndegrees"):
        table.add_column(name, justify="right")
    table.add_column("at")
    measured, sound, bad, worst = 0, 0, [], (0.0, 0.0)
    for row in verify_folder(source, skeleton=skeleton, body=body, up=up):
        if isinstance(row, Unusable):
            bad.append(f"{row.name}: {row.reason}")
            continue
        measured += 1
        worst = max(worst[0], row.mm.value), max(worst[1], row.degrees.value)
        sound += not row.faults
        bad += [f"{row.name}: {fault}" for fault in row.faults]
        if every or row.faults:
            numbers = (str(row.frames), f"{row.mm.value:.4f}", f"{row.degrees.value:.4f}")
            table.add_row(row.name, row.skeleton, *numbers, f"{row.mm}\n{row.degrees}")
    if table.row_count:
        Console(highlight=False, markup=False).print(table)  # a file's name may have brackets
    for line in bad:
        click.echo(line)
    deviation = f"; worst {worst[0]:.4f} mm, {worst[1]:.4f} degrees" if measured else ""
    click.echo(f"{sound} file{'s' * (sound != 1)} without a fault{deviation}")
    if bad:
        raise click.ClickException(f"{len(bad)} fault{'s' * (len(bad) != 1)}")
