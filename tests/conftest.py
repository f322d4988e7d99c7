"""Settings and fixtures that all tests share."""

import copy
import functools
import logging
import math
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import omegaconf.base
import processes
import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

from memmlp.common.processes import collect_garbage_rarely

if Path("/dev/nvidiactl").exists():
    os.environ["CUDA_VISIBLE_DEVICES"] = ""  # expected numbers were computed on a CPU

# Networks are tiny and test processes many: more threads only wait for each other.
THREADS = int(os.environ.setdefault("OMP_NUM_THREADS", "1"))
SLOW_TIMEOUT = 3600  # seconds, on a machine with much other work
INT8 = "export.precision=int8"
FIRST = {f"test_{name}.py" for name in ("experiment", "kills", "networks", "page", "run_stages", "tune")}
"""The files that take longest: after all others they would leave cores idle."""
# The same examples each time, and no complaint that a busy machine is slow.
settings.register_profile(
    "memmlp", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("memmlp")
processes.mark()
collect_garbage_rarely()
# Otherwise pytest captures this log, and torch describes each pass of each export in it.
logging.getLogger("torch.__trace").addHandler = lambda handler: None  # type: ignore[method-assign]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long tests and those that need a trained run are slow; files with slow tests come early."""
    for item in items:
        if {"home", "tiny_home"} & set(item.fixturenames) or item.get_closest_marker("long"):
            item.add_marker(pytest.mark.slow)
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT))
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.name not in FIRST, item.path not in slow))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    """End the processes that a killed test process has left."""
    processes.end_all()


def long_except(short: Iterable[object], names: Iterable[object]) -> list[object]:
    """Parameters of which all but a few are long."""
    return [name if name in short else pytest.param(name, marks=pytest.mark.long) for name in names]


class Ran(NamedTuple):
    """A command's exit code and what it wrote."""

    code: int
    out: str
    err: str


Memmlp = Callable[..., Ran]


def clean(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test depends on the caller's settings, or writes to its outputs."""
    for name in (
        "MEMMLP_OUTPUTS", "MEMMLP_TRACEBACK", "MEMMLP_PLUGINS", "MLFLOW_TRACKING_URI", "HYDRA_FULL_ERROR",
        "COMP_LINE",
    ):  # fmt: skip
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("memmlp.common.progress.INTERVAL", math.inf)  # however slow the machine is
    monkeypatch.setattr("os.fsync", lambda file: None)  # no test outlives a power cut


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    clean(monkeypatch)
    yield
    if (torch := sys.modules.get("torch")) and torch.get_num_threads() != THREADS:  # set by a command
        torch.set_num_threads(THREADS)


@pytest.fixture(scope="module", autouse=True)
def _no_process_is_left() -> Iterator[None]:
    yield
    processes.end_all()


@pytest.fixture(scope="session", autouse=True)
def _parse_once() -> None:
    """OmegaConf parses each `${seed}` again, Hydra each override thrice, and each export 500 operators."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from torch.onnx._internal._lazy_import import onnxscript_apis

    omegaconf.base.parse = functools.lru_cache(maxsize=1000)(omegaconf.base.parse)
    parse = functools.lru_cache(maxsize=9000)(OverridesParser.create().parse_rule)
    onnxscript_apis.get_torchlib_ops = functools.lru_cache(onnxscript_apis.get_torchlib_ops)
    OverridesParser.parse_rule = lambda self, text, rule: copy.copy(parse(text, rule))


def shared(factory: pytest.TempPathFactory, name: str) -> Path:
    """Return a folder that all test processes share."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def tiny_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one finished run, int8 included, and its output; made once for all processes. Tests only
    read it, or copy it (`home`)."""
    folder = shared(tmp_path_factory, "tiny")
    said = folder / "out.txt"
    with FileLock(f"{folder}.lock"), pytest.MonkeyPatch.context() as monkeypatch:
        clean(monkeypatch)
        if not said.exists():
            import command_line  # with torch, which xdist's controller need not import

            said.write_text(command_line.run(folder, "train", *command_line.TINY, INT8, picture=True))
    return folder


@pytest.fixture(scope="session")
def step_files(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Files of networks (tests/exported.py), each exported once: the step, or the full graph in a space."""
    folder = shared(tmp_path_factory, "steps")

    def step_file(name: str, space: str | None = None) -> Path:
        path = folder / f"{name}-{space or 'step'}.onnx"
        with FileLock(f"{path}.lock"):
            if not path.exists():
                import exported

                exported.write(name, path, space)
        return path

    return step_file


@pytest.fixture
def on_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The example package on the path of this process and of those that it starts; not in use yet."""
    from own_package import EXAMPLE, registers_kept

    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLE), prepend=":")
    with registers_kept():
        yield EXAMPLE


@pytest.fixture
def home(tiny_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the folder with one finished run, for one test."""
    return Path(shutil.copytree(tiny_home, tmp_path_factory.mktemp("home") / "home"))


@pytest.fixture
def memmlp(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Memmlp:
    """Run `memmlp ARGUMENTS` in this process, in an empty folder."""
    import command_line

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["memmlp"])

    def run(*arguments: str) -> Ran:
        capsys.readouterr()
        return Ran(command_line.exit_code(arguments), *capsys.readouterr())

    return run


def one_line(ran: Ran, *words: str) -> bool:
    """Whether the command refused its input in one line on stderr that has these words, and exit code 2."""
    line = re.fullmatch(r"memmlp: [^\n]+\n", ran.err)
    return ran.code == 2 and ran.out == "" and line is not None and all(word in ran.err for word in words)
