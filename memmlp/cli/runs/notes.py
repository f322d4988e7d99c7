"""`memmlp runs tag` and `memmlp runs note`."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.options import outputs_option


@click.command("tag")
@click.argument("run")
@click.argument("tags", nargs=-1, required=True)
@click.option("--remove", is_flag=True, help="Take the tags away instead.")
@outputs_option
def tag(run: str, tags: tuple[str, ...], remove: bool, outputs: Path) -> None:
    """Give a run tags.

    They lie in its folder, are found by `memmlp runs list --where tag=WORD`, and are no part of what the run
    is. `memmlp runs gc` spares runs with tags.
    """
    from memmlp.runs.lookup import find_run
    from memmlp.runs.notes import add_tags, remove_tags

    found = find_run(outputs, run)
    notes = remove_tags(found, tags) if remove else add_tags(found, tags)
    click.echo(f"{found.id}: {', '.join(notes.tags) or 'no tags'}")


@click.command("note")
@click.argument("run")
@click.argument("text", required=False)
@outputs_option
def note(run: str, text: str | None, outputs: Path) -> None:
    """Replace a run's note by TEXT, or print it.

    An empty TEXT removes it.
    """
    from memmlp.runs.lookup import find_run
    from memmlp.runs.notes import read_notes, set_note

    found = find_run(outputs, run)
    notes = read_notes(found) if text is None else set_note(found, text)
    click.echo(f"{found.id}: {notes.note or 'no note'}")
