"""Remarks on the data before a run, and warnings in its manifest for tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from memmlp.motion.body import FPS
from memmlp.motion.clip import LINES, Skipped
from memmlp.motion.motion_source import Prepared
from memmlp.motion.preparing.amass_names import absent_subsets
from memmlp.motion.preparing.groups import divided_remark, unmatched_patterns_remark
from memmlp.motion.preparing.manifest import ClipRecord, Manifest

SLOW = 0.99  # of the network's rate; 59.94 Hz counts as 60


def data_remarks(data: Prepared) -> list[str]:
    """Return what the user should know of the data before a run begins."""
    manifest = data.manifest
    every = (
        skipped_remark(manifest.skipped),
        unusual_remark(manifest.unusual),
        low_rates_remark(manifest, manifest.clips, "clips"),
        divided_remark(manifest),
        unmatched_patterns_remark(manifest.split, [clip.name for clip in manifest.clips]),
    )
    return list(filter(None, every))


def tested_clips_remark(clips: Sequence[ClipRecord]) -> str:
    """Say how many test clips and groups there are, and whether they are too few for conclusions."""
    tested = [clip.group for clip in clips if clip.split == "test"]
    counts = f"test clips: {len(tested)}, in groups: {len(set(tested))}"
    if len(set(tested)) > 1:
        return counts
    return f"{counts}, too few to compare networks; use more motion or a larger data.split.test"


def low_rates_remark(manifest: Manifest, clips: Sequence[ClipRecord], what: str) -> str | None:
    """Return a remark on clips with a low frame rate that were interpolated linearly; None without any.

    Linear interpolation makes kinks in the motion.

    Args:
        manifest: the data's manifest.
        clips: some or all of its clips.
        what: their name in the plural.
    """
    rates = sorted(clip.fps for clip in clips if clip.fps < SLOW * FPS)
    if not rates or manifest.interpolation != LINES:
        return None
    hertz = f"{rates[0]:g}" + (f" to {rates[-1]:g}" if rates[-1] > rates[0] else "")
    slow = f"{len(rates)} of {len(clips)} {what} were recorded at {hertz} Hz"
    return f"{slow} and are interpolated linearly (data.interpolation): the kinks enter Jitter and velocities"


def skipped_remark(skipped: Sequence[Skipped]) -> str | None:
    """Return a remark on skipped files; None without any."""
    if not skipped:
        return None
    files = "1 file was" if len(skipped) == 1 else f"{len(skipped)} files were"
    first = skipped[0]
    return f"{files} skipped, first {first.file} ({first.reason}); data.strict=true stops there"


def unusual_remark(unusual: Mapping[str, str]) -> str | None:
    """Return a remark on clips that are unusual but may be correct (name -> why); None without any."""
    if not unusual:
        return None
    clips = "1 clip is" if len(unusual) == 1 else f"{len(unusual)} clips are"
    first, *others = list(unusual)[:3]
    names = ", ".join([f"{first} ({unusual[first]})", *others])
    return f"{clips} unusual, first {names}; details: memmlp data inspect"


def unusual_tests_remark(unusual: Mapping[str, str], tested: Sequence[ClipRecord]) -> str | None:
    """Return a remark on unusual test clips; None without any."""
    odd = [clip.name for clip in tested if clip.name in unusual]
    if not odd:
        return None
    return f"{len(odd)} of {len(tested)} test clips are unusual, first {odd[0]} ({unusual[odd[0]]})"


def data_warnings(config: Mapping[str, Any], data: Prepared) -> dict[str, Any]:
    """Return warnings about a run's data for tables to flag, in words; None for each that does not apply.

    Args:
        config: the run's config.
        data: its prepared data.
    """
    manifest = data.manifest
    tested = [clip for clip in manifest.clips if clip.split == "test"]
    return {
        "partial": partial_words(config, data),
        "divided": divided_remark(manifest) or None,
        "resampled": low_rates_remark(manifest, tested, "test clips"),
        "unusual": unusual_tests_remark(manifest.unusual, tested),
    }


def partial_words(config: Mapping[str, Any], data: Prepared) -> str | None:
    """Describe what the data lacks of its protocol or of its training clips; None if it is complete."""
    own, manifest = config["data"], data.manifest
    coverage, found = manifest.coverage, manifest.listed or (*manifest.left_out, *manifest.groups)
    fraction = own["split"].get("train_fraction", 1)
    parts = [] if coverage.whole else [str(coverage)]
    parts += [absent] if (absent := absent_subsets(own["name"], found)) else []
    parts += [f"{100 * fraction:g} % of its training groups"] if fraction < 1 else []
    return ", ".join([own["name"], *parts]) if parts else None
