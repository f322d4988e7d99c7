"""`memmlp render` and `memmlp live` as a person types them, on a tiny run."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import MAIN
from conftest import Memmlp, one_line
from examples.conftest import EXAMPLES
from PIL import Image
from processes import PATIENCE, started

from memmlp.live.session.sources import Packet, PacketSource
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run


@pytest.fixture
def finished(home: Path, memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Change into the folder of the tiny run, where commands then run, and return the run."""
    monkeypatch.chdir(home)
    return next(found for found in list_runs("outputs") if found.manifest["kind"] == "memmlp")


@pytest.fixture
def clips(finished: Run) -> list[str]:
    return [row["name"] for row in rows(finished)]


def rows(run: Run) -> list[dict[str, Any]]:
    """Return the rows of the test clips in stream mode."""
    (report,) = run.evaluations.glob("stream-*.json")
    return json.loads(report.read_text())["clips"]


def test_a_figure(memmlp: Memmlp, finished: Run, clips: list[str], tmp_path: Path):
    out = tmp_path / "heat.png"
    ran = memmlp("render", finished.id, "--out", str(out), "--poses", "2", "--label", "ours")
    error = rows(finished)[0]["rotation"]["MPJPE"]
    assert (ran.code, ran.out) == (0, f"{out}: {clips[0]} (stream, rotation), ours {error:.1f} cm\n")
    assert f"run {finished.id}: hardly trained (its steps saw " in ran.err
    with Image.open(out) as image:
        assert image.size[0] < 700


def test_a_films_branch_mode_and_times(memmlp: Memmlp, finished: Run, clips: list[str], tmp_path: Path):
    out = tmp_path / "film.gif"
    times = ["--from", "0.5", "--to", "0.7"]
    ran = memmlp("render", finished.id, "--out", str(out), "--branch", "position", "--mode", "window", *times)
    assert ran.code == 0, ran.err
    with Image.open(out) as image:
        assert image.n_frames == 6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["--clip", "nobody", "--out", "a.png"],
            ("--clip nobody", "test clip"),
        ),
        (["--out", "a.avi"], ("--out a.avi", ".mp4")),
        (["--out", "no/a.png"], ("no folder no",)),
        (["--from", "900", "--out", "a.png"], ("--from 900", "must contain a frame")),
        (["--from", "1", "--to", "1", "--out", "a.png"], ("--from 1 --to 1",)),
        (["--from", "nan", "--out", "a.png"], ("--from", "finite number")),
        (["--to", "inf", "--out", "a.png"], ("--to", "finite number")),
        (["--label", "a", "--label", "b", "--out", "a.png"], ("2 labels for 1 runs",)),
    ],
)
def test_bad_input_to_render_is_one_line(memmlp: Memmlp, finished: Run, arguments, words):
    assert one_line(memmlp("render", finished.id, *arguments), *words)
    assert not Path("a.png").exists()


@pytest.mark.parametrize(
    ("option", "place", "words"),
    [
        ("--json", "no/folder/x.json", "--json no/folder/x.json: "),
        ("--save-predictions", "file", "--save-predictions file: "),
    ],
)
def test_places_that_nothing_can_be_written_to_are_told_before_anything_is_measured(
    memmlp: Memmlp, finished: Run, monkeypatch: pytest.MonkeyPatch, option: str, place: str, words: str
):
    monkeypatch.chdir(finished.folder.parents[2])
    Path("file").touch()
    monkeypatch.setattr("memmlp.config.open_run.open_run", lambda *_: pytest.fail("it was opened"))
    assert one_line(memmlp("eval", finished.id, option, place), words)
    Path("file").unlink()


def test_eval_says_that_code_has_changed_since(
    memmlp: Memmlp, finished: Run, monkeypatch: pytest.MonkeyPatch
):
    assert "the code of" not in memmlp("eval", finished.id).out
    monkeypatch.setattr(Run, "changed_sources", property(lambda self: ["evaluation/metrics.py"]))
    assert (
        f"the code of evaluation/metrics.py has changed since run {finished.id}"
        in memmlp("eval", finished.id).out
    )


