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

from memmlp.common.errors import InputError, require, why_unreadable
from memmlp.sweep.executors import Work
from memmlp.sweep.executors.local import VISIBLE

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


def ray_options(settings: Mapping[str, str]) -> RayOptions:
    """Return the options that `ray.KEY=VALUE` on a command line set.

    Raises:
        InputError: for an unknown key or a value of the wrong kind.
    """
    task: dict[str, Any] = {"num_cpus": 1.0}
    resources = {}
    for key, value in settings.items():
        if key.startswith("resources."):
            resources[key.removeprefix("resources.")] = _number(key, value)
        elif key == "num_cpus":
            task[key] = _number(key, value)
        elif key == "memory_gb":
            task["memory"] = _number(key, value) * 2**30
        elif key == "accelerator_type":
            task[key] = value
        elif key not in KEYS:
            raise InputError(f"ray.{key}: no such key; expected one of {', '.join(KEYS)}")
    return RayOptions(
        address=settings.get("address"),
        num_gpus=_number("num_gpus", settings["num_gpus"]) if "num_gpus" in settings else None,
        task=task | ({"resources": resources} if resources else {}),
        runtime_env=_runtime_env(Path(settings["runtime_env"])) if "runtime_env" in settings else {},
    )


def _number(key: str, value: str) -> float:
    if value.replace(".", "", 1).isdecimal():
        return float(value)
    raise InputError(f"ray.{key}={value}: must be a number, at least 0")


def _runtime_env(path: Path) -> Mapping[str, Any]:
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"ray.runtime_env={path}: {why_unreadable(error)}") from None
    if not isinstance(found, dict):
        raise InputError(f"ray.runtime_env={path}: expected a YAML file of Ray's keys, such as env_vars")
    return found


class RayTask:
    """A worker that is a task in Ray."""

    def __init__(self, ray: Any, reference: Any):
        self.ray, self.reference = ray, reference

    def alive(self) -> bool:
        """Return whether the task is waiting or working; False on a dead node."""
        return not self.ray.wait([self.reference], timeout=0)[0]

    def cancel(self) -> None:
        """End the task."""
        self.ray.cancel(self.reference, force=True)

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""
        try:
            return self.ray.get(self.reference)
        except self.ray.exceptions.RayError:
            return None


class Ray:
    """Starts workers as tasks of a Ray cluster: a running one, or one on this machine.

    Args:
        options: the cluster, and what each worker requests from it.
        gpus: whether workers get GPUs, if the options do not say so.

    Raises:
        InputError: if Ray is not installed or the cluster can't be reached.
    """

    def __init__(self, options: RayOptions, gpus: bool = True):
        self.ray: Any = require("ray", "ray", "executor=ray")
        if not self.ray.is_initialized():
            self._connect(options)
        there = self.ray.cluster_resources()
        least = 1.0 if gpus and there.get("GPU") else 0.0
        self.num_gpus = least if options.num_gpus is None else options.num_gpus
        asked = {"GPU": self.num_gpus, "CPU": options.task["num_cpus"], **options.task.get("resources", {})}
        for name, amount in asked.items():
            if amount > there.get(name, 0):  # a cluster that grows by itself may get it
                print(
                    f"memmlp: executor=ray: a worker asks for {amount:g} {name}, of which the cluster has "
                    f"{there.get(name, 0):g}; workers wait until it has more",
                    file=sys.stderr,
                    flush=True,
                )
        self.gpus = self.num_gpus > 0
        # A task that is run again by Ray would be one beside the worker that replaces it.
        self.task = {**options.task, "num_gpus": self.num_gpus, "max_retries": 0, "max_calls": 1}

    def _connect(self, options: RayOptions) -> None:
        quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
        if not options.address and not os.environ.get("RAY_ADDRESS"):
            quiet["include_dashboard"] = False
        logging.getLogger("ray").setLevel(logging.ERROR)
        try:
            self.ray.init(options.address, runtime_env=dict(options.runtime_env) or None, **quiet)
        except (ConnectionError, RuntimeError, ValueError, TypeError) as error:
            raise InputError(f"executor=ray: {' '.join(str(error).split())}") from None

    def submit(self, work: Work, count: int = 1) -> list[RayTask]:
        """Start workers."""
        task = self.ray.remote(**self.task)(_work_with_gpus if self.gpus else _work_without_gpus)
        return [RayTask(self.ray, task.remote(work)) for _ in range(count)]


def _work_with_gpus(work: Work) -> str | None:
    return work()


def _work_without_gpus(work: Work) -> str | None:
    os.environ[VISIBLE] = ""  # Ray may show some to a task that asked for none
    return work()
