"""`memmlp data prepare`: the cache of a folder of clips."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.data.printing import show_manifest
from memmlp.cli.options import PATH
from memmlp.common.errors import InputError


@click.command("prepare")
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
@click.option("--strict", is_flag=True, help="Stop at the first bad file instead of skipping it.")
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

    The cache is memory-mappable, and has a manifest of what became of each file. It is for code of your own:
    memmlp train makes itself one of data.root. What no option says is as in memmlp train, with data=mocap for
    --split seeded, data=amass_s2 for s2 and data=amass_s1 for lists.
    """
    from omegaconf import OmegaConf

    from memmlp.config.build_motion import build_motion
    from memmlp.config.compose import composed
    from memmlp.motion.preparing.cache import prepare as run

    data, lists = _protocol(split)
    if test is not None and split != "seeded":
        raise InputError(f"--test {test:g}: goes with --split seeded; with --split {split} allowed is none")
    given = {
        "root": str(root), "body": body, "min_frames": min_frames, "strict": strict, "split.val": val,
        "split.test": test, "split.seed": seed, "split.groups": list(group) or None, "split.folder": lists,
        "interpolation": interpolation,
    }  # fmt: skip
    cfg = composed([f"data={data}", "data.root=.", *(["data.split.folder=."] if lists else [])])
    for key, value in given.items():
        if value is not None:
            OmegaConf.update(cfg, f"data.{key}", value)
    show_manifest(run(build_motion(cfg).clips, out))


def _protocol(split: str) -> tuple[str, str | None]:
    """Return the option of `data` that --split names, and the folder of its lists, if it has any.

    Raises:
        InputError: for an unknown name.
    """
    if split.startswith("lists:"):
        return "amass_s1", split.removeprefix("lists:")
    if split not in (known := {"seeded": "mocap", "s2": "amass_s2"}):
        raise InputError(f"--split {split}: no such split; allowed: seeded, s2, lists:FOLDER")
    return known[split], None
