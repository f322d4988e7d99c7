"""The wheel and the source distribution, installed in a new environment outside the checkout (make dist)."""

from __future__ import annotations

import os
import subprocess
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from command_line import TINY

import memmlp

ROOT = Path(__file__).parent.parent
BUILT = os.environ.get("MEMMLP_DIST")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BUILT, reason="slow: make dist builds what is tested here, and runs it"),
]


def run(*words: str | Path, folder: Path, code: int = 0) -> str:
    """What a command prints, run in a folder without this checkout on its path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ran = subprocess.run(
        [*map(str, words)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=1500,
    )
    assert ran.returncode == code, ran.stdout + ran.stderr
    return ran.stdout


@pytest.fixture(scope="module")
def wheel() -> Path:
    (found,) = (ROOT / str(BUILT)).glob("*.whl")
    return found


@pytest.fixture(scope="module")
def bin_folder(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The commands of a new environment with the wheel and all that it asks for."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=True)
    pip = [folder / "bin/python", "-m", "pip", "--disable-pip-version-check", "--quiet"]
    probe = [*pip, "download", "--no-deps", "--dest", folder / "probe", "click"]
    if subprocess.run([*map(str, probe)], capture_output=True, check=False, timeout=300).returncode:
        pytest.skip("pip can download nothing here")
    run(*pip, "install", "-c", ROOT / "constraints.txt", wheel, folder=folder)
    return folder / "bin"


def test_the_wheel_has_what_the_commands_need(wheel: Path):
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder in ("conf", "sweeps"):
        ours = {
            f"memmlp/_{folder}/{path.relative_to(ROOT / folder)}" for path in (ROOT / folder).rglob("*.yaml")
        }
        assert ours
        assert ours <= names
    package = {path.relative_to(ROOT) for path in (ROOT / "memmlp").rglob("*") if path.is_file()}
    kept = {path.as_posix() for path in package if "__pycache__" not in path.parts}
    assert {"memmlp/live/player/page/index.html", "memmlp/ui/page/index.html", "memmlp/py.typed"} <= kept
    assert kept <= names
    assert not {name for name in names if name.startswith(("tests/", "docs/"))}


def test_the_source_distribution_has_what_a_build_needs():
    (found,) = (ROOT / str(BUILT)).glob("*.tar.gz")
    with tarfile.open(found) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "README.md", "conf/train.yaml", "memmlp/__init__.py"} <= names
    assert found.stat().st_size < 20e6


def test_it_works_outside_the_checkout(bin_folder: Path, tmp_path: Path):
    """The API, configs and sweeps are found; a run is trained, exported and streamed."""
    python, command = bin_folder / "python", bin_folder / "memmlp"
    where = run(python, "-c", "import memmlp; print(memmlp.__file__, memmlp.Stream)", folder=tmp_path)
    assert str(ROOT) not in where
    assert memmlp.__version__ in run(command, "--version", folder=tmp_path)
    run(command, "demo", *TINY, folder=tmp_path)
    assert "runs" in run(command, "sweep", "14", "profile=tiny", "--dry-run", folder=tmp_path)
    (tmp_path / "mine.yaml").write_text("arms: {without: [memory=none]}")
    said = run(command, "sweep", "mine.yaml", *TINY, "export.graph=off", folder=tmp_path)
    assert "1 of 1 runs done" in said
    (made,) = (tmp_path / "outputs/runs").glob("*/deployments/*/step.onnx")
    said = run(
        python, "-c", f"import memmlp; print(memmlp.Stream({str(made)!r}).network.fps)", folder=tmp_path
    )
    assert float(said) == 60
