"""The wheel and the source distribution, installed in a new environment outside the checkout (make dist)."""

import os
import subprocess
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
    """The output of a command in a folder, without this checkout on its path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "timeout": 1500}
    done = subprocess.run([*map(str, words)], cwd=folder, env=environment, check=False, **options)
    assert done.returncode == code, done.stdout
    return done.stdout


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
    run(*pip, "install", "-c", ROOT / "constraints.txt", f"{wheel}[plots]", folder=folder)
    return folder / "bin"


def test_the_wheel_has_what_the_commands_need(wheel: Path):
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder in ("conf", "sweeps", "models"):
        kinds = (".yaml", ".json", ".onnx", ".npz", ".safetensors")
        files = (path for path in (ROOT / folder).rglob("*.*") if path.suffix in kinds)
        ours = {f"memmlp/_{folder}/{path.relative_to(ROOT / folder)}" for path in files}
        assert ours
        assert ours <= names
    assert wheel.stat().st_size <= 12e6
    package = {path.relative_to(ROOT) for path in (ROOT / "memmlp").rglob("*") if path.is_file()}
    assert {path.as_posix() for path in package if "__pycache__" not in path.parts} <= names
    assert not {name for name in names if name.startswith(("tests/", "docs/"))}


def test_it_works_outside_the_checkout(bin_folder: Path, tmp_path: Path):
    """The API, configs and sweeps are found; a run is trained, exported and streamed."""
    python, command = bin_folder / "python", bin_folder / "memmlp"
    where = run(python, "-c", "import memmlp; print(memmlp.__file__, memmlp.Stream)", folder=tmp_path)
    assert str(ROOT) not in where
    assert memmlp.__version__ in run(command, "--version", folder=tmp_path)
    run(command, "train", "data=synth", *TINY, folder=tmp_path)
    assert "recurrent_poser" in run(command, "models", folder=tmp_path)
    named = run(python, "-c", "import memmlp; print(memmlp.Stream('recurrent_poser'))", folder=tmp_path)
    assert "_models" in named
    assert "runs" in run(command, "sweep", "14", "profile=tiny", "--dry-run", folder=tmp_path)
    (tmp_path / "mine.yaml").write_text("variants: {without: [memory=none]}")
    said = run(command, "sweep", "mine.yaml", *TINY, "export.graph=off", folder=tmp_path)
    assert "1 of 1 runs done" in said
    made = sorted(map(str, (tmp_path / "outputs/runs").glob("*/deployments/*/step.onnx")))
    assert len(made) == 1
    streams = f"import memmlp; print({{memmlp.Stream(path).network.fps for path in {made}}})"
    assert run(python, "-c", streams, folder=tmp_path) == "{60.0}\n"
    shown = run(python, "-c", "import memmlp; print(*dir(memmlp))", folder=tmp_path).split()
    assert set(memmlp.__all__) <= set(shown)
