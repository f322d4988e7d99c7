"""Costs of networks that were not trained, for tables that show only costs: their sizes and times."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.progress import show_progress
from memmlp.config.build import build_deployment, untrained
from memmlp.config.compose import composed
from memmlp.deploy.deployment import GRAPHS, Deployment
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import MeasuredRun, measure_untrained
from memmlp.runs.environment import describe_environment
from memmlp.sweep.definition import COSTS, SIZES, Sweep


def with_costs(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> tuple[dict[str, RunsBySeed], tuple[str, ...]]:
    """Measure untrained networks for a sweep's variants that have no finished run.

    Times are measured only if the sweep's table shows any.

    Returns:
        The runs by variant and seed, including those networks, and flags that say so.

    Raises:
        InputError: as `check_costs` does.
    """
    check_costs(sweep)
    timed = not set(sweep.metrics) <= set(SIZES)
    without = [variant for variant in sweep.runnable() if not runs[variant.label]]
    costs: dict[str, RunsBySeed] = {}
    with show_progress("networks", len(without)) as count:
        for variant in without:
            count.set_note(variant.label)  # a large one takes minutes
            costs[variant.label] = {
                sweep.seeds_of(variant)[0]: measure_costs(sweep.all_overrides(variant), timed)
            }
            count.advance()
    names = ", ".join(f"'{label}'" for label in costs)
    flags = (f"networks that were not trained, with random weights: {names}",) if costs else ()
    return {label: dict(costs.get(label, found)) for label, found in runs.items()}, flags


def check_costs(sweep: Sweep) -> None:
    """Check that a sweep's table shows only costs. Raises InputError if it needs runs."""
    if beyond := [metric for metric in sweep.metrics if metric not in COSTS]:
        raise InputError(
            f"--untrained: sweep {sweep.name} shows {', '.join(beyond)}; "
            f"must be a table of only {', '.join(COSTS)}"
        )


def measure_costs(overrides: tuple[str, ...], timed: bool) -> MeasuredRun:
    """Measure the network for some overrides, with random weights, and the ONNX file of its live step.

    Args:
        overrides: the config's overrides.
        timed: whether its steps are timed, too, as a run's deployment times them.
    """
    from memmlp.deploy.export import export  # slow to import
    from memmlp.deploy.latency import measure_size
    from memmlp.live.pose_latency import measure_pose_times

    deployment = build_deployment(composed(list(overrides))) or Deployment(latency_steps=1)
    model = untrained(overrides)
    network = GRAPHS[deployment.graph](model)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.onnx"
        export(network, path, "untrained")
        record = measure_size(model, network, path)
        if timed:
            record |= deployment.measure_times(model, path) | measure_pose_times(
                path, deployment.latency_steps
            )
    return measure_untrained(overrides, record, describe_environment() | {"device": "cpu", "body": "builtin"})
