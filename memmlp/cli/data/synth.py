"""`memmlp data synth`: procedural motion."""

from __future__ import annotations

from pathlib import Path

import click

from memmlp.cli.options import PATH
from memmlp.common.errors import InputError


@click.command("synth")
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
        raise InputError(f"--out {out}: has clips already; allowed is a new folder, or one without npz")
    paths = synthesize(out, minutes=minutes, seed=seed, fps=fps)
    click.echo(f"{len(paths)} clips, {minutes:g} minutes, in {out}")