def test_without_pyav_nothing_is_computed(memmlp: Memmlp, finished: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.delattr("memmlp.config.open_run.open_existing_run")
    assert one_line(memmlp("render", finished.id, "--out", "a.mp4"), "memmlp[video]")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--clip", "nobody"], ("--clip nobody", "test clip")),
        (["--clip", "no.npz"], ("no.npz",)),
        (["--udp", "9000", "--osc", "9001"], ("--clip, --udp, --osc",)),
        (["--udp", "9000", "--clip", "a"], ("--clip, --udp, --osc",)),
        (["--hz", "nan"], ("--hz", "finite number")),
    ],
)
def test_bad_input_to_live_is_one_line(memmlp: Memmlp, finished: Run, arguments, words):
    assert one_line(memmlp("live", finished.id, "--no-browser", *arguments), *words)


def test_a_file_has_no_test_clips(memmlp: Memmlp, finished: Run):
    assert one_line(
        memmlp("live", str(finished.onnx), "--no-browser"), "have no test clips", "--clip FILE.npz"
    )
    assert one_line(memmlp("live", "nothing.onnx", "--no-browser"), "nothing.onnx: no such file")


class Watched:
    """`memmlp live` in a process of its own, until the test ends."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, *arguments: str):
        line = [*MAIN, "live", "--no-browser", "--port", "0", *arguments]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = stack.enter_context(started(line, cwd=folder, text=True, **pipes))
        self.greeting = self.process.stdout.readline()
        self.port = int(re.findall(r"http://127.0.0.1:(\d+)/", self.greeting)[0])

    def frames(self) -> Iterator[dict]:
        """The frames that it sends."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        connection.request("GET", "/events")
        for line in connection.getresponse():
            if line.startswith(b'data: {"number"'):
                yield json.loads(line[6:])

    def interrupt(self) -> tuple[int, str, str]:
        """Interrupt it as Ctrl-C does, and return its exit code and the rest of its output."""
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.mark.parametrize("source", ["clip", "udp"])
def test_ctrl_c_ends_it_and_leaves_nothing(
    home: Path, finished: Run, stack: contextlib.ExitStack, source: str
):
    arguments = ["--hz", "72"]
    if source == "udp":
        free = PacketSource("UDP", 0, lambda data: Packet((None, None, None)), "amass")
        free.close()
        arguments = ["--udp", str(free.port), "--space", "unity"]
    watched = Watched(stack, home, finished.id, *arguments)
    if source == "clip":
        frames = watched.frames()
        assert {"positions", "truth", "held", "ms"} <= set(next(frames))
    code, out, err = watched.interrupt()
    assert (code, out) == (0, "")
    assert err.startswith(f"run {finished.id[:8]}: hardly trained (its steps saw ")
    assert err.count("\n") == 1
    with pytest.raises(ProcessLookupError):
        os.kill(watched.process.pid, 0)
    with socket.create_server(("127.0.0.1", watched.port)):
        pass


def test_packets_of_the_example_are_predicted(home: Path, finished: Run, stack: contextlib.ExitStack):
    """The body stands upright on the floor."""
    free = PacketSource("any", 0, lambda data: Packet((None, None, None)), "amass")
    free.close()
    watched = Watched(stack, home, finished.id, "--udp", str(free.port), "--space", "openxr")
    stack.enter_context(started([sys.executable, str(EXAMPLES / "udp/send.py"), "--port", str(free.port)]))
    frames = watched.frames()
    seen = [next(frames) for _ in range(30)]
    assert [f["number"] for f in seen] == list(range(seen[0]["number"], seen[0]["number"] + 30))
    assert all(f["truth"] is None and f["held"] == [] and f["malformed"] == 0 for f in seen)
    head = [f["positions"][3 * 15 + 1] for f in seen]
    assert all(1000 < height < 2200 for height in head), head  # millimetres
    assert watched.interrupt()[0] == 0
