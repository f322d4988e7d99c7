"""What every test shares."""

from __future__ import annotations

import gc
import math
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import processes
import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings
from remembered import keep_exports, remember
from scratch_in_memory import remove_at_exit, scratch_in_memory
from small_pictures import draw_large, draw_small

from memmlp.common.processes import collect_garbage_rarely

if Path("/dev/nvidiactl").exists():
    os.environ["CUDA_VISIBLE_DEVICES"] = ""  # what the tests compare with was computed on a CPU


scratch = scratch_in_memory()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """Each test process begins elsewhere, so that what one rewrites and compiles, the others find."""
    report = yield
    if isinstance(collector, pytest.Dir) and (worker := os.environ.get("PYTEST_XDIST_WORKER")):
        share = len(report.result) / int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        first = round(share * int(worker.removeprefix("gw")))
        report.result = report.result[first:] + report.result[:first]
    return report


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """By files, some of which stay together (work_units.py)."""
    if config.getvalue("dist") != "loadfile":
        return None
    from work_units import WorkUnits  # here, since it needs xdist

    return WorkUnits(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, the others by their names; what needs a trained run is slow."""
    here = Path(__file__).parent
    ranks = {here / f"{name}.py": rank for rank, name in enumerate(LONGEST)}
    if gone := [path for path in ranks if not path.is_file()]:
        raise pytest.UsageError(f"LONGEST names files that are not there: {', '.join(map(str, gone))}")
    items.sort(key=lambda item: (ranks.get(item.path, len(ranks)), item.path))
    for item in items:
        if "home" in item.fixturenames or "tiny_home" in item.fixturenames:
            item.add_marker(pytest.mark.slow)
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT))


collect_garbage_rarely()


def pytest_collection_finish() -> None:
    """What is imported by now stays: the garbage collector need not go through it."""
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """What a test process left that died itself, and, unless a test failed, what all wrote."""
    processes.end_all()
    if scratch is not None and not session.testsfailed:
        remove_at_exit(scratch)


class Ran(NamedTuple):
    """A command's exit code and what it wrote."""

    code: int
    out: str
    err: str


# The same examples each time, and no complaint that a busy machine is slow.
settings.register_profile(
    "memmlp", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("memmlp")

# Networks are tiny and test processes many: more threads only wait for each other.
THREADS = int(os.environ.setdefault("OMP_NUM_THREADS", "1"))

processes.mark()

# Begun first, so that no process is left alone with one of them at the end. Those that mostly wait for other
# processes stand among those that compute.
LONGEST = (
    "cli/test_sweep", "deploy/test_deployment", "config/test_build", "training/test_run_stages",
    "kills/test_search", "training/test_experiment", "live/test_trackers_to_body_graph",
    "training/test_baselines", "networks/test_streaming", "training/test_loop", "config/test_baselines",
    "live/web/test_page", "test_example_package",
    "kills/test_rounds", "config/test_compose", "cli/test_main", "live/test_stream",
    "kills/test_sweep", "report/tables/test_seed_rounds", "networks/test_baselines", "deploy/test_export",
    "cli/test_tune", "report/ui/test_page", "kills/test_command", "kills/test_training",
    "runs/loggers/test_mlflow", "live/session/test_live_page", "common/test_distributed",
    "cli/test_look",
)  # fmt: skip

SLOW_TIMEOUT = 3600  # seconds: ends what hangs, but not what is slow on a machine with much other work

INT8 = "export.precision=int8"
Memmlp = Callable[..., Ran]


def clean(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test depends on the caller's settings, or writes to its outputs."""
    for name in (
        "MEMMLP_OUTPUTS",
        "MEMMLP_TRACEBACK",
        "MEMMLP_PLUGINS",
        "MLFLOW_TRACKING_URI",
        "HYDRA_FULL_ERROR",
        "COMP_LINE",
    ):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    # How far work is, is said every so many seconds: never, however slow the machine is.
    monkeypatch.setattr("memmlp.common.progress.INTERVAL", math.inf)


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    clean(monkeypatch)
    remember()


@pytest.fixture(autouse=True)
def _threads_stay_as_they_were() -> Iterator[None]:
    """A command that sets torch's threads sets them for its process, which here goes on with other tests."""
    yield
    if (torch := sys.modules.get("torch")) and torch.get_num_threads() != THREADS:
        torch.set_num_threads(THREADS)


@pytest.fixture(autouse=True)
def _no_process_is_left() -> Iterator[None]:
    """What a test started ends with it, whether it passes, fails, or takes too long."""
    yield
    processes.end_all()


def shared(factory: pytest.TempPathFactory, name: str) -> Path:
    """Return a folder that all test processes share."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session", autouse=True)
def _pictures_are_small() -> None:
    draw_small()


@pytest.fixture(scope="session", autouse=True)
def _exports_are_kept(tmp_path_factory: pytest.TempPathFactory) -> None:
    keep_exports(shared(tmp_path_factory, "exports"))


@pytest.fixture(scope="session")
def tiny_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one finished run, int8 included, and what it printed; made once for all processes.

    It is only read: what writes takes a copy (`home`).
    """
    folder = shared(tmp_path_factory, "tiny")
    said = folder / "out.txt"
    with FileLock(f"{folder}.lock"), pytest.MonkeyPatch.context() as monkeypatch:
        clean(monkeypatch)
        if not said.exists():
            import command_line  # with torch, which the process that only distributes the tests does without

            draw_large()
            said.write_text(command_line.run(folder, "train", *command_line.TINY, INT8))
            draw_small()
    return folder


@pytest.fixture(scope="session")
def step_files(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The files of streaming steps by the name of the network (tests/exported.py), each exported once."""
    folder = shared(tmp_path_factory, "steps")

    def step_file(name: str) -> Path:
        path = folder / f"{name}.onnx"
        with FileLock(f"{path}.lock"):
            if not path.exists():
                import exported

                exported.write(name, path)
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
def large_pictures() -> Iterator[None]:
    """Runs in this process have the picture that they have for users."""
    draw_large()
    yield
    draw_small()


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
