"""A real MLflow server, killed and restarted: no run is stopped, and at the end it has everything once."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import run as command
from fake_logger import a_run, losses
from processes import until

from memmlp.runs.loggers.logger import Loggers
from memmlp.runs.loggers.mlflow import MLflow
from memmlp.runs.run import Run

pytestmark = pytest.mark.slow

# `mlflow server` asks for packages of 800 MB; its handlers and its store need none of them. At each line
# a server is forked off a process that has imported them once, which takes seconds; its number is the answer.
SERVE = """
import os, sys
from mlflow.server.constants import ARTIFACT_ROOT_ENV_VAR, BACKEND_STORE_URI_ENV_VAR
os.environ[BACKEND_STORE_URI_ENV_VAR] = f"sqlite:///{sys.argv[1]}/server.db"
os.environ[ARTIFACT_ROOT_ENV_VAR] = f"{sys.argv[1]}/artifacts"
from mlflow.server import app
from mlflow.store.tracking import sqlalchemy_store
for _ in sys.stdin:
    if not (server := os.fork()):
        os.dup2(2, 1)
        app.run("127.0.0.1", int(sys.argv[2]), threaded=True)
    print(server, flush=True)
    print(ended := os.waitpid(server, 0)[1], flush=True)
    if ended != 9:
        sys.exit("the server ended by itself")
"""


class Server:
    """MLflow's server on a sqlite file, at a port that stays the same."""

    def __init__(self, folder: Path):
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.pid: int | None = None
        line = [sys.executable, "-c", SERVE, str(folder), str(self.port)]
        with open(folder / "server.log", "ab") as log:
            self.parent = subprocess.Popen(
                line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )

    def start(self) -> None:
        """Start it, and wait until it answers."""
        print(file=self.parent.stdin, flush=True)
        self.pid = int(self.parent.stdout.readline())
        until(self.answers, f"the server; see {self.folder / 'server.log'}", self.parent)

    def answers(self) -> bool:
        """Whether it does."""
        try:
            with urllib.request.urlopen(f"{self.url}/health", timeout=10) as response:
                return response.status == 200
        except OSError:
            return False

    def kill(self) -> None:
        """Kill it, if it is there."""
        if self.pid is not None:
            os.kill(self.pid, signal.SIGKILL)
            assert int(self.parent.stdout.readline()) == signal.SIGKILL
        self.pid = None

    def close(self) -> None:
        """End it, and what it is forked off."""
        self.kill()
        self.parent.kill()
        self.parent.communicate()

    def shown(self) -> dict[str, Any]:
        """The runs that it has, by our id; each must be there once."""
        with MLflow(self.url, self.folder).client() as (client, experiment):
            runs = client.search_runs([experiment])
        found = {run.data.tags["memmlp.run_id"]: run for run in runs}
        assert len(found) == len(runs)
        return found

    def values(self, run: Run) -> list[tuple[str, int, float]]:
        """The losses that it has of a run."""
        found = self.shown().get(run.id)
        if found is None:
            return []
        with MLflow(self.url, self.folder).client() as (client, _):
            history = client.get_metric_history(found.info.run_id, "train/loss")
        return [("train/loss", one.step, one.value) for one in history]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    pytest.importorskip("flask")
    pytest.importorskip("flask_cors")
    made = Server(tmp_path)
    yield made
    made.close()


def test_a_server_that_is_killed_and_restarted_has_everything_once(
    server: Server, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    outputs = tmp_path / "outputs"
    loggers = Loggers((MLflow(server.url, outputs),), outputs)
    server.start()
    run = a_run(outputs, "0" * 16)
    with loggers.following(run):
        until(lambda: server.values(run) == losses(3), "the curve while it goes on")
        server.kill()
        run.log(4, {"loss": 1 / 4})
        until(lambda: "is not shown in mlflow" in capfd.readouterr().err, "the warning")
        server.start()
        until(lambda: server.values(run) == losses(4), "what was missed")
        server.kill()
        run.log(5, {"loss": 1 / 5})
        run.finish([])
    server.start()
    other = a_run(outputs, "1" * 16)
    other.fail("loss is nan")
    assert server.values(run) == losses(4)

    words = ["loggers", "sync", "--uri", server.url, "--outputs", str(outputs)]
    for more, now in (([], 2), ([], 0), (["--full"], 2)):
        assert f"2 runs ({now} of them now)" in command(tmp_path, *words, *more)
        assert (server.values(run), server.values(other)) == (losses(5), losses(3))
    assert {one.info.status for one in server.shown().values()} == {"FINISHED", "FAILED"}
