"""`memmlp data prepare`: the cache of a folder of clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.data.printing import show_manifest
from memmlp.cli.options import PATH
from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.motion.preparing.splits import Split


@click.command("prepare")
@click.argument("root", type=PATH)
@click.option("--out", required=True, type=PATH, help="Folder of the cache.")
@click.option("--body", default="builtin", show_default=True, help="builtin, or an SMPL-H model.npz.")
@click.option(
    "--split", default="seeded", show_default=True, help="seeded, s2, or lists:FOLDER (AGRoL's format)."
)
@click.option("--val", default=0.1, show_default=True, help="Fraction for validation.")
@click.option("--test", type=float, help="Fraction for testing, with --split seeded.  [default: 0.1]")
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
    test: float | None,
    seed: int,
    group: tuple[str, ...],
    min_frames: int,
    strict: bool,
) -> None:
    """Write the cache of a folder of AMASS npz.

    The cache is memory-mappable, and has a manifest of what became of each file. It is for code of your own:
    memmlp train makes itself one of data.root.
    """
    from memmlp.motion.preparing.cache import ClipFolder
    from memmlp.motion.preparing.cache import prepare as run

    chosen = _split(split, val, test, seed, group)
    show_manifest(run(ClipFolder(root, chosen, body, min_frames, strict), out))


def _split(name: str, val: float, test: float | None, seed: int, groups: tuple[str, ...]) -> Split:
    """Return the split that --split names.

    Raises:
        InputError: for an unknown name, or a fraction for testing where a list says what is tested on.
    """
    from memmlp.motion.preparing.amass import S2_TEST, S2_TRAIN
    from memmlp.motion.preparing.splits import ListSplit, SeededSplit, SubsetSplit

    if name == "seeded":
        return SeededSplit(0.1 if test is None else test, val, seed, groups)
    if test is not None:
        raise InputError(f"--test {test:g}: goes with --split seeded; with --split {name} allowed is none")
    if name == "s2":
        return SubsetSplit(S2_TRAIN, S2_TEST, val, seed, groups)
    if name.startswith("lists:"):
        return ListSplit(Path(name.removeprefix("lists:")), val, seed, groups)
    raise InputError(f"--split {name}: no such split; allowed: seeded, s2, lists:FOLDER")
