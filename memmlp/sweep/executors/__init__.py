"""Executors start workers: processes, jobs of a Slurm cluster, or tasks of Ray.

Each worker chooses its runs itself (`memmlp.sweep.worker`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from memmlp.common.errors import InputError

Work = Callable[[], str | None]
"""The function that a worker calls. It returns None, or a line that explains why it could not work."""


class Handle(Protocol):
    """A worker that an executor started."""

    def alive(self) -> bool:
        """Return whether the worker is waiting or working."""

    def cancel(self) -> None:
        """End the worker."""

    def complaint(self) -> str | None:
        """Return the line that explains why the worker could not work; None after any other end."""


class Executor(Protocol):
    """Starts workers.

    Attributes:
        gpus: whether each worker gets a GPU.
    """

    gpus: bool

    def submit(self, work: Work, count: int = 1) -> Sequence[Handle]:
        """Start `count` workers. `work` must be picklable, and importable on the workers' machines."""


def parse_settings(
    executor: str, settings: Mapping[str, str], parsers: Mapping[str, Callable[[str], Any]]
) -> dict[str, Any]:
    """Return the parsed values of an executor's settings EXECUTOR.KEY=VALUE, by key.

    Args:
        executor: the executor's name.
        settings: the texts of the values by key.
        parsers: a function for each key, which parses the value or raises ValueError. A key "GROUP.NAME"
            accepts any name; the result has a dict of the group's values.

    Raises:
        InputError: for an unknown key or an invalid value.
    """
    parsed: dict[str, Any] = {}
    for key, text in settings.items():
        group, dot, name = key.partition(".")
        parse = parsers.get(f"{group}.NAME" if dot else key)
        if parse is None:
            raise InputError(f"{executor}.{key}: no such key; expected one of {', '.join(parsers)}")
        try:
            value = parse(text)
        except ValueError as error:
            raise InputError(f"{executor}.{key}={text}: {error}") from None
        if dot:
            parsed.setdefault(group, {})[name] = value
        else:
            parsed[key] = value
    return parsed


def parse_amount(text: str) -> float:
    """Return the number in a text. Raises ValueError unless the text is a number of at least 0."""
    if not text.replace(".", "", 1).isdecimal():
        raise ValueError("must be a number of at least 0")
    return float(text)
