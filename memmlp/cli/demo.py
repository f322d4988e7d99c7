"""`memmlp demo`: the whole pipeline on synthetic motion."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.common.text_formats import join_command

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

    Then the demo trains RecurrentPoser, this project's own network, and compares both networks. OVERRIDES are
    those of `memmlp train`, for example profile=tiny. The demo trains only one network if you choose a model,
    or if RecurrentPoser does not support an override.
    """
    from memmlp.cli.train_summary import show_side_by_side
    from memmlp.runs.lookup import count_training_frames, warn_if_hardly_trained

    started = time.monotonic()
    both = is_valid_for_recurrent_poser(overrides)  # checked before the first network trains for minutes
    outcomes = train_demo(overrides) + (train_demo([*overrides, RECURRENT_POSER]) if both else [])
    if len(outcomes) == len(NETWORKS):
        show_side_by_side(dict(zip(NETWORKS, outcomes, strict=True)))
        for remark in dict.fromkeys(
            filter(None, (warn_if_hardly_trained(count_training_frames(one.run)) for one in outcomes))
        ):
            click.echo(remark)
    click.echo(f"the demo took {(time.monotonic() - started) / 60:.1f} minutes")
    click.echo(describe_next_steps(overrides, find_inactive_environment(), [one.run.id for one in outcomes]))


def is_valid_for_recurrent_poser(overrides: Sequence[str]) -> bool:
    """Return whether a demo with these overrides can also train RecurrentPoser.

    It can if the overrides do not choose a network and are valid with RecurrentPoser.
    """
    from memmlp.common.errors import InputError
    from memmlp.config.compose import compose_jobs, parse_hydra_arguments

    if any(word.startswith(("model=", "experiment=", "-")) for word in overrides):
        return False
    try:
        compose_jobs(parse_hydra_arguments(["data=synth", "profile=small", *overrides, RECURRENT_POSER]))
    except InputError:
        return False
    return True


def train_demo(overrides: Sequence[str]) -> list[Outcome]:
    """Finish the run with these overrides, then print and return its results."""
    from memmlp.cli.train import run_training, train

    outcomes: list[Outcome] = []

    def job(cfg: DictConfig) -> None:
        if outcome := run_training(cfg):
            outcomes.append(outcome)

    train(["data=synth", "profile=small", *overrides], job)
    return outcomes


def describe_next_steps(
    overrides: Sequence[str], environment: Path | None = None, runs: Sequence[str] = ()
) -> str:
    """Return commands that the user can try next, as a text.

    Args:
        overrides: the demo's overrides, to repeat in the commands.
        environment: the folder of a virtual environment to activate first; None if none is needed.
        runs: ids of the demo's runs. With two ids, the first command draws the motion of both networks.
    """
    command = join_command(["memmlp", "train", *overrides, "memory=none"])
    kept = [word for word in overrides if word.startswith(("profile=", "threads=", "device="))]
    lines = [
        f"{command}          the same network without its memory; then memmlp runs list",
        "memmlp data import BVH_FOLDER --out outputs/data/mine",
        join_command(["memmlp", "train", *kept, "data=mocap", "data.root=outputs/data/mine"]),
    ]
    if len(runs) > 1:
        lines.insert(0, join_command(["memmlp", "render", *runs, *LABELS, "--to", "3", "--out", "both.gif"]))
    if environment:
        lines.insert(0, join_command(["source", str(environment / "bin" / "activate")]))
    return "next: " + "\n      ".join(lines)


def find_inactive_environment() -> Path | None:
    """Return the folder of this Python's virtual environment, or None if the shell has activated it."""
    here = Path(sys.prefix)
    path = shutil.which("memmlp")
    inside = path is not None and Path(path).parent == here / "bin"
    return None if inside or not (here / "bin" / "activate").exists() else here
