"""`memmlp render` and `memmlp live` as a person types them, on a tiny run."""

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
from unittest.mock import Mock

import pytest
from cli.conftest import find_trained
from command_line import MAIN
from conftest import Memmlp, one_line
from examples.conftest import EXAMPLES
from PIL import Image
from processes import PATIENCE, started

from memmlp.live.session.sources import PacketSource
from memmlp.runs.run import Run


@pytest.fixture
def finished(home: Path, memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Change into the folder of the tiny run, where commands then run, and return the run."""
    monkeypatch.chdir(home)
    return find_trained(Path())


def rows(run: Run) -> list[dict[str, Any]]:
    (report,) = run.evaluations.glob("stream-*.json")
    return json.loads(report.read_text())["clips"]


def test_a_figure_and_a_films_branch_mode_and_times(memmlp: Memmlp, finished: Run):
    ran = memmlp("render", finished.id, "--out", "heat.png", "--poses", "2", "--label", "ours")
    clip, error = rows(finished)[0]["name"], rows(finished)[0]["rotation"]["MPJPE"]
    assert (ran.code, ran.out) == (0, f"heat.png: {clip} (stream, rotation), ours {error:.1f} cm\n")
    assert f"run {finished.id}: hardly trained (its steps saw " in ran.err
    with Image.open("heat.png") as image:
        assert image.size[0] < 700
    words = ["--branch", "position", "--mode", "window", "--from", "0.5", "--to", "0.7"]
    ran = memmlp("render", finished.id, "--out", "film.gif", *words)
    assert ran.code == 0, ran.err
    with Image.open("film.gif") as image:
        assert image.n_frames == 6


REFUSED = {
    "render --clip nobody --out a.png": ("--clip nobody", "test clip"),
    "render --out a.avi": ("--out a.avi", ".mp4"), "render --out no/a.png": ("no folder no",),
    "render --out a.mp4": ("memmlp[video]",), "render --from 900 --out a.png": ("--from 900",),
    "render --from 1 --to 1 --out a.png": ("--from 1 --to 1",),
    "render --from nan --out a.png": ("--from", "finite number"),
    "render --label a --label b --out a.png": ("2 labels for 1 runs",),
    "eval --json no/folder/x.json": ("--json no/folder/x.json: ",),
    "eval --save-predictions file": ("--save-predictions file: ",),
    "live --no-browser --clip nobody": ("--clip nobody", "test clip"),
    "live --no-browser --clip no.npz": ("no.npz",),
    "live --no-browser --udp 9000 --osc 9001": ("--clip, --udp, --osc",),
    "live --no-browser --udp 9000 --clip a": ("--clip, --udp, --osc",),
    "live --no-browser --hz nan": ("--hz", "finite number"),
}  # fmt: skip
DATA_FREE = ("eval", "render --out a.mp4")  # what nothing is computed for


def test_bad_input_is_one_line(memmlp: Memmlp, finished: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "av", None)
    Path("file").touch()
    for line, words in REFUSED.items():
        command, *options = line.split()
        with monkeypatch.context() as patch:
            if line.startswith(DATA_FREE):
                for name in ("open_run", "open_existing_run"):
                    patch.setattr(f"memmlp.config.open_run.{name}", Mock(side_effect=AssertionError))
            assert one_line(memmlp(command, finished.id, *options), *words), line
    assert not Path("a.png").exists()
    for place, *options, word in (
        (finished.preferred_onnx, "--clip", "walk", "npz"),
        ("no.onnx", "no.onnx: "),
    ):
        assert one_line(memmlp("live", str(place), "--no-browser", *options), word)


class Watched:
    """`memmlp live` in a process of its own, until the test ends."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, *arguments: str):
        line = [*MAIN, "live", "--no-browser", "--port", "0", *arguments]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = stack.enter_context(started(line, cwd=folder, text=True, **pipes))
        self.greeting = self.process.stdout.readline()
        self.port = int(re.findall(r"http://127.0.0.1:(\d+)/", self.greeting)[0])

    def frames(self) -> Iterator[dict]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        connection.request("GET", "/events")
        for line in connection.getresponse():
            if line.startswith(b'data: {"number"'):
                yield json.loads(line[6:])

    def interrupt(self) -> tuple[int, str, str]:
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.mark.parametrize("source", ["clip", "udp"])
def test_packets_or_a_clip_are_predicted_until_ctrl_c(home, finished, stack, source: str):
    """From packets of the example: the body stands upright on the floor. Nothing is left at the end."""
    with contextlib.closing(PacketSource("UDP", 0, lambda data: None, "amass")) as free:
        port = str(free.port)
    words = ["--udp", port, "--space", "openxr"] if source == "udp" else ["--hz", "72"]
    watched = Watched(stack, home, finished.id, *words)
    if source == "udp":
        stack.enter_context(started([sys.executable, str(EXAMPLES / "udp/send.py"), "--port", port]))
    frames = watched.frames()
    seen = [next(frames) for _ in range(30)]
    assert [f["number"] for f in seen] == list(range(seen[0]["number"], seen[0]["number"] + 30))
    assert all((f["truth"] is None) == (source == "udp") and f["held"] == [] for f in seen)
    head = [f["positions"][3 * 15 + 1] for f in seen]
    assert source == "clip" or all(1000 < height < 2200 for height in head), head  # millimetres
    code, out, err = watched.interrupt()
    assert (code, out) == (0, "")
    assert re.fullmatch(rf"run {finished.id[:8]}: hardly trained \(its steps saw [^\n]*\n", err)
    with pytest.raises(ProcessLookupError):
        os.kill(watched.process.pid, 0)
    with socket.create_server(("127.0.0.1", watched.port)):
        pass
