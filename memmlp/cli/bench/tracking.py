"""`memmlp bench tracking`: what it costs a training to be shown in trackers."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import click

if TYPE_CHECKING:
    from pathlib import Path

    from memmlp.pipeline.experiment import Experiment


class Cost(NamedTuple):
    """What a training took: seconds, and seconds of this process on the processor."""

    wall: float
    processor: float


@click.command("tracking")
@click.option("--rounds", default=3, show_default=True, help="How often each way is timed, the two in turn.")
@click.option("--steps", default=1000, show_default=True, help="Length of each training.")
@click.option(
    "--uri", help="MLflow's store, such as a server that is dead or slow.  [default: a sqlite file]"
)
@click.argument("overrides", nargs=-1)
def tracking(rounds: int, steps: int, uri: str | None, overrides: tuple[str, ...]) -> None:
    """Time trainings that are shown in trackers against the same that are not.

    Printed is the ratio. OVERRIDES are those of `memmlp train`; the default is profile=small memory=no_codes,
    and tracking=mlflow. It is all done in a temporary folder.
    """
    import tempfile
    from pathlib import Path

    import numpy as np

    from memmlp.config.build import build_experiment
    from memmlp.config.compose import composed

    address = [f"tracking.mlflow.uri={uri}"] if uri else []
    with tempfile.TemporaryDirectory() as folder:
        place = f"paths.outputs={folder}"
        words = ["profile=small", "memory=no_codes", place, f"optim.steps={steps}", *address, *overrides]
        experiment = build_experiment(composed(words))
        pairs = []
        timed(experiment, Path(folder), 99, False)  # the first one warms up
        for number in range(rounds):
            ways = (timed(experiment, Path(folder), 2 * number + way, bool(way)) for way in (0, 1))
            pairs.append(tuple(ways))
            click.echo(
                f"round {number + 1}: {pairs[-1][0].wall:.2f} s without, {pairs[-1][1].wall:.2f} s with"
            )
    for column, name in enumerate(("seconds", "of the processor")):
        before, after = (np.array([pair[way][column] for pair in pairs]) for way in (0, 1))
        ratios = after / before
        click.echo(
            f"{name:16s} {np.median(before):8.2f} without, {np.median(after):8.2f} with: ratio "
            f"{np.median(ratios):.4f} ({ratios.min():.4f} to {ratios.max():.4f} over {rounds} rounds)"
        )


def timed(experiment: Experiment, outputs: Path, number: int, shown: bool) -> Cost:
    """Train a network anew and return what it took, from its run's beginning to its end."""
    import time
    from contextlib import nullcontext

    from memmlp.pipeline.run_stages import train_run
    from memmlp.runs.run import Run

    run, data = Run.of(outputs, f"{number:016x}"), experiment.data.prepare()
    start, processor = time.perf_counter(), time.process_time()
    with experiment.tracking.following(run) if shown else nullcontext():
        train_run(experiment, run, data, None)
    return Cost(time.perf_counter() - start, time.process_time() - processor)
