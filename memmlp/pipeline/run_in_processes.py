"""A run brought to its end in this process alone, or in those of torchrun, of which the first leads."""

from __future__ import annotations

from memmlp.common import distributed
from memmlp.common.errors import InputError
from memmlp.pipeline.experiment import Experiment
from memmlp.pipeline.run_stages import Outcome, run_experiment
from memmlp.runs.run import Run


def run_in_processes(experiment: Experiment) -> Outcome | None:
    """Bring the experiment's run to its end; without torchrun, this is `run_experiment`.

    The first process holds the run's lock, prepares the data, writes files, evaluates and deploys. It tells
    the other processes which stage all of them train next.

    Returns:
        The outcome in the first process, None in the others.
    """
    if experiment.unrefined and distributed.size() > 1:
        raise InputError("refiner: several processes can't train it; allowed is one process, or refiner=null")
    distributed.connect(experiment.device.type)
    if not distributed.first():
        _train_along(experiment)
        return None
    outcome = run_experiment(experiment)
    distributed.broadcast("end")
    distributed.leave()
    return outcome


def _train_along(experiment: Experiment) -> None:
    """Train the stages that the first process names, until it says that it is at the end."""
    while (stage := distributed.broadcast("")) != "end":
        data = experiment.motion.prepare()  # the first process has prepared it
        chain = [*experiment.upstream_identities(data.digest), experiment.identity(data.digest)]
        runs = [Run.of(experiment.outputs, identity.id) for identity in chain]
        number = [identity.kind for identity in chain].index(stage)
        training = (*experiment.upstream, experiment.training)[number]
        weights = runs[number - 1].weights() if number else None
        training.train(experiment.architecture, data, weights, runs[number], experiment.device)
    distributed.leave()
