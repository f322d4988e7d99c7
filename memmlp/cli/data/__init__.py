"""`memmlp data`: make, import, verify, prepare, inspect and export motion."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.data.importing import import_, skeleton, verify
from memmlp.cli.data.printing import (
    show_exported,
    show_files,
    show_manifest,
    show_pairs,
    show_rates,
    show_skipped,
)
from memmlp.cli.options import PATH, Finite, body_option, format_option, strict_option
from memmlp.common.errors import InputError


@click.group("data")
def data() -> None:
    """Make, import, look at, prepare and export motion data."""


data.add_command(import_)
data.add_command(skeleton)
data.add_command(verify)


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

    if next(out.rglob("*.npz"), None):
        raise InputError(f"--out {out}: has clips already; expected a new folder, or one without npz")
    paths = synthesize(out, minutes=minutes, seed=seed, fps=fps)
    click.echo(f"{len(paths)} clips, {minutes:g} minutes, in {out}")


@data.command("show")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="The sheet, a .png.")
@click.option("--clips", default=12, show_default=True, type=click.IntRange(1, 200), help="Clips at most.")
@body_option
def show(source: Path, out: Path, clips: int, body: str) -> None:
    """Draw clips of a folder of npz files, or one clip, each at three moments.

    The clips are spread evenly over the folder's files in the order of their names.
    """
    from memmlp.common.files import atomic_write
    from memmlp.report.pictures.clip_pictures import check_picture
    from memmlp.report.pictures.clip_sheet import draw_sheet, read_sample
    from memmlp.report.pictures.drawing import encode_png

    check_picture(out, "--out", (".png",))
    shown, skipped, total = read_sample(source, clips, body)
    show_skipped(skipped)
    atomic_write(out, encode_png(draw_sheet(shown)))
    click.echo(f"{len(shown)} of {total} clips: {out}")


@data.command("prepare")
@click.argument("root", type=PATH)
@click.option("--out", required=True, type=PATH, help="Folder of the cache.")
@click.option("--body", help="builtin, or an SMPL-H model.npz.")
@click.option(
    "--split", default="seeded", show_default=True, help="seeded, s2, or lists:FOLDER (AGRoL's format)."
)
@click.option("--val", type=float, help="Fraction for validation.")
@click.option("--test", type=float, help="Fraction for testing, with --split seeded.")
@click.option("--seed", type=int)
@click.option(
    "--group", multiple=True, metavar="REGEX", help="Clips that match stay on one side; repeatable."
)
@click.option("--min-frames", type=int, help="Shorter clips (at 60 Hz) are skipped.")
@click.option(
    "--interpolation",
    type=click.Choice(["splines", "lines"]),
    help="Between frames of other rates than 60 Hz.",
)
@strict_option
def prepare(
    root: Path,
    out: Path,
    body: str | None,
    split: str,
    val: float | None,
    test: float | None,
    seed: int | None,
    group: tuple[str, ...],
    min_frames: int | None,
    interpolation: str | None,
    strict: bool,
) -> None:
    """Write the cache of a folder of AMASS npz.

    The cache is memory-mappable, and has a manifest with the outcome for each file. It is for custom code:
    memmlp train makes its own cache of data.root. Without an option, the setting is that of memmlp train with
    data=mocap for --split seeded, data=amass_s2 for s2 and data=amass_s1 for lists.
    """
    from omegaconf import OmegaConf

    from memmlp.config.build_motion import build_motion
    from memmlp.config.compose import composed
    from memmlp.motion.preparing.cache import prepare as prepare_cache

    protocols, lists = {"seeded": "mocap", "s2": "amass_s2"}, None
    if split.startswith("lists:"):
        protocol, lists = "amass_s1", split.removeprefix("lists:")
    elif split in protocols:
        protocol = protocols[split]
    else:
        raise InputError(f"--split {split}: must be seeded, s2 or lists:FOLDER")
    if test is not None and split != "seeded":
        raise InputError(f"--test {test:g}: needs --split seeded; --split {split} has its own test part")
    given = {
        "root": str(root), "body": body, "min_frames": min_frames, "strict": strict, "split.val": val,
        "split.test": test, "split.seed": seed, "split.groups": list(group) or None, "split.folder": lists,
        "interpolation": interpolation,
    }  # fmt: skip
    cfg = composed([f"data={protocol}", "data.root=.", *(["data.split.folder=."] if lists else [])])
    for key, value in given.items():
        if value is not None:
            OmegaConf.update(cfg, f"data.{key}", value)
    show_manifest(prepare_cache(build_motion(cfg).clips, out))


@data.command("inspect")
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
    show_skipped(found.skipped)
    show_files(found.ignored, found.found.passed_over, found.found.links, found.unusual)
    show_pairs("the same frames, or some of them", found.duplicates)
    show_rates(found.clips)
    frames = sum(clip.length for clip in found.clips)
    click.echo(f"{len(found.clips)} clips, {frames / 216000:.2f} h, {len(found.skipped)} bad files")


@data.command("export")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="A file for a file, a folder for a folder.")
@format_option
@body_option
@click.option("--fps", type=Finite(1, 1000), metavar="HZ", help="Resample the clips.  [default: their rate]")
@strict_option
def export(source: Path, out: Path, format_: str | None, body: str, fps: float | None, strict: bool) -> None:
    """Write AMASS npz as BVH or glTF.

    SOURCE is an npz file or a folder of npz files. BVH is in centimetres, glTF in metres, both with Y up; npz
    (AMASS' layout, hands at rest) is for another frame rate.
    """
    from memmlp.motion.exporting import export as export_clips
    from memmlp.motion.exporting import plan_export

    show_exported(export_clips(plan_export(source, out, format_), body=body, fps=fps, strict=strict), out)
