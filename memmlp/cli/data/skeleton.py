"""`memmlp data skeleton`: a map for a skeleton that no shipped map fits, proposed and shown."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.options import PATH
from memmlp.common.errors import InputError


@click.group("skeleton")
def skeleton() -> None:
    """Propose a map for a foreign skeleton, and see what a map makes of a file."""


@skeleton.command("guess")
@click.argument("file", type=PATH)
@click.option("--out", type=PATH, help="Also write the map there; a file that is there stays as it is.")
def guess(file: Path, out: Path | None) -> None:
    """Propose a map for a file, from its joints' names, its tree and its motion.

    Prints the map with comments that say what is guessed and what is in doubt, imports the file with it, and
    says what is wrong then. Exits with 1 where the file can't be imported so.
    """
    from memmlp.motion.importing.guessed_map import as_yaml, check, write_map
    from memmlp.motion.importing.guessed_map import guess as propose
    from memmlp.motion.importing.importable_files import read_recording

    recording = read_recording(file)
    proposed = propose(recording, file.stem)
    text = as_yaml(proposed, recording)
    click.echo(text, nl=False)
    if out is not None:
        write_map(out, text)
    try:
        stance, faults = check(recording, proposed)
    except InputError as error:
        raise click.ClickException(f"the map does not do yet: {error}") from None
    for fault in faults:
        click.echo(f"warning: {fault}", err=True)
    click.echo(f"imports from {stance}, with {len(faults)} fault{'s' * (len(faults) != 1)}", err=True)
    click.echo(f"next: memmlp data skeleton show {file} --skeleton {out or 'MAP'} --out PNG", err=True)


@skeleton.command("show")
@click.argument("file", type=PATH)
@click.option("--skeleton", "which", help="A shipped map or the path of one; by default the names decide.")
@click.option("--out", required=True, type=PATH, help="The picture, a .png.")
def show(file: Path, which: str | None, out: Path) -> None:
    """Draw the stance that a file's skeleton is read from, with the nodes that a map picks.

    Beside it stands the built-in body in the same stance: where the two differ, the map is wrong.
    """
    from memmlp.motion.body import load_rest_joints
    from memmlp.motion.importing.importable_files import read_recording
    from memmlp.motion.importing.skeleton_map import find_skeleton, load_skeleton
    from memmlp.motion.importing.stance_with_all_nodes import find_stance_with_all_nodes
    from memmlp.report.pictures.clip_pictures import check_picture
    from memmlp.report.pictures.skeleton_picture import skeleton_png

    check_picture(out, "--out", (".png",))
    recording = read_recording(file)
    chosen = find_skeleton(recording, None if which is None else load_skeleton(which))
    stance = find_stance_with_all_nodes(recording, chosen, load_rest_joints("builtin"))
    skeleton_png(out, stance, f"{file.name}: {chosen.name}")
    click.echo(f"{chosen.name}, read from {stance.source}: {out}")
