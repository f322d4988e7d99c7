"""`memmlp demo`: the whole pipeline on synthetic motion."""

from __future__ import annotations

import time

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
    click.echo("next: memmlp train memory=none          the same without the memory; then memmlp runs list")
    click.echo("      memmlp data import BVH_FOLDER --out outputs/data/mine")
    click.echo("      memmlp train data=mocap data.root=outputs/data/mine")
