"""Sizes and times of untrained networks, for tables that show only costs."""

import tempfile
from collections.abc import Mapping
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.progress import show_progress
from memmlp.config.build import build_deployment, build_untrained
from memmlp.config.compose import compose_config
from memmlp.deploy.deployment import GRAPHS, Deployment
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import MeasuredRun, measure_untrained
from memmlp.runs.environment import describe_environment
from memmlp.sweep.definition import COSTS, SIZES, Sweep


def measure_untrained_variants(
    sweep: Sweep, runs: Mapping[str, RunsBySeed]
) -> tuple[dict[str, RunsBySeed], tuple[str, ...]]:
    """Measure an untrained network for each variant of a sweep without a finished run; times only if the
    sweep shows one. Return all runs by variant and seed, and flags that name these variants. Raises
    InputError if the sweep's metrics include errors (`check_costs`)."""
    check_costs(sweep)
    timed = not set(sweep.metrics) <= set(SIZES)
    without = [variant for variant in sweep.list_runnable() if not runs[variant.label]]
    costs: dict[str, RunsBySeed] = {}
    with show_progress("networks", len(without)) as count:
        for variant in without:
            count.set_note(variant.label)  # a large network takes minutes
            costs[variant.label] = {
                sweep.get_seeds(variant)[0]: measure_costs(sweep.merge_overrides(variant), timed)
            }
            count.advance()
    names = ", ".join(f"'{label}'" for label in costs)
    flags = (f"networks that were not trained, with random weights: {names}",) if costs else ()
    return {label: dict(costs.get(label, found)) for label, found in runs.items()}, flags


def check_costs(sweep: Sweep) -> None:
    """Raise InputError if a sweep's metrics include errors, which need trained networks."""
    if beyond := [metric for metric in sweep.metrics if metric not in COSTS]:
        wrong = f"--untrained: sweep {sweep.name} shows {', '.join(beyond)}"
        raise InputError(f"{wrong}; expected only metrics from {', '.join(COSTS)}")


def measure_costs(overrides: tuple[str, ...], timed: bool) -> MeasuredRun:
    """Measure a network with random weights, and the ONNX file of its live step; times only if `timed`."""
    from memmlp.deploy.export import export  # slow to import
    from memmlp.deploy.latency import measure_size
    from memmlp.live.pose_latency import measure_pose_times

    deployment = build_deployment(compose_config(list(overrides))) or Deployment(latency_steps=1)
    model = build_untrained(overrides)
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
