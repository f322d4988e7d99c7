"""`memmlp data import`, `verify` and `skeleton`: import clips with other skeletons."""

import math
from collections.abc import Sequence
from pathlib import Path

import click

from memmlp.cli.data.printing import describe_amount, show_skipped, show_some
from memmlp.cli.options import PATH, body_option, strict_option
from memmlp.common.errors import InputError
from memmlp.common.text_formats import join_command, make_override
from memmlp.config.plugins import choose_grouping

skeleton_option = click.option(
    "--skeleton",
    help="Name of a shipped skeleton map, or path of a map.  [default: detected from the joint names]",
)
up_option = click.option(
    "--up", type=click.Choice(["y", "z"]), help="Up axis of files.  [default: the map's]"
)


@click.command("import")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="Folder for the npz files.")
@skeleton_option
@click.option(
    "--fps",
    multiple=True,
    metavar="[FOLDER=]HZ",
    help="Actual frame rate of all files or of one folder; repeatable.",
)
@click.option(
    "--floor",
    default="auto",
    metavar="auto|none|METRES",
    help="Floor height in the files. auto: the height of the lowest stable foot contact; none: heights are "
    "unchanged.",
)
@up_option
@body_option
@strict_option
@click.option("--sound", is_flag=True, help="Skip faulty clips instead of writing them with a warning.")
def import_(
    source: Path,
    out: Path,
    skeleton: str | None,
    fps: tuple[str, ...],
    floor: str,
    up: str | None,
    body: str,
    strict: bool,
    sound: bool,
) -> None:
    """Import BVH and ASF/AMC files as AMASS npz files.

    SOURCE is a folder or one file. Each clip is converted to the 22-joint tree and compared with its file.
    The command reports faults.
    """
    from memmlp.motion.importing.import_folder import ImportSettings, import_folder

    settings = ImportSettings(skeleton, _parse_rates(fps), body, _parse_floor(floor), strict, sound, up)
    report = import_folder(source, out, settings)
    for note in report.notes:
        click.echo(f"note: {note}")
    show_skipped(report.skipped)
    faulty = [f"warning: {clip.source}: {'; '.join(clip.faults)}" for clip in report.clips if clip.faults]
    show_some(faulty, "clips with warnings")
    seconds = sum(clip.frames / clip.fps for clip in report.clips)
    maps = ", ".join(sorted({clip.skeleton for clip in report.clips}))
    click.echo(f"{describe_amount(len(report.clips), seconds)}, skeleton {maps}, in {out}")
    grouping = choose_grouping([Path(clip.clip).with_suffix("").as_posix() for clip in report.clips])
    group_overrides = [f"data/grouping@data.split={grouping}"] if grouping else []
    words = ["memmlp", "train", "data=mocap", make_override("data.root", str(out)), *group_overrides]
    click.echo(f"next: {join_command(words)}")


def _parse_rates(texts: Sequence[str]) -> dict[str, float]:
    rates: dict[str, float] = {}
    for text in texts:
        folder, _, rate = text.rpartition("=")
        if folder in rates:
            raise InputError(f"--fps {text}: a second rate for {folder or 'all files'}; expected only one")
        try:
            rates[folder] = float(rate)
        except ValueError:
            raise InputError(f"--fps {text}: must be HZ or FOLDER=HZ, such as salsa=60") from None
    return rates


def _parse_floor(text: str) -> str | float:
    if text in ("auto", "none"):
        return text
    try:
        height = float(text)
    except ValueError:
        height = math.nan
    if not abs(height) <= 1000:
        raise InputError(f"--floor {text}: must be auto, none, or metres up to 1000")
    return height


