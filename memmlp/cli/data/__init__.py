"""`memmlp data`: make, import, verify, prepare, inspect and export motion."""

from pathlib import Path

import click

from memmlp.cli.data.importing import import_, skeleton, verify
from memmlp.cli.data.printing import show_exported, show_manifest, show_pairs, show_rates, show_skipped
from memmlp.cli.options import (
    PATH,
    FiniteFloat,
    body_option,
    format_option,
    overrides_argument,
    strict_option,
)
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write


@click.group("data")
def data() -> None:
    """Make, import, look at, prepare and export motion data."""


data.add_command(import_)
data.add_command(skeleton)
data.add_command(verify)


@data.command("synth")
@click.option("--out", required=True, type=PATH, help="Folder for the clips.")
@click.option("--minutes", default=10.0, help="Total length of all clips.")
@click.option("--seed", default=0)
@click.option("--fps", default=60.0, help="Frame rate of the clips.")
def synth(out: Path, minutes: float, seed: int, fps: float) -> None:
    """Write procedural motion as AMASS npz.

    The clips show walking, squats, reaching and other movements.
    """
    from memmlp.motion.preparing.find_clips import find_files
    from memmlp.motion.synthetic import synthesize

    if find_files(out, ".npz").files:
        raise InputError(f"--out {out}: already has clips; expected a folder without npz files")
    paths = synthesize(out, minutes=minutes, seed=seed, fps=fps)
    click.echo(f"{len(paths)} clips, {minutes:g} minutes, in {out}")


@data.command("show")
@click.argument("source", type=PATH)
@click.option("--out", required=True, type=PATH, help="PNG file to write.")
@click.option("--clips", default=12, type=click.IntRange(1, 200), help="Maximum number of clips.")
@body_option
def show(source: Path, out: Path, clips: int, body: str) -> None:
    """Draw clips, each at three moments.

    SOURCE is an npz file or a folder of npz files. The clips are evenly spaced in the sorted list of files.
    """
    from memmlp.report.pictures.clip_pictures import check_picture_path
    from memmlp.report.pictures.drawing import encode_png
    from memmlp.report.pictures.import_pictures import draw_sheet, read_sample

    check_picture_path(out, "--out", (".png",))
    shown, skipped, total = read_sample(source, clips, body)
    show_skipped(skipped)
    atomic_write(out, encode_png(draw_sheet(shown)))
    click.echo(f"{len(shown)} of {total} clips: {out}")


@data.command("prepare")
@click.argument("root", type=PATH)
@overrides_argument
@click.option("--out", required=True, type=PATH, help="Folder for the cache.")
def prepare(root: Path, overrides: tuple[str, ...], out: Path) -> None:
    """Prepare a folder of AMASS npz files as a memory-mappable cache for custom code.

    The cache's manifest has the outcome for each file. `memmlp train` does not need this command, because it
    makes its own cache of data.root. The overrides are those of `memmlp train`; the default is data=mocap.
    """
    from memmlp.config.build_request import build_motion
    from memmlp.config.compose import compose_checked
    from memmlp.motion.preparing.cache import prepare_cache

    has_protocol = any(override.startswith("data=") for override in overrides)
    config = compose_checked([*([] if has_protocol else ["data=mocap"]), *overrides, "data.root=."]).resolved
    config["data"]["root"] = str(root)
    show_manifest(prepare_cache(build_motion(config).clips, out, overwrite=False))


@data.command("inspect")
@click.argument("path", type=PATH)
def inspect(path: Path) -> None:
    """Show clips, hours, frame rates, unusual clips, copies and bad files.

    PATH is a cache or a folder of npz files. For a cache, the command also shows the split.
    """
    from memmlp.motion.preparing.manifest import MANIFEST, Manifest, Total
    from memmlp.motion.preparing.survey import survey_folder

    if (path / MANIFEST).is_file():
        show_manifest(Manifest.load(path))
        return
    content = survey_folder(path)
    show_skipped(content.skipped, limit=None)  # no manifest lists them
    show_pairs("unusual", content.unusual, ": ")
    show_pairs("some or all of the motion is the same", content.duplicates)
    show_rates(content.clips)
    hours = Total(len(content.clips), sum(clip.length for clip in content.clips)).hours
    click.echo(f"{len(content.clips)} clips, {hours:.2f} h, {len(content.skipped)} bad files")


@data.command("export")
@click.argument("source", type=PATH)
@click.option(
    "--out",
    required=True,
    type=PATH,
    help="File to write if SOURCE is a file, or folder if SOURCE is a folder.",
)
@format_option
@body_option
@click.option(
    "--fps", type=FiniteFloat(1, 1000), metavar="HZ", help="Frame rate to resample to.  [default: unchanged]"
)
@strict_option
def export(source: Path, out: Path, format_: str | None, body: str, fps: float | None, strict: bool) -> None:
    """Convert AMASS npz files to BVH or glTF, or to another frame rate.

    SOURCE is an npz file or a folder of npz files. BVH is in centimetres and glTF in metres, both with Y up.
    The output format npz has AMASS' layout, with the hands at rest.
    """
    from memmlp.motion.exporting import export as export_clips
    from memmlp.motion.exporting import plan_export

    show_exported(export_clips(plan_export(source, out, format_), body=body, fps=fps, strict=strict), out)
