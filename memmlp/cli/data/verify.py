"""`memmlp data verify`: imports beside their files."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from memmlp.cli.options import PATH

MOST_MM, MOST_DEGREES = 1.0, 3.0  # the largest errors that an import may have


@click.command("verify")
@click.argument("source", type=PATH)
@click.option("--skeleton", help="A shipped joint map or the path of one.")
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
def verify(source: Path, skeleton: str | None, body: str) -> None:
    """Check imports against the BVH files' joints.

    Exits with 1 if an error is too large. "worst mm" is the largest distance of any mapped joint, on the
    clip's own bones. "worst degrees" is the largest angle between directions of upper arms, forearms, thighs
    and shins on the body.
    """
    from memmlp.motion.importing.verify import verify_folder

    rows = verify_folder(source, skeleton=skeleton, body=body)
    table = Table("clip", "skeleton")
    for name in ("frames", "worst mm", "worst degrees"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            row.name, row.skeleton, str(row.frames), f"{row.worst_mm:.4f}", f"{row.worst_degrees:.4f}"
        )
    Console(highlight=False).print(table)
    mm, degrees = max(row.worst_mm for row in rows), max(row.worst_degrees for row in rows)
    click.echo(f"worst of {len(rows)} clips: {mm:.4f} mm, {degrees:.4f} degrees")
    if mm > MOST_MM or degrees > MOST_DEGREES:
        raise click.ClickException(f"more than {MOST_MM:g} mm or {MOST_DEGREES:g} degrees")
