"""`memmlp demo`: the whole pipeline on synthetic motion."""

from __future__ import annotations

import sys
import time

import click


@click.command("demo")
@click.argument("overrides", nargs=-1)
def demo(overrides: tuple[str, ...]) -> None:
    """Run synthetic motion -> VQ-VAE -> Mem-MLP -> metrics -> ONNX -> latency, in minutes, on the CPU.

    OVERRIDES are those of `memmlp train`, for example profile=tiny.
    """
    from memmlp.cli.train import train
    from memmlp.common.progress import telling_stages

    started = time.monotonic()
    with telling_stages(tell):
        train(["data=synth", "profile=small", *overrides])
    click.echo(f"the demo took {(time.monotonic() - started) / 60:.1f} minutes")
    click.echo("next: memmlp train memory=none          the same without the memory; then memmlp runs list")
    click.echo("      memmlp data import BVH_FOLDER --out outputs/data/mine")
    click.echo("      memmlp train data=mocap data.root=outputs/data/mine")


def tell(line: str) -> None:
    """Write what begins on stderr, unless that is a terminal, which has progress bars."""
    if not sys.stderr.isatty():
        click.echo(line, err=True)
