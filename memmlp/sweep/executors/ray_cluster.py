"""Workers that are tasks of a Ray cluster."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.errors import InputError, why_unreadable
from memmlp.sweep.executors.executor import Work
from memmlp.sweep.executors.gpus import VISIBLE

KEYS = ("address", "num_cpus", "num_gpus", "memory_gb", "accelerator_type", "runtime_env", "resources.NAME")


@dataclass(frozen=True)
class RayOptions:
    """Which cluster is used, and what each worker requests from it.

    Attributes:
        address: the cluster's address; None for the address in RAY_ADDRESS, or else a cluster on this
            machine.
        num_gpus: GPUs of a worker, less than 1 if several workers share one; None for 1 if the cluster has
            GPUs.
        task: Ray's other options of a task.
        runtime_env: Ray's description of the environment in which workers run.
    """

    address: str | None = None
    num_gpus: float | None = None
    task: Mapping[str, Any] = field(default_factory=dict)
    runtime_env: Mapping[str, Any] = field(default_factory=dict)


def ray_options(words: Mapping[str, str]) -> RayOptions:
    """Return the options in the words `ray.KEY=VALUE` of a command line.

    Raises:
        InputError: for an unknown key or a value of the wrong kind.
    """
    task: dict[str, Any] = {"num_cpus": 1.0}
    resources = {}
    for key, value in words.items():
        if key.startswith("resources."):
            resources[key.removeprefix("resources.")] = _number(key, value)
        elif key == "num_cpus":
            task[key] = _number(key, value)
        elif key == "memory_gb":
            task["memory"] = _number(key, value) * 2**30
        elif key == "accelerator_type":
            task[key] = value
        elif key not in KEYS:
            raise InputError(f"ray.{key}: no such key; allowed here: {', '.join(KEYS)}")
    return RayOptions(
        address=words.get("address"),
        num_gpus=_number("num_gpus", words["num_gpus"]) if "num_gpus" in words else None,
        task=task | ({"resources": resources} if resources else {}),
        runtime_env=_runtime_env(Path(words["runtime_env"])) if "runtime_env" in words else {},
    )


def _number(key: str, value: str) -> float:
    if value.replace(".", "", 1).isdecimal():
        return float(value)
    raise InputError(f"ray.{key}={value}: allowed is a number, at least 0")


def _runtime_env(path: Path) -> Mapping[str, Any]:
    """Read a runtime environment from a YAML file."""
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"ray.runtime_env={path}: {why_unreadable(error)}") from None
    if not isinstance(found, dict):
        raise InputError(f"ray.runtime_env={path}: allowed is a YAML file of Ray's keys, such as env_vars")
    return found


class RayTask:
    """A worker that is a task in Ray."""

    def __init__(self, reference: Any):
        self.reference = reference

    def alive(self) -> bool:
        """Return whether the task is waiting or working; False on a dead node."""
        import ray

        return not ray.wait([self.reference], timeout=0)[0]

    def cancel(self) -> None:
        """End the task."""
        import ray

        ray.cancel(self.reference, force=True)

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""
        import ray

        try:
            return ray.get(self.reference)
        except ray.exceptions.RayError:
            return None


class Ray:
    """Starts workers as tasks of a Ray cluster: a running one, or one on this machine.

    Args:
        options: the cluster, and what each worker requests from it.
        gpus: whether workers get GPUs, if the options leave it open.

    Raises:
        InputError: if Ray is not installed or the cluster can't be reached.
    """

    def __init__(self, options: RayOptions, gpus: bool = True):
        try:
            import ray
        except ImportError:
            raise InputError("executor=ray: Ray is not installed; pip install 'memmlp[ray]'") from None
        if not ray.is_initialized():
            _connect(options)
        there = ray.cluster_resources()
        least = 1.0 if gpus and there.get("GPU") else 0.0
        self.num_gpus = least if options.num_gpus is None else options.num_gpus
        asked = {"GPU": self.num_gpus, "CPU": options.task["num_cpus"], **options.task.get("resources", {})}
        for name in (name for name, amount in asked.items() if amount > there.get(name, 0)):
            # A cluster that grows by itself may get it.
            _say(f"a worker asks for {asked[name]:g} {name}, of which the cluster has {there.get(name, 0):g}")
        self.gpus = self.num_gpus > 0
        # A task that is run again by Ray would be one beside the worker that replaces it.
        self.task = {**options.task, "num_gpus": self.num_gpus, "max_retries": 0, "max_calls": 1}

    def submit(self, work: Work, count: int = 1) -> list[RayTask]:
        """Start workers."""
        import ray

        task = ray.remote(**self.task)(_with_gpus if self.gpus else _without_gpus)
        return [RayTask(task.remote(work)) for _ in range(count)]


def _connect(options: RayOptions) -> None:
    """Join the cluster that the options name. Raises InputError if it can't be reached."""
    import ray

    quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
    own = {} if options.address or os.environ.get("RAY_ADDRESS") else {"include_dashboard": False}
    logging.getLogger("ray").setLevel(logging.ERROR)
    try:
        ray.init(options.address, runtime_env=dict(options.runtime_env) or None, **quiet, **own)
    except (ConnectionError, RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"executor=ray: {' '.join(str(error).split())}") from None


def _say(line: str) -> None:
    print(f"memmlp: executor=ray: {line}; they wait until it has more", file=sys.stderr, flush=True)


def _with_gpus(work: Work) -> str | None:
    """Do the work with the GPUs that Ray gave to the task."""
    return work()


def _without_gpus(work: Work) -> str | None:
    """Do the work without GPUs, even if Ray shows some to a task that asked for none."""
    os.environ[VISIBLE] = ""
    return work()
