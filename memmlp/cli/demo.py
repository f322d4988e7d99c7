"""`memmlp demo`: the whole pipeline on synthetic motion."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import click


@click.command("demo")
@click.argument("overrides", nargs=-1)
def demo(overrides: tuple[str, ...]) -> None:
    """Run synthetic motion -> VQ-VAE -> Mem-MLP -> metrics -> ONNX -> latency, in minutes, on the CPU.

    OVERRIDES are those of `memmlp train`, for example profile=tiny.
    """
    from memmlp.cli.train import train

    started = time.monotonic()
    train(["data=synth", "profile=small", *overrides])
    click.echo(f"the demo took {(time.monotonic() - started) / 60:.1f} minutes")
    click.echo(next_steps(overrides, unentered()))


def next_steps(overrides: Sequence[str], environment: Path | None = None) -> str:
    """Return the commands to try next, which train as the demo did.

    Args:
        overrides: those of the demo, which the same network without its memory needs, too.
        environment: the folder of an environment that this shell has not entered; None for none.
    """
    words = " ".join(map(shlex.quote, ["memmlp", "train", *overrides, "memory=none"]))
    enter = [f"source {shlex.quote(str(environment / 'bin' / 'activate'))}"] if environment else []
    lines = [
        *enter,
        f"{words}          the same without the memory; then memmlp runs list",
        "memmlp data import BVH_FOLDER --out outputs/data/mine",
        " ".join(["memmlp train", *sizes(overrides), "data=mocap data.root=outputs/data/mine"]),
    ]
    return "next: " + "\n      ".join(lines)


def sizes(overrides: Sequence[str]) -> list[str]:
    """Return the words among the overrides that choose the profile."""
    return [shlex.quote(word) for word in overrides if word.startswith("profile=")]


def unentered() -> Path | None:
    """Return the folder of the environment of this Python, where the shell would not find its commands."""
    here = Path(sys.prefix)
    found = shutil.which("memmlp")
    inside = found is not None and Path(found).parent == here / "bin"
    return None if inside or not (here / "bin" / "activate").exists() else here
