"""Executors start workers: processes, jobs of a Slurm cluster, or tasks of Ray or Dask.

The workers settle among themselves which of them does which run (`memmlp.sweep.worker`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from memmlp.common.errors import InputError

Work = Callable[[], str | None]
"""A worker's work. It returns None at its end, or a line that says why this worker could do no work."""


class Handle(Protocol):
    """A worker that an executor started."""

    def alive(self) -> bool:
        """Return whether the worker is waiting or working."""

    def cancel(self) -> None:
        """End the worker."""

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""


class Executor(Protocol):
    """Starts workers.

    Attributes:
        gpus: whether each worker gets a GPU.
    """

    gpus: bool

    def submit(self, work: Work, count: int = 1) -> Sequence[Handle]:
        """Start `count` workers; `work` must be picklable, and importable on the workers' machines."""


def parse_settings(
    executor: str, settings: Mapping[str, str], parsers: Mapping[str, Callable[[str], Any]]
) -> dict[str, Any]:
    """Return the parsed values of an executor's settings EXECUTOR.KEY=VALUE, by key.

    Args:
        executor: the executor's name.
        settings: the settings as they were given.
        parsers: by key what parses its value, or raises ValueError with what it must be. A key "GROUP.NAME"
            stands for any name; the values of such a group are a dict.

    Raises:
        InputError: for an unknown key or a value of the wrong kind.
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
    """Return the number in a text. Raises ValueError for a text that is not a number, or one below 0."""
    if not text.replace(".", "", 1).isdecimal():
        raise ValueError("must be a number, at least 0")
    return float(text)
