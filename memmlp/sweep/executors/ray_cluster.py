"""Workers that are tasks of a Ray cluster."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.errors import InputError, describe_read_error, import_optional
from memmlp.sweep.executors import Work, parse_amount
from memmlp.sweep.executors.local import VISIBLE


def _read_runtime_env(path: str) -> Mapping[str, Any]:
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(describe_read_error(error)) from None
    if not isinstance(content, dict):
        raise ValueError("expected a YAML file with keys of Ray's runtime environment, such as env_vars")
    return content


SETTINGS: Mapping[str, Callable[[str], Any]] = {
    "address": str,
    "num_cpus": parse_amount,
    "num_gpus": parse_amount,
    "memory_gb": parse_amount,
    "accelerator_type": str,
    "runtime_env": _read_runtime_env,
    "resources.NAME": parse_amount,
}
"""The settings `ray.KEY`. `address`: the cluster's address, by default RAY_ADDRESS, else a new local cluster.
`runtime_env`: a YAML file that describes Ray's runtime environment. The others: the resources of each worker;
`num_gpus` may be a fraction."""


class RayTask:
    """A worker that is a task in Ray."""

    def __init__(self, ray: Any, reference: Any):
        self.ray, self.reference = ray, reference

    def alive(self) -> bool:
        """Return whether the task is waiting or working; False if its node is dead."""
        return not self.ray.wait([self.reference], timeout=0)[0]

    def cancel(self) -> None:
        """End the task."""
        self.ray.cancel(self.reference, force=True)

    def complaint(self) -> str | None:
        """Return the line that explains why the worker could not work; None after any other end."""
        try:
            return self.ray.get(self.reference)
        except self.ray.exceptions.RayError:
            return None


class Ray:
    """Starts workers as tasks of a running Ray cluster, or of a new cluster on this machine.

    Args:
        options: the parsed SETTINGS.
        gpus: whether each worker gets a GPU if the cluster has GPUs; the option `num_gpus` has priority.

    Raises:
        InputError: if Ray is not installed or the cluster cannot be reached.
    """

    def __init__(self, options: Mapping[str, Any], gpus: bool = True):
        self.ray: Any = import_optional("ray", "ray", "executor=ray")
        if not self.ray.is_initialized():
            self._connect(options)
        resources = self.ray.cluster_resources()
        default = 1.0 if gpus and resources.get("GPU") else 0.0
        self.num_gpus = options.get("num_gpus", default)
        num_cpus = options.get("num_cpus", 1.0)
        self.gpus = self.num_gpus > 0
        self.task = {key: options[key] for key in ("accelerator_type", "resources") if key in options}
        if "memory_gb" in options:
            self.task["memory"] = options["memory_gb"] * 2**30
        # Ray must not repeat tasks, because the fleet already replaces dead workers.
        self.task |= {"num_cpus": num_cpus, "num_gpus": self.num_gpus, "max_retries": 0, "max_calls": 1}

    def _connect(self, options: Mapping[str, Any]) -> None:
        quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
        if not options.get("address") and not os.environ.get("RAY_ADDRESS"):
            quiet["include_dashboard"] = False
        logging.getLogger("ray").setLevel(logging.ERROR)
        try:
            self.ray.init(options.get("address"), runtime_env=options.get("runtime_env") or None, **quiet)
        except (ConnectionError, RuntimeError, ValueError, TypeError) as error:
            raise InputError(f"executor=ray: {' '.join(str(error).split())}") from None

    def submit(self, work: Work, count: int = 1) -> list[RayTask]:
        """Start workers."""
        task = self.ray.remote(**self.task)(_work_with_gpus if self.gpus else _work_without_gpus)
        return [RayTask(self.ray, task.remote(work)) for _ in range(count)]


def _work_with_gpus(work: Work) -> str | None:
    return work()


def _work_without_gpus(work: Work) -> str | None:
    os.environ[VISIBLE] = ""  # Ray may show GPUs to a task that did not request any
    return work()
