"""Sizes of networks that were not trained, for tables that show nothing else."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.progress import progress_bar
from memmlp.config.build import build_deployment, untrained
from memmlp.config.compose import composed
from memmlp.deploy.deployment import GRAPHS
from memmlp.runs.environment import environment
from memmlp.sweep.spec import SIZES, Sweep
from memmlp.tables.effects import Runs
from memmlp.tables.measured_run import Measured, of_untrained


def with_sizes(sweep: Sweep, runs: Mapping[str, Runs]) -> tuple[dict[str, Runs], tuple[str, ...]]:
    """Measure untrained networks for a sweep's arms that have no finished run.

    Returns:
        The runs by arm and seed, those networks among them, and flags that say so.

    Raises:
        InputError: as `check_sizes` does.
    """
    check_sizes(sweep)
    without = [arm for arm in sweep.runnable() if not runs[arm.label]]
    sizes = {
        arm.label: {sweep.seeds_of(arm)[0]: size_of(sweep.overrides(arm))}
        for arm in progress_bar(without, "sizes", len(without))
    }
    names = ", ".join(f"'{label}'" for label in sizes)
    flags = (f"sizes of networks that were not trained: {names}",) if sizes else ()
    return {label: dict(sizes.get(label, found)) for label, found in runs.items()}, flags


def check_sizes(sweep: Sweep) -> None:
    """Check that a sweep's table shows sizes alone. Raises InputError where it needs runs."""
    if beyond := [metric for metric in sweep.metrics if metric not in SIZES]:
        raise InputError(
            f"--untrained: sweep {sweep.name} shows {', '.join(beyond)}; "
            f"allowed are tables of {', '.join(SIZES)} alone"
        )


def size_of(overrides: tuple[str, ...]) -> Measured:
    """Measure the network of some overrides, with random weights, and the ONNX file of its live step."""
    from memmlp.deploy.export import export  # slow to import
    from memmlp.deploy.latency import size

    deployment = build_deployment(composed(list(overrides)))
    model = untrained(overrides)
    network = GRAPHS[deployment.graph if deployment else "auto"](model)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.onnx"
        export(network, path, "untrained")
        record = size(model, network, path)
    return of_untrained(overrides, record, environment() | {"device": "cpu", "body": "builtin"})
