"""Prints clips, frame rates and skipped files for users."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import click
from rich.table import Table

from memmlp.common.errors import escape_line_breaks
from memmlp.common.text_formats import make_console
from memmlp.motion.body import FPS
from memmlp.motion.clip import INTERPOLATED, SkippedFile
from memmlp.motion.preparing.find_clips import get_source_name
from memmlp.motion.preparing.groups import describe_divided_folders, describe_unmatched_patterns

if TYPE_CHECKING:
    from pathlib import Path

    from memmlp.motion.exporting import ExportReport
    from memmlp.motion.preparing.manifest import ClipRecord, Manifest

MAX_NAMES = 8  # maximum number of skipped files to print; the manifest lists all files


def show_manifest(manifest: Manifest) -> None:
    from memmlp.motion.preparing.manifest import find_copies  # numpy is slow to import

    table = Table("part")
    for name in ("clips", "frames", "hours"):
        table.add_column(name, justify="right")
    for part, total in manifest.totals.items():
        table.add_row(part, str(total.clips), str(total.frames), f"{total.hours:.3f}")
    make_console().print(table)
    for source in manifest.sources:
        clips = tuple(clip for clip in manifest.clips if get_source_name(clip.name) == source)
        totals = replace(manifest, clips=clips).totals.items()
        parts = [f"{part} {total.clips} clips, {total.hours:.3f} h" for part, total in totals]
        click.echo(f"{source}: {'; '.join(parts)}")
    if manifest.split["kind"] == "persons":
        show_persons(manifest)
    show_rates(manifest.clips, manifest.interpolation)
    show_skipped(manifest.skipped)
    show_pairs("unusual", manifest.unusual, ": ")
    show_pairs("some or all of the motion is the same", find_copies(manifest.clips))
    show_pairs("left out because another part contains some of its motion", manifest.duplicates)
    left_out = sum(manifest.left_out.values())
    click.echo(
        f"{len(manifest.clips)} clips; skipped {len(manifest.skipped)}, left out by the split {left_out}, "
        f"listed but missing {len(manifest.missing)}; body {manifest.body}"
    )
    names = [clip.name for clip in manifest.clips]
    for remark in (describe_divided_folders(manifest), describe_unmatched_patterns(manifest.split, names)):
        if remark:
            click.echo(remark)
    if not manifest.coverage.is_complete:
        click.echo(f"{manifest.coverage}: {manifest.coverage.gap_description}")


def show_persons(manifest: Manifest) -> None:
    clips: dict[tuple[str, str], list[int]] = defaultdict(list)
    for clip in manifest.clips:
        clips[clip.split, clip.group].append(clip.length)
    table = Table("part", "person")
    for name in ("clips", "minutes"):
        table.add_column(name, justify="right")
    for (part, person), own in sorted(clips.items()):
        table.add_row(part, person, str(len(own)), f"{sum(own) / FPS / 60:.1f}")
    make_console().print(table)


def show_rates(clips: tuple[ClipRecord, ...], interpolation: str = "") -> None:
    for (fps, method), count in sorted(Counter((clip.fps, clip.resampling) for clip in clips).items()):
        detail = f" by {interpolation}" if interpolation and method == INTERPOLATED else ""
        click.echo(f"{count} clips at {fps:g} Hz: {method}{detail}")


def show_pairs(label: str, pairs: Mapping[str, str], sign: str = " = ") -> None:
    show_some(
        [f"{label}: {escape_line_breaks(a)}{sign}{escape_line_breaks(b)}" for a, b in pairs.items()], label
    )


def show_skipped(skipped: Sequence[SkippedFile], limit: int | None = MAX_NAMES) -> None:
    show_some([f"skipped {file.file}: {file.reason}" for file in skipped], "skipped", limit)


def show_some(lines: list[str], label: str, limit: int | None = MAX_NAMES) -> None:
    for line in lines[:limit]:
        click.echo(line)
    if more := len(lines) - len(lines[:limit]):
        click.echo(f"{more} more {label}")


def show_exported(report: ExportReport, out: Path) -> None:
    show_skipped(report.skipped)
    show_pairs("unusual", report.unusual, ": ")
    click.echo(f"{describe_amount(len(report.written), report.seconds)}, in {out}")


def describe_amount(clips: int, seconds: float) -> str:
    length = f"{seconds / 60:.1f} minutes" if seconds >= 60 else f"{seconds:.1f} seconds"
    return f"{clips} clip{'s' * (clips != 1)}, {length}"
