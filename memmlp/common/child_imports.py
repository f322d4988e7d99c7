"""What lets other Python processes import the very modules that this one does."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator


def child_imports() -> dict[str, str]:
    """Return the environment variables by which another Python process searches modules where this one does.

    Without them, `python -m` looks into the working folder first, where another copy of the package may lie:
    a run would silently be made by other code than the command that asked for it.
    """
    return {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)), "PYTHONSAFEPATH": "1"}


@contextlib.contextmanager
def children_import_the_same() -> Iterator[None]:
    """Have the environment of `child_imports` within the context, for libraries that pass on this one's."""
    before = {name: os.environ.get(name) for name in child_imports()}
    os.environ.update(child_imports())
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
