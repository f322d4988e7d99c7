"""Real recordings, which are not part of the project."""

import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import shared
from filelock import FileLock

DATA = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def database(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of an archive's files, unpacked once for all processes."""
    folder = shared(tmp_path_factory, "databases")

    def unpacked(name: str) -> Path:
        archive, out = next(DATA.glob(f"*/{name}.tar.xz"), None), folder / name
        if archive is None:
            pytest.skip(f"needs {name}.tar.xz, which is not part of the project")
        with FileLock(f"{out}.lock"):
            if not out.exists():
                with tarfile.open(archive) as file:
                    file.extractall(out, filter="data")
        return out

    return unpacked
