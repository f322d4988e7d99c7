"""What lets other Python processes import the very modules that this one does."""

from __future__ import annotations

import contextlib
import os
import site
import sys
import sysconfig
from collections.abc import Iterator


def child_imports() -> dict[str, str]:
    """Return the environment variables by which another Python process searches modules where this one does.

    Without them, `python -m` looks into the working folder first, where another copy of the package may lie:
    a run would silently be made by other code than the command that asked for it.

    What an interpreter finds by itself is left out. A job may start another one on its way (`conda activate`
    on a cluster), which would take this one's standard library for its own.
    """
    given = [os.path.abspath(path) for path in sys.path if not _found_by_itself(path)]
    return {"PYTHONPATH": os.pathsep.join(given), "PYTHONSAFEPATH": "1"}


def _found_by_itself(path: str) -> bool:
    """Return whether a path of the search is the standard library, or where packages are installed."""
    if path in (*site.getsitepackages(), site.getusersitepackages()):
        return True
    library = sysconfig.get_path("stdlib")
    zipped = f"python{sys.version_info.major}{sys.version_info.minor}.zip"
    return path == library or path.startswith(library + os.sep) or os.path.basename(path) == zipped


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