@click.command("verify")
@click.argument("source", type=PATH)
@skeleton_option
@body_option
@up_option
@click.option("--all", "show_all", is_flag=True, help="Show every file, not only files with faults.")
def verify(source: Path, skeleton: str | None, body: str, up: str | None, show_all: bool) -> None:
    """Import recordings again, and compare the joints with the files.

    The command prints the largest position error of a mapped joint, with the file's bone lengths, and the
    largest angle error of a segment (trunk, neck, arms, legs, feet). Impossible postures and lengths are
    faults. The command continues after bad files. It exits with 1 if a file has a fault or cannot be
    imported.
    """
    from memmlp.motion.clip import SkippedFile
    from memmlp.motion.importing.import_folder import ImportSettings, verify_folder

    sound, bad, errors = 0, [], [(0.0, 0.0)]
    for row in verify_folder(source, ImportSettings(skeleton, body=body, up=up)):
        if isinstance(row, SkippedFile):
            bad.append(f"{row.file}: {row.reason}")
            continue
        errors.append((row.mm.value, row.degrees.value))
        sound += not row.faults
        bad += [f"{row.name}: {fault}" for fault in row.faults]
        if show_all or row.faults:
            worst = f"{row.mm.value:.4f} mm ({row.mm}), {row.degrees.value:.4f} degrees ({row.degrees})"
            click.echo(f"compared {row.name}: {row.skeleton}, {row.frames} frames, worst {worst}")
    for line in bad:
        click.echo(line)
    mm, degrees = map(max, zip(*errors, strict=True))
    deviation = f"; worst {mm:.4f} mm, {degrees:.4f} degrees" if len(errors) > 1 else ""
    click.echo(f"{sound} file{'s' * (sound != 1)} without a fault{deviation}")
    if bad:
        raise click.ClickException(f"{len(bad)} fault{'s' * (len(bad) != 1)}")


@click.group("skeleton")
def skeleton() -> None:
    """Propose a map for an unknown skeleton, or draw a map's result for a file."""


@skeleton.command("guess")
@click.argument("file", type=PATH)
@click.option("--out", type=PATH, help="New file to write the map to.")
def guess(file: Path, out: Path | None) -> None:
    """Propose a skeleton map for a file, based on its joint names and tree.

    The command prints the map, in which comments mark guesses and missing joints. Then it imports the file
    with the map and prints faults. It exits with 1 if the import fails.
    """
    from memmlp.motion.importing.guess import convert_with_guess, format_yaml, guess_map, write_map
    from memmlp.motion.importing.recordings import read_recording

    recording = read_recording(file)
    proposed = guess_map(recording, file.stem)
    text = format_yaml(proposed, recording)
    click.echo(text, nl=False)
    if out is not None:
        write_map(out, text)
    try:
        converted = convert_with_guess(recording, proposed)
    except InputError as error:
        raise click.ClickException(f"the file cannot be imported with this map: {error}") from None
    for fault in converted.fidelity.faults:
        click.echo(f"warning: {fault}", err=True)
    faults = len(converted.fidelity.faults)
    click.echo(
        f"imports from {converted.fitted.stance.source}, with {faults} fault{'s' * (faults != 1)}", err=True
    )
    words = ["memmlp", "data", "skeleton", "show", str(file), "--skeleton", str(out or "MAP"), "--out", "PNG"]
    click.echo(f"next: {join_command(words)}", err=True)


@skeleton.command("show")
@click.argument("file", type=PATH)
@skeleton_option
@click.option("--out", required=True, type=PATH, help="PNG file to write.")
def show(file: Path, skeleton: str | None, out: Path) -> None:
    """Draw a file's reference pose with the nodes that a skeleton map selects.

    The picture also shows the built-in body in the same pose. If the two poses differ, the map is wrong.
    """
    from memmlp.motion.body import load_rest_joints
    from memmlp.motion.importing.convert import view_stance
    from memmlp.motion.importing.recordings import read_recording
    from memmlp.motion.importing.skeleton_map import find_skeleton, load_skeleton
    from memmlp.report.pictures.clip_pictures import check_picture_path
    from memmlp.report.pictures.import_pictures import write_skeleton_picture

    check_picture_path(out, "--out", (".png",))
    recording = read_recording(file)
    skeleton_map = find_skeleton(recording, None if skeleton is None else load_skeleton(skeleton))
    stance = view_stance(recording, skeleton_map, load_rest_joints("builtin"))
    write_skeleton_picture(out, stance, f"{file.name}: {skeleton_map.name}")
    click.echo(f"{skeleton_map.name}, read from {stance.source}: {out}")
