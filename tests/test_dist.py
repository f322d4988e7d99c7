"""The wheel and the source distribution, installed in a new environment outside the checkout (make dist)."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tarfile
import urllib.request
import venv
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from command_line import TINY
from own_package import EXAMPLE, KILLED, PACKAGE
from processes import started, until

import memmlp

ROOT = Path(__file__).parent.parent
BUILT = os.environ.get("MEMMLP_DIST")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BUILT, reason="slow: make dist builds what is tested here, and runs it"),
]


def outside() -> dict[str, str]:
    """The environment variables of a process without this checkout on its path."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def ran(*words: str | Path, folder: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """What a command printed, run in a folder without this checkout on its path."""
    done = subprocess.run(
        [*map(str, words)],
        cwd=folder,
        env=outside(),
        capture_output=True,
        text=True,
        check=False,
        timeout=1500,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


def run(*words: str | Path, folder: Path) -> str:
    """What a command says on its standard output."""
    return ran(*words, folder=folder).stdout


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


@pytest.fixture(scope="module")
def feet_bin(bin_folder: Path, wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The commands of another environment: the wheel and the example, with the first one's dependencies."""
    folder = tmp_path_factory.mktemp("feet")
    venv.create(folder, with_pip=False)
    python = bin_folder / "python"
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    theirs, ours = (run(one, "-c", where, folder=folder).strip() for one in (python, folder / "bin/python"))
    Path(ours, "dependencies.pth").write_text(f"{theirs}\n")
    pip = [python, "-m", "pip", "--disable-pip-version-check", "--quiet", "--python", folder / "bin/python"]
    copy = shutil.copytree(EXAMPLE, folder / "source")  # a build leaves files beside its source
    run(*pip, "install", "--no-deps", "--ignore-installed", wheel, copy, folder=folder)
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
    assert {
        "memmlp/live/session/page/index.html",
        "memmlp/report/ui/page/index.html",
        "memmlp/py.typed",
    } <= kept
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
    (tmp_path / "mine.yaml").write_text("variants: {without: [memory=none]}")
    said = run(command, "sweep", "mine.yaml", *TINY, "export.graph=off", folder=tmp_path)
    assert "1 of 1 runs done" in said
    made = sorted(map(str, (tmp_path / "outputs/runs").glob("*/deployments/*/step.onnx")))
    assert len(made) == 2  # the demo's two networks
    streams = f"import memmlp; print({{memmlp.Stream(path).network.fps for path in {made}}})"
    assert run(python, "-c", streams, folder=tmp_path) == "{60.0}\n"
    shown = run(python, "-c", "import memmlp; print(*dir(memmlp))", folder=tmp_path).split()
    assert set(memmlp.__all__) <= set(shown)


@contextmanager
def page(command: Path, folder: Path) -> Iterator[str]:
    """The address of `memmlp ui`, which ends with the block."""
    line = [str(command), "ui", "--port", "0", "--no-browser"]
    out = folder / "ui.txt"
    with open(out, "w") as file, started(line, cwd=folder, env=outside(), stdout=file) as process:
        said = until(lambda: out.read_text().split(), "the page's address", process)
        yield said[0]


def answer(address: str, question: str) -> dict[str, Any]:
    """What the page's server answers."""
    with urllib.request.urlopen(f"{address.rstrip('/')}/api/{question}", timeout=60) as response:
        return json.loads(response.read())


def test_a_package_of_ones_own_goes_through_every_command(feet_bin: Path, bin_folder: Path, tmp_path: Path):
    """Its memory, term and metric, which only its entry point names; and a line where it isn't installed."""
    command, home = feet_bin / "memmlp", tmp_path
    where = run(feet_bin / "python", "-c", f"import memmlp, {PACKAGE} as p; print(p.__file__)", folder=home)
    assert str(feet_bin.parent) in where

    words = ["train", "experiment=feet", *KILLED]
    with started([str(command), *words], cwd=home, env=outside()) as process:
        until(lambda: [*home.glob("outputs/runs/*/checkpoint.safetensors")], "a checkpoint", process)
        process.kill()
    assert "FootSkate" in run(command, *words, folder=home)
    (manifest,) = (json.loads(path.read_text()) for path in home.glob("outputs/runs/*/manifest.json"))
    name = manifest["id"]
    assert [one["stage"] for one in manifest["attempts"]][:2] == ["training", "training"]
    assert manifest["plugins"][PACKAGE]["version"] == "0.1.0"

    assert "measured before" in run(command, "eval", name, folder=home)
    run(command, "export", name, "--out", "step.onnx", folder=home)
    assert (home / "step.onnx").exists()

    sweep = shutil.copy(EXAMPLE / "feet.yaml", home)
    quick = [sweep, *KILLED, "export.graph=off"]
    assert "2 of 2 runs done" in run(command, "sweep", *quick, "--workers", "1", folder=home)
    table = json.loads(run(command, "table", *quick, "--format", "json", folder=home))
    assert table["rows"][0]["cells"]["stream"]["FootSkate"]["mean"] > 0

    space = "+search.space.term.weight={low: 0.01, high: 1.0, log: true}"
    search = ["search.objectives=[FootSkate]", space, "search.n_trials=1"]
    tuned = run(command, "tune", "experiment=feet", *KILLED, *search, "--workers", "1", folder=home)
    assert "1 of 1 trials: 1 complete" in tuned

    with page(command, home) as address:
        runs = answer(address, "runs")
        assert runs["units"]["FootSkate"] == {"unit": "cm/s", "better": "lower"}
        row = next(row for row in runs["rows"] if row["id"] == name)
        assert row["metrics"][runs["metrics"].index("stream.rotation.FootSkate")] > 0
        assert answer(address, f"run/{name}")["config"]["term.name"] == "skate"
        (swept,) = answer(address, "sweeps")["sweeps"]
        table = answer(address, f"sweeps/{swept['name']}")["table"]
        assert (table["better"]["FootSkate"], table["rows"][0]["found"]) == ("lower", [0])
        (found,) = answer(address, "searches")["searches"]
        assert found["objectives"] == ["FootSkate"]

    failed = ran(bin_folder / "memmlp", "eval", name, folder=home, code=2)
    assert failed.stderr == (
        f"memmlp: run {name}: made with the package {PACKAGE} 0.1.0, which is not here; install it, or "
        "put its folder on PYTHONPATH\n"
    )
