"""`memmlp bench loggers`: how much slower a training is while loggers show it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import click

from memmlp.runs.run import Run


@click.command("loggers")
@click.option("--blocks", default=40, show_default=True, help="How many pieces of the training are timed.")
@click.option("--steps", default=25, show_default=True, help="Length of a piece, training steps.")
@click.option("--uri", help="MLflow's store, such as a dead or slow server.  [default: a sqlite file]")
@click.argument("overrides", nargs=-1)
def loggers(blocks: int, steps: int, uri: str | None, overrides: tuple[str, ...]) -> None:
    """Time a training that is shown in loggers, by pieces.

    In every other piece the process that shows it is stopped, so that the ratio of neighbours tells what it
    costs, whatever else the machine does. OVERRIDES are those of `memmlp train`; the default is profile=small
    memory=no_codes and loggers=mlflow. It is all done in a temporary folder.
    """
    import tempfile

    import numpy as np

    from memmlp.config.build import build_experiment
    from memmlp.config.compose import composed
    from memmlp.experiment_tracking.follower_pipe import feed_of
    from memmlp.pipeline.run_stages import train_run

    address = [f"loggers.mlflow.uri={uri}"] if uri else []
    length = [f"optim.steps={(blocks + 3) * steps}", f"optim.log_every={steps}"]  # two pieces warm up
    with tempfile.TemporaryDirectory() as folder:
        words = ["profile=small", "memory=no_codes", f"paths.outputs={folder}", *length, *address, *overrides]
        experiment = build_experiment(composed(words))
        feed = feed_of(experiment.loggers)
        follower = feed.process
        run = PiecewiseRun(Path(folder) / "runs" / ("0" * 16), follower.pid if follower else None)
        with experiment.loggers.following(run):
            train_run(experiment, run, experiment.motion.prepare(), None)
        feed.close()
        if follower is not None:
            follower.kill()  # its folder goes
            follower.wait()
    pieces = np.array(run.seconds[2 : 2 + blocks // 2 * 2]).reshape(-1, 2)
    ratios = pieces[:, 0] / pieces[:, 1]
    low, high = np.quantile(ratios, (0.25, 0.75))
    click.echo(f"{steps} steps: {np.median(pieces[:, 0]):.3f} s shown, {np.median(pieces[:, 1]):.3f} s not")
    click.echo(f"ratio {np.median(ratios):.4f} (half of {len(ratios)} pairs: {low:.4f} to {high:.4f})")


class PiecewiseRun(Run):
    """A run that times its training between lines of its log, and pauses a process in every other piece.

    Args:
        folder: the run's folder.
        pid: the process; None for none.
    """

    def __init__(self, folder: Path, pid: int | None):
        super().__init__(folder)
        self.pid = pid
        self.seconds: list[float] = []
        self.since = time.perf_counter()

    def log(self, step: int, values: Mapping[str, float], phase: str = "train") -> None:
        """Log the values; after those of a training step, note its time, and pause or resume the follower."""
        super().log(step, values, phase)
        if phase == "train":
            self.seconds.append(time.perf_counter() - self.since)
            self._signal(signal.SIGSTOP if len(self.seconds) % 2 else signal.SIGCONT)
            self.since = time.perf_counter()

    def finish(self, artifacts: Sequence[str]) -> None:
        """Finish the run, after resuming the process."""
        super().finish(artifacts)
        self._signal(signal.SIGCONT)

    def _signal(self, which: signal.Signals) -> None:
        if self.pid is not None:
            os.kill(self.pid, which)
