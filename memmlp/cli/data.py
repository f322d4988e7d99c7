"""`memmlp data`: make, import, verify, prepare and inspect motion."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.table import Table

from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.motion.prepare import ClipRecord, Manifest
    from memmlp.motion.splits import Split

PATH = click.Path(path_type=Path)
MOST_MM, MOST_DEGREES = 1.0, 3.0  # the largest errors that an import may have
SHOWN = 8  # skipped files that are named on the screen; the manifest lists all


@click.group("data")
def data() -> None:
    """Make, import, prepare and inspect motion data."""


@data.command("synth")
@click.option("--out", required=True, type=PATH, help="Folder for the clips.")
@click.option("--minutes", default=10.0, show_default=True, help="Length of all clips together.")
@click.option("--seed", default=0, show_default=True)
@click.option("--fps", default=60.0, show_default=True, help="Frame rate of the clips.")
def synth(out: Path, minutes: float, seed: int, fps: float) -> None:
    """Write procedural motion as AMASS npz.

    The clips show walking, squats, reaching and other movements.
    """
    from memmlp.motion.synthetic import synthesize

    paths = synthesize(out, minutes=minutes, seed=seed, fps=fps)
    click.echo(f"{len(paths)} clips, {minutes:g} minutes, in {out}")


@data.command("import")
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
    from memmlp.motion.importing import import_folder

    rates = dict(map(_rate, fps))
    report = import_folder(source, out, skeleton=skeleton, fps=rates, body=body, strict=strict)
    for note in report.notes:
        click.echo(f"note: {note}")
    _show_skipped([f"{file.file}: {file.reason}" for file in report.skipped])
    minutes = sum(clip.frames / clip.fps for clip in report.clips) / 60
    maps = ", ".join(sorted({clip.skeleton for clip in report.clips}))
    click.echo(f"{len(report.clips)} clips, {minutes:.1f} minutes, skeleton {maps}, in {out}")
    click.echo(f"next: memmlp train data=mocap data.root={out}")


@data.command("verify")
@click.argument("source", type=PATH)
@click.option("--skeleton", help="A shipped joint map or the path of one.")
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
def verify(source: Path, skeleton: str | None, body: str) -> None:
    """Check imports against the BVH files' joints.

    Exits with 1 if an error is too large. "worst mm" is the largest distance of any mapped joint, on the
    clip's own bones. "worst degrees" is the largest angle between directions of upper arms, forearms, thighs
    and shins on the body.
    """
    from memmlp.motion.fidelity import verify_folder

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


@data.command("prepare")
@click.argument("root", type=PATH)
@click.option("--out", required=True, type=PATH, help="Folder of the cache.")
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
@click.option(
    "--split", default="seeded", show_default=True, help="seeded, s2, or lists:FOLDER (AGRoL's format)."
)
@click.option("--val", default=0.1, show_default=True, help="Fraction for validation.")
@click.option("--test", default=0.1, show_default=True, help="Fraction for testing (seeded).")
@click.option("--seed", default=0, show_default=True)
@click.option(
    "--group", multiple=True, metavar="REGEX", help="Clips that match stay on one side; repeatable."
)
@click.option("--min-frames", default=42, show_default=True, help="Shorter clips (at 60 Hz) are skipped.")
@click.option("--strict", is_flag=True, help="Stop at the first bad file instead of skipping it.")
def prepare(
    root: Path,
    out: Path,
    body: str,
    split: str,
    val: float,
    test: float,
    seed: int,
    group: tuple[str, ...],
    min_frames: int,
    strict: bool,
) -> None:
    """Write the cache of a folder of AMASS npz.

    The cache is memory-mappable, and has a manifest of what became of each file.
    """
    from memmlp.motion.prepare import ClipFolder
    from memmlp.motion.prepare import prepare as run

    chosen = _split(split, val, test, seed, group)
    _show_manifest(run(ClipFolder(root, chosen, body, min_frames, strict), out))


@data.command("inspect")
@click.argument("path", type=PATH)
def inspect(path: Path) -> None:
    """Show clips, hours, rates and bad files.

    PATH is a cache, whose splits are shown too, or a folder of npz files.
    """
    from memmlp.motion.prepare import MANIFEST, Manifest, survey

    if (path / MANIFEST).is_file():
        _show_manifest(Manifest.load(path))
        return
    found = survey(path)
    _show_skipped([f"{file.file}: {file.reason}" for file in found.skipped])
    _show_rates(found.clips)
    frames = sum(clip.length for clip in found.clips)
    click.echo(f"{len(found.clips)} clips, {frames / 216000:.2f} h, {len(found.skipped)} bad files")


def _rate(text: str) -> tuple[str, float]:
    """Parse FOLDER=HZ or HZ into folder ("" for all) and rate. Raises InputError for anything else."""
    folder, _, rate = text.rpartition("=")
    try:
        return folder, float(rate)
    except ValueError:
        raise InputError(f"--fps {text}: no frame rate; allowed: HZ or FOLDER=HZ, such as salsa=60") from None


def _split(name: str, val: float, test: float, seed: int, groups: tuple[str, ...]) -> Split:
    """Return the split that --split names. Raises InputError for an unknown name."""
    from memmlp.motion.splits import S2_TEST, S2_TRAIN, ListSplit, SeededSplit, SubsetSplit

    if name == "seeded":
        return SeededSplit(test, val, seed, groups)
    if name == "s2":
        return SubsetSplit(S2_TRAIN, S2_TEST, val, seed, groups)
    if name.startswith("lists:"):
        return ListSplit(Path(name.removeprefix("lists:")), val, seed, groups)
    raise InputError(f"--split {name}: no such split; allowed: seeded, s2, lists:FOLDER")


def _show_manifest(manifest: Manifest) -> None:
    """Print the parts, frame rates and skipped files of a cache."""
    table = Table("part")
    for name in ("clips", "frames", "hours"):
        table.add_column(name, justify="right")
    for part, total in manifest.totals.items():
        table.add_row(part, f"{total['clips']:.0f}", f"{total['frames']:.0f}", f"{total['hours']:.3f}")
    Console(highlight=False).print(table)
    _show_rates(manifest.clips)
    _show_skipped([f"{file.file}: {file.reason}" for file in manifest.skipped])
    left_out = sum(manifest.left_out.values())
    click.echo(
        f"{len(manifest.clips)} clips; skipped {len(manifest.skipped)}, left out by the split {left_out}, "
        f"listed but missing {len(manifest.missing)}; body {manifest.body}"
    )


def _show_rates(clips: tuple[ClipRecord, ...]) -> None:
    """Print the frame rates that were found, and how each was brought to 60 Hz."""
    for (fps, how), count in sorted(Counter((clip.fps, clip.resampling) for clip in clips).items()):
        click.echo(f"{count} clips at {fps:g} Hz: {how}")


def _show_skipped(lines: list[str]) -> None:
    """Print the first few skipped files and the number of the others."""
    for line in lines[:SHOWN]:
        click.echo(f"skipped {line}")
    if len(lines) > SHOWN:
        click.echo(f"skipped {len(lines) - SHOWN} more")
