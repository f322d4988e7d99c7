"""`memmlp data inspect`: the content of a cache or of a folder of clips."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.data.printing import show_files, show_manifest, show_pairs, show_rates, show_skipped
from memmlp.cli.options import PATH


@click.command("inspect")
@click.argument("path", type=PATH)
def inspect(path: Path) -> None:
    """Show clips, hours, rates and bad files.

    PATH is a cache, whose splits are shown too, or a folder of npz files.
    """
    from memmlp.motion.preparing.manifest import MANIFEST, Manifest
    from memmlp.motion.preparing.survey import survey

    if (path / MANIFEST).is_file():
        show_manifest(Manifest.load(path))
        return
    found = survey(path)
    show_skipped([f"{file.file}: {file.reason}" for file in found.skipped])
    show_files(found.ignored, found.found.passed_over, found.found.links, found.unusual)
    show_pairs("the same frames, or some of them", found.duplicates)
    show_rates(found.clips)
    frames = sum(clip.length for clip in found.clips)
    click.echo(f"{len(found.clips)} clips, {frames / 216000:.2f} h, {len(found.skipped)} bad files")
