"""`memmlp demo`: the whole pipeline on synthetic motion."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from memmlp.training.request import Outcome

NETWORKS = ("Mem-MLP", "RecurrentPoser")
RECURRENT_POSER = "model=recurrent_poser"
LABELS = [word for name in NETWORKS for word in ("--label", name)]


@click.command("demo")
@click.argument("overrides", nargs=-1)
def demo(overrides: tuple[str, ...]) -> None:
    """Run synthetic motion -> VQ-VAE -> Mem-MLP -> metrics -> ONNX -> latency, in minutes, on the CPU.

    RecurrentPoser, this project's own network, follows, and both are shown side by side. OVERRIDES are those
    of `memmlp train`, for example profile=tiny. With another model, or overrides that RecurrentPoser does not
    have, only the first network is trained.
    """
    from memmlp.cli.train_summary import show_side_by_side
    from memmlp.runs.lookup import count_training_frames, warn_if_hardly_trained

    started = time.monotonic()
    both = fits_recurrent_poser(overrides)  # before the minutes of the first network
    outcomes = train_demo(overrides) + (train_demo([*overrides, RECURRENT_POSER]) if both else [])
    if len(outcomes) == len(NETWORKS):
        show_side_by_side(dict(zip(NETWORKS, outcomes, strict=True)))
        for remark in dict.fromkeys(
            filter(None, (warn_if_hardly_trained(count_training_frames(one.run)) for one in outcomes))
        ):
            click.echo(remark)
    click.echo(f"the demo took {(time.monotonic() - started) / 60:.1f} minutes")
    click.echo(next_steps(overrides, inactive_environment(), [one.run.id for one in outcomes]))


def fits_recurrent_poser(overrides: Sequence[str]) -> bool:
    """Return whether a demo's overrides leave the network open, and are valid for RecurrentPoser, too."""
    from memmlp.common.errors import InputError
    from memmlp.config.compose import parse, preflight

    if any(word.startswith(("model=", "experiment=", "-")) for word in overrides):
        return False
    try:
        preflight(parse(["data=synth", "profile=small", *overrides, RECURRENT_POSER]))
    except InputError:
        return False
    return True


def train_demo(overrides: Sequence[str]) -> list[Outcome]:
    """Finish the run with these overrides, show its results and return them."""
    from memmlp.cli.train import run_training, train

    outcomes: list[Outcome] = []

    def job(cfg: DictConfig) -> None:
        if outcome := run_training(cfg):
            outcomes.append(outcome)

    train(["data=synth", "profile=small", *overrides], job)
    return outcomes


def next_steps(overrides: Sequence[str], environment: Path | None = None, runs: Sequence[str] = ()) -> str:
    """Return the commands to try next, with the demo's settings.

    Args:
        overrides: the demo's overrides, which the same network without its memory needs, too.
        environment: the folder of a virtual environment that this shell has not activated, or None.
        runs: ids of the demo's runs; two of them are drawn beside the truth.
    """
    command = shlex.join(["memmlp", "train", *overrides, "memory=none"])
    kept = [shlex.quote(word) for word in overrides if word.startswith(("profile=", "threads=", "device="))]
    lines = [
        f"{command}          the same without the memory; then memmlp runs list",
        "memmlp data import BVH_FOLDER --out outputs/data/mine",
        " ".join(["memmlp train", *kept, "data=mocap data.root=outputs/data/mine"]),
    ]
    if len(runs) > 1:
        lines.insert(0, shlex.join(["memmlp", "render", *runs, *LABELS, "--to", "3", "--out", "both.gif"]))
    if environment:
        lines.insert(0, f"source {shlex.quote(str(environment / 'bin' / 'activate'))}")
    return "next: " + "\n      ".join(lines)


def inactive_environment() -> Path | None:
    """Return the folder of this Python's virtual environment if the shell has not activated it, else None."""
    here = Path(sys.prefix)
    path = shutil.which("memmlp")
    inside = path is not None and Path(path).parent == here / "bin"
    return None if inside or not (here / "bin" / "activate").exists() else here
