"""`memmlp runs gc`, `memmlp runs export` and `memmlp runs import`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.table import Table

from memmlp.cli.options import PATH, Finite, outputs_option
from memmlp.cli.runs.printing import age, console, plain_table

if TYPE_CHECKING:
    from memmlp.runs.garbage_runs import Garbage


@click.command("gc")
@click.option(
    "--only",
    "kinds",
    multiple=True,
    type=click.Choice(["failed", "old", "orphaned"]),
    help="Delete these alone; may be repeated.  [default: all three]",
)
@click.option("--yes", is_flag=True, help="Delete them. Without it they are only shown.")
@outputs_option
def gc(kinds: tuple[str, ...], yes: bool, outputs: Path) -> None:
    """Show, or delete, runs that nobody needs.

    These have failed, are of an older recipe, or are orphaned: no longer in a sweep, a VQ-VAE that no run
    uses, a folder in which nothing began. Runs with a tag or a note, runs that are going on, and what other
    runs build upon stay.
    """
    from memmlp.runs.garbage_runs import REASONS, delete, garbage

    found = garbage(outputs, kinds or REASONS)
    if not found:
        click.echo("nothing to delete")
        return
    console().print(_garbage_table(found))
    if not yes:
        size = sum(one.size for one in found) / 1e6
        click.echo(f"{len(found)} runs, {size:.1f} MB; delete them with --yes")
        return
    gone = [one for one in found if delete(one)]
    click.echo(f"deleted {len(gone)} runs, {sum(one.size for one in gone) / 1e6:.1f} MB")
    for one in found:
        if one not in gone:
            click.echo(f"run {one.run.id} stays: somebody is at it, or gave it a tag or a note", err=True)


def _garbage_table(found: Sequence[Garbage]) -> Table:
    table = plain_table("run", "why", "reason", "age", "MB")
    for one in found:
        table.add_row(one.run.id, one.kind, one.reason, age(one.run), f"{one.size / 1e6:.1f}")
    return table


@click.command("export")
@click.argument("run")
@click.option("--out", type=PATH, help="The file.  [default: RUN.memmlp.zip in this folder]")
@outputs_option
def export(run: str, out: Path | None, outputs: Path) -> None:
    """Write a finished run to one file, which another machine can import.

    It has the run's config, record, weights, results, tags and note, and no checkpoint.
    """
    from memmlp.runs.archive import export_run
    from memmlp.runs.lookup import find_run

    found = find_run(outputs, run)
    path = out or Path(f"{found.id}.memmlp.zip")
    digest = export_run(found, path)
    click.echo(f"{path}  {path.stat().st_size / 1e6:.1f} MB")
    click.echo(f"sha256 {digest}")


@click.command("import")
@click.argument("path", type=PATH)
@click.option("--sha256", help="The digest that `memmlp runs export` printed.  [default: any]")
@click.option("--max-gb", type=Finite(0, min_open=True), default=4.0, show_default=True, help="Size at most.")
@outputs_option
def import_(path: Path, sha256: str | None, max_gb: float, outputs: Path) -> None:
    """Take a run from a file that `memmlp runs export` wrote.

    It is refused if a digest in it does not hold. With --sha256 it is the very file that was exported. A run
    that is there already stays as it is, also where the file has more of its evaluations and deployments.
    """
    from memmlp.runs.archive import import_run

    run, new = import_run(path, outputs, sha256, int(max_gb * 1e9), lambda line: click.echo(line, err=True))
    click.echo(f"run {run.id}: {'imported' if new else 'was there already'}")
