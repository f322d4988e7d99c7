"""Prints clips, frame rates and skipped files for users."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.table import Table

from memmlp.common.errors import one_line
from memmlp.motion.body import FPS
from memmlp.motion.clip import INTERPOLATED
from memmlp.motion.preparing.find_clips import source_of
from memmlp.motion.preparing.split_remarks import divided_remark, unmatched_patterns_remark

if TYPE_CHECKING:
    from pathlib import Path

    from memmlp.motion.exporting.export_folder import ExportReport
    from memmlp.motion.preparing.manifest import ClipRecord, Manifest

MOST_NAMED = 8  # skipped files that are named on the screen; the manifest lists all


def show_manifest(manifest: Manifest) -> None:
    """Print the parts, frame rates and skipped files of a cache, and what is doubtful about its split."""
    table = Table("part")
    for name in ("clips", "frames", "hours"):
        table.add_column(name, justify="right")
    for part, total in manifest.totals.items():
        table.add_row(part, f"{total['clips']:.0f}", f"{total['frames']:.0f}", f"{total['hours']:.3f}")
    Console(highlight=False).print(table)
    for source in manifest.sources:
        show_source(manifest, source)
    show_rates(manifest.clips, manifest.interpolation)
    show_skipped([f"{file.file}: {file.reason}" for file in manifest.skipped])
    show_files(manifest.ignored, manifest.passed_over, manifest.links, manifest.unusual)
    show_pairs("left out, since another part has the same frames or some of them", manifest.duplicates)
    left_out = sum(manifest.left_out.values())
    click.echo(
        f"{len(manifest.clips)} clips; skipped {len(manifest.skipped)}, left out by the split {left_out}, "
        f"listed but missing {len(manifest.missing)}; body {manifest.body}"
    )
    names = [clip.name for clip in manifest.clips]
    for said in filter(None, (divided_remark(manifest), unmatched_patterns_remark(manifest.split, names))):
        click.echo(said)
    if not manifest.coverage.whole:
        click.echo(f"{manifest.coverage}: {manifest.coverage.gaps}")


def show_source(manifest: Manifest, source: str) -> None:
    """Print how many clips and hours of one source are in each part."""
    clips = [clip for clip in manifest.clips if source_of(clip.name) == source]
    parts = [(part, [clip.length for clip in clips if clip.split == part]) for part in manifest.totals]
    words = [f"{part} {len(lengths)} clips, {sum(lengths) / FPS / 3600:.3f} h" for part, lengths in parts]
    click.echo(f"{source}: {'; '.join(words)}")


def show_rates(clips: tuple[ClipRecord, ...], interpolation: str = "") -> None:
    """Print the frame rates that were found, and how each was brought to 60 Hz; by which interpolation."""
    for (fps, how), count in sorted(Counter((clip.fps, clip.resampling) for clip in clips).items()):
        by = f" by {interpolation}" if interpolation and how == INTERPOLATED else ""
        click.echo(f"{count} clips at {fps:g} Hz: {how}{by}")


def show_files(
    ignored: int, passed_over: Mapping[str, int], links: Mapping[str, str], unusual: Mapping[str, str]
) -> None:
    """Print what else is in a folder: files that are no clips, links, and clips that look odd."""
    others = {"npz without poses": ignored, **dict(sorted(passed_over.items()))}
    counts = [f"{count} {kind}" for kind, count in others.items() if count]
    if counts:
        click.echo(f"passed over: {', '.join(counts)}")
    show_pairs("taken once, since the other path is a link", links)
    show_pairs("unusual", unusual, ": ")


def show_pairs(what: str, pairs: Mapping[str, str], sign: str = " = ") -> None:
    """Print the first few pairs of names, and the number of the others."""
    for first, second in list(pairs.items())[:MOST_NAMED]:
        click.echo(f"{what}: {one_line(first)}{sign}{one_line(second)}")
    if len(pairs) > MOST_NAMED:
        click.echo(f"{what}: {len(pairs) - MOST_NAMED} more")


def show_skipped(lines: list[str]) -> None:
    """Print the first few skipped files and the number of the others."""
    show_some([f"skipped {line}" for line in lines], "skipped")


def show_some(lines: list[str], what: str) -> None:
    """Print the first few lines, and the number of further ones."""
    for line in lines[:MOST_NAMED]:
        click.echo(line)
    if len(lines) > MOST_NAMED:
        click.echo(f"{len(lines) - MOST_NAMED} more {what}")


def show_exported(report: ExportReport, out: Path) -> None:
    """Print what an export skipped, what is odd of the others, and how much it wrote."""
    show_skipped([f"{file.file}: {file.reason}" for file in report.skipped])
    show_pairs("unusual", report.unusual, ": ")
    click.echo(f"{amount(len(report.written), report.seconds)}, in {out}")


def amount(clips: int, seconds: float) -> str:
    """Return a number of clips and their length together, in words."""
    length = f"{seconds / 60:.1f} minutes" if seconds >= 60 else f"{seconds:.1f} seconds"
    return f"{clips} clip{'s' * (clips != 1)}, {length}"
