"""`memmlp bench stream`: the speed of evaluating many clips side by side in stream mode."""

from __future__ import annotations

import click


@click.command("stream")
@click.option("--clips", default=64, show_default=True, help="How many clips are evaluated side by side.")
@click.option("--frames", default=60, show_default=True, help="Length of each clip, frames.")
@click.option(
    "--rounds", default=3, show_default=True, help="How many rounds are timed, the two ways in turn."
)
@click.option("--device", default="cpu", show_default=True, type=click.Choice(["cpu", "cuda"]))
@click.argument("overrides", nargs=-1)
def stream(clips: int, frames: int, rounds: int, device: str, overrides: tuple[str, ...]) -> None:
    """Time stream evaluation.

    Clips side by side are timed against clip by clip: milliseconds a frame of motion, and the ratio.
    OVERRIDES are those of `memmlp train`; the default is profile=paper. Weights are random.
    """
    import time

    import numpy as np
    import torch

    from memmlp.config.build import untrained
    from memmlp.evaluation.modes import stream as run
    from memmlp.motion.body import FRAME_DIM

    model = untrained(("profile=paper", *overrides)).to(device)
    motion = list(0.1 * torch.randn(clips, frames, FRAME_DIM, device=device))

    def milliseconds(parts: list[list[torch.Tensor]]) -> float:
        start = time.perf_counter()
        for part in parts:
            run(model, part)[0].sum().item()
        return 1000 * (time.perf_counter() - start) / (frames * sum(len(part) for part in parts))

    alone, together = [], []
    for _ in range(rounds + 1):  # the first round warms up
        together.append(milliseconds([motion]))
        alone.append(milliseconds([[clip] for clip in motion[:4]]))
    ratios = np.array(alone[1:]) / np.array(together[1:])
    click.echo(f"clip by clip      {np.median(alone[1:]):8.3f} ms a frame")
    click.echo(f"{clips:3d} side by side  {np.median(together[1:]):8.3f} ms a frame")
    click.echo(
        f"ratio {np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f} over {rounds} rounds)"
    )
