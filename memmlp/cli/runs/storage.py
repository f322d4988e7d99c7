"""`memmlp runs tag`, `note`, `stop`, `retry`, `archive`, `delete`, `gc`, `export` and `import`."""

from pathlib import Path

import click

from memmlp.cli.options import PATH, FiniteFloat, outputs_option
from memmlp.cli.runs.show import format_age, make_plain_table
from memmlp.common.text_formats import make_console
from memmlp.runs.archive import export_run, import_run
from memmlp.runs.garbage_runs import REASONS, delete_garbage, delete_run, find_garbage, list_dependents
from memmlp.runs.lookup import add_tags, change_run, edit_notes, find_run, read_notes, remove_tags


@click.command("tag")
@click.argument("run")
@click.argument("tags", nargs=-1, required=True)
@click.option("--remove", is_flag=True, help="Remove the tags instead of adding them.")
@outputs_option
def tag(run: str, tags: tuple[str, ...], remove: bool, outputs: Path) -> None:
    """Add tags to a run.

    Tags are stored in the run's folder and do not change its id. `memmlp runs list --where tag=WORD` lists
    tagged runs, and `memmlp runs gc` does not delete them.
    """
    found = find_run(outputs, run)
    notes = remove_tags(found, tags) if remove else add_tags(found, tags)
    click.echo(f"{found.id}: {', '.join(notes.tags) or 'no tags'}")


@click.command("note")
@click.argument("run")
@click.argument("text", required=False)
@outputs_option
def note(run: str, text: str | None, outputs: Path) -> None:
    """Replace a run's note by TEXT, or print the note.

    An empty TEXT removes the note.
    """
    found = find_run(outputs, run)
    notes = read_notes(found) if text is None else edit_notes(found, note=text)
    click.echo(f"{found.id}: {notes.note or 'no note'}")


def _make_command(action: str, text: str) -> click.Command:
    @click.command(action, help=text)
    @click.argument("runs", nargs=-1, required=True)
    @outputs_option
    def command(runs: tuple[str, ...], outputs: Path) -> None:
        for run in [find_run(outputs, one) for one in runs]:
            change_run(run, action)
            click.echo(f"{run.id}: {run.status}")

    return command


stop = _make_command(
    "stop",
    "Stop runs that train, or that a sweep will train.\n\nThe worker writes a checkpoint at its next step. A "
    "sweep does not continue a stopped run before `memmlp runs retry RUN`.",
)
retry = _make_command("retry", "Let workers continue stopped runs, and repeat failed ones.")
prioritize = _make_command("prioritize", "Let workers take these runs before other runs of their sweep.")
unprioritize = _make_command("unprioritize", "Give these runs no priority any more.")
archive = _make_command("archive", "Leave runs out of lists and the page. Their files stay.")
restore = _make_command("restore", "Show archived runs in lists and the page again.")


@click.command("rename")
@click.argument("run")
@click.argument("name")
@outputs_option
def rename(run: str, name: str, outputs: Path) -> None:
    """Show a run with another name.

    Its id stays. An empty NAME restores the usual name.
    """
    change_run(find_run(outputs, run), "name", name)


@click.command("delete")
@click.argument("runs", nargs=-1, required=True)
@click.option("--yes", is_flag=True, help="Delete. Without --yes, only print what depends on the runs.")
@outputs_option
def delete(runs: tuple[str, ...], yes: bool, outputs: Path) -> None:
    """Delete runs, or print what depends on them."""
    for run in [find_run(outputs, one) for one in runs]:
        lines = list_dependents(outputs, run)
        click.echo(f"{run.id}: {'; '.join(lines) or 'nothing depends on it'}")
        if yes:
            delete_run(outputs, run)
    if not yes:
        click.echo("delete with --yes")


@click.command("gc")
@click.option(
    "--only",
    "kinds",
    multiple=True,
    type=click.Choice(["failed", "old", "orphaned"]),
    help="Delete only this kind of runs; repeatable.  [default: all three kinds]",
)
@click.option("--yes", is_flag=True, help="Delete the runs. Without --yes they are only listed.")
@outputs_option
def gc(kinds: tuple[str, ...], yes: bool, outputs: Path) -> None:
    """List, or delete, runs that are not needed.

    These are failed runs, runs with older component versions, and orphans. An orphan is a VQ-VAE that no run
    uses, or a folder without a run. Runs with a tag or a note, runs in progress, and prerequisite runs of
    other runs are kept.
    """
    garbage = find_garbage(outputs, kinds or REASONS)
    if not garbage:
        click.echo("nothing to delete")
        return
    table = make_plain_table("run", "kind", "reason", "age", "MB")
    for one in garbage:
        table.add_row(one.run.id, one.kind, one.reason, format_age(one.run), f"{one.size / 1e6:.1f}")
    make_console().print(table)
    if not yes:
        size = sum(one.size for one in garbage) / 1e6
        click.echo(f"{len(garbage)} runs, {size:.1f} MB; delete them with --yes")
        return
    deleted = [one for one in garbage if delete_garbage(one)]
    click.echo(f"deleted {len(deleted)} runs, {sum(one.size for one in deleted) / 1e6:.1f} MB")
    for one in garbage:
        if one not in deleted:
            click.echo(f"run {one.run.id} is not deleted: it is in use, or has a tag or a note", err=True)


@click.command("export")
@click.argument("run")
@click.option("--out", type=PATH, help="File to write.  [default: RUN.memmlp.zip in this folder]")
@outputs_option
def export(run: str, out: Path | None, outputs: Path) -> None:
    """Write a finished run to one file, which another machine can import.

    The file contains the run's config, manifest, weights, results, tags and note, but no checkpoint.
    """
    found = find_run(outputs, run)
    path = out or Path(f"{found.id}.memmlp.zip")
    digest = export_run(found, path)
    click.echo(f"{path}  {path.stat().st_size / 1e6:.1f} MB")
    click.echo(f"sha256 {digest}")


@click.command("import")
@click.argument("path", type=PATH)
@click.option("--sha256", help="Expected digest, as printed by `memmlp runs export`.  [default: any]")
@click.option(
    "--max-gb",
    type=FiniteFloat(0, min_open=True),
    default=4.0,
    help="Maximum size of the unpacked run in GB.",
)
@outputs_option
def import_(path: Path, sha256: str | None, max_gb: float, outputs: Path) -> None:
    """Import a run from a file that `memmlp runs export` wrote.

    The command rejects a file with a wrong digest inside. --sha256 verifies that the file is the exported
    one. An existing run is not changed, even if the file has additional evaluations or deployments.
    """
    run, new = import_run(path, outputs, sha256, int(max_gb * 1e9))
    click.echo(f"run {run.id}: {'imported' if new else 'exists already'}")
