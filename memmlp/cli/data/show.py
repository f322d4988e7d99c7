"""Clips, frame rates and skipped files as people read them."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from memmlp.motion.preparing.manifest import ClipRecord, Manifest

SHOWN = 8  # skipped files that are named on the screen; the manifest lists all


def show_manifest(manifest: Manifest) -> None:
    """Print the parts, frame rates and skipped files of a cache."""
    table = Table("part")
    for name in ("clips", "frames", "hours"):
        table.add_column(name, justify="right")
    for part, total in manifest.totals.items():
        table.add_row(part, f"{total['clips']:.0f}", f"{total['frames']:.0f}", f"{total['hours']:.3f}")
    Console(highlight=False).print(table)
    show_rates(manifest.clips)
    show_skipped([f"{file.file}: {file.reason}" for file in manifest.skipped])
    left_out = sum(manifest.left_out.values())
    click.echo(
        f"{len(manifest.clips)} clips; skipped {len(manifest.skipped)}, left out by the split {left_out}, "
        f"listed but missing {len(manifest.missing)}; body {manifest.body}"
    )
    if not manifest.coverage.whole:
        click.echo(f"{manifest.coverage}: {manifest.coverage.gaps}")


def show_rates(clips: tuple[ClipRecord, ...]) -> None:
    """Print the frame rates that were found, and how each was brought to 60 Hz."""
    for (fps, how), count in sorted(Counter((clip.fps, clip.resampling) for clip in clips).items()):
        click.echo(f"{count} clips at {fps:g} Hz: {how}")


def show_skipped(lines: list[str]) -> None:
    """Print the first few skipped files and the number of the others."""
    show_some([f"skipped {line}" for line in lines], "skipped")


def show_some(lines: list[str], what: str) -> None:
    """Print the first few lines, and how many more of them there are."""
    for line in lines[:SHOWN]:
        click.echo(line)
    if len(lines) > SHOWN:
        click.echo(f"{len(lines) - SHOWN} more {what}")
