"""`memmlp bench ui`: how long the page with many runs takes to open, and to filter them."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CLIPS = 12
METRICS = {
    "MPJRE": 4.1, "geodesic": 6.9, "MPJPE": 6.5, "Hand PE": 2.1, "Upper PE": 3.3, "Lower PE": 9.6,
    "Root PE": 5.0, "MPJVE": 38.0, "Jitter": 11.0, "GT Jitter": 7.1,
}  # fmt: skip
MEMORIES = ("none", "vq", "lstm", "gru", "no_codes")


@click.command("ui")
@click.option("--runs", default=2000, show_default=True, type=click.IntRange(1), help="How many run folders.")
@click.option(
    "--lines", default=300, show_default=True, type=click.IntRange(1), help="Lines of each metrics log."
)
def ui(runs: int, lines: int) -> None:
    """Make many run folders of made-up numbers in a temporary folder, and time the page on them.

    Printed are the seconds to the server's first answer: with nothing kept from an earlier start, and with
    what was kept. Where Chromium is installed, also those until the page shows its table, and of a filter.
    """
    with tempfile.TemporaryDirectory() as folder:
        outputs = Path(folder)
        click.echo(
            f"{runs} runs of {lines} lines, made in {_timed(lambda: make(outputs, runs, lines)):.1f} s"
        )
        click.echo(
            f"first answer {first_answer(outputs):.2f} s, from what was kept {first_answer(outputs):.2f} s"
        )
        browser = next(filter(None, map(shutil.which, BROWSERS)), None)
        if browser is None:
            click.echo("page: not timed, as Chromium is not installed")
            return
        shown, filtered = in_browser(outputs, browser)
        click.echo(f"page shown {shown:.2f} s after its address was opened; filter {filtered:.3f} s")


def _timed(work: Any) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def first_answer(outputs: Path) -> float:
    """Return the seconds from a new server's start to its answer with all runs."""
    from urllib.request import urlopen

    from memmlp.report.ui.routes import Answers
    from memmlp.report.ui.server import RunsServer

    began = time.perf_counter()
    with RunsServer(Answers(outputs), 0) as server, urlopen(f"{server.url}api/runs") as answer:
        found = json.loads(answer.read())
        spent = time.perf_counter() - began
    assert len(found["rows"]) == len(list((outputs / "runs").iterdir()))
    return spent


def in_browser(outputs: Path, browser: str) -> tuple[float, float]:
    """Return the seconds until a browser shows the table, and those of a filter that matches few runs."""
    from memmlp.report.ui.routes import Answers
    from memmlp.report.ui.server import RunsServer

    told: dict[str, float] = {}
    heard = threading.Event()
    answers: Any = Timed(Answers(outputs), told, heard)
    with RunsServer(answers, 0) as server, tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
        address = f"{server.url}#/runs?filter=memory%3Dgru+stream.MPJPE%3C6.8&time=yes"
        program = subprocess.Popen(
            [*command, f"--user-data-dir={profile}", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            if not heard.wait(60):
                raise TimeoutError("the browser did not show the page in a minute")
        finally:
            program.kill()
            program.wait()
    return told["ready"] / 1000, told["filtered"] / 1000


class Timed:
    """Answers that receive a page's timing: with `time` in its address, the page asks for "timing"."""

    def __init__(self, answers: Any, told: dict[str, float], heard: threading.Event):
        self.answers, self.told, self.heard = answers, told, heard

    def of(self, name: str, query: Mapping[str, str]) -> Mapping[str, Any]:
        """Return the answer to a question, or store the page's milliseconds."""
        if name != "timing":
            return self.answers.of(name, query)
        self.told.update({key: float(value) for key, value in query.items()})
        self.heard.set()
        return {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.answers, name)


def make(outputs: Path, runs: int, lines: int) -> None:
    """Write run folders whose files look like those of trained runs, with made-up numbers."""
    import yaml
    from omegaconf import OmegaConf

    from memmlp.config.compose import composed

    configs = {}
    for memory in MEMORIES:
        plain: Any = OmegaConf.to_container(composed([f"memory={memory}"]), resolve=True)
        configs[memory] = plain
    for number in range(runs):
        memory = MEMORIES[number % len(MEMORIES)]
        config = {**configs[memory], "seed": number // len(MEMORIES)}
        config["optim"] = {**config["optim"], "steps": 10 * lines, "lr": (1e-3, 3e-4, 1e-4)[number % 3]}
        _run(
            outputs / "runs" / f"{0x9E3779B97F4A7C15 * (number + 1) % 2**64:016x}",
            number,
            config,
            lines,
            yaml,
        )


def _run(folder: Path, number: int, config: dict[str, Any], lines: int, yaml: Any) -> None:
    """Write one run's folder."""
    from memmlp.runs.identity import inference

    used = inference(config)
    factor = 1 + 0.2 * ((number * 7919) % 100) / 100
    errors = {metric: value * factor for metric, value in METRICS.items()}
    clips = [
        {"name": f"clip/{clip:02}", "frames": 600, "rotation": errors, "position": errors}
        for clip in range(CLIPS)
    ]
    manifest = {
        "id": folder.name,
        "kind": "memmlp",
        "data": "d" * 64,
        "started": "2026-01-02T03:04:05+00:00",
        "seconds": {"train": 300.0},
    }
    files: dict[str, Any] = {
        "manifest.json": manifest,
        "DONE": {"id": folder.name, "artifacts": {}},
        "deployments/fp32-0/latency.json": {"median_ms": 3.0 * factor, "settings": used, "run": folder.name},
    }
    for mode in ("stream", "window"):
        files[f"evaluations/{mode}-0.json"] = {
            "mode": mode,
            "settings": {"mode": mode, "ik": "off", **used},
            "run": folder.name,
            "mean": {"rotation": errors, "position": errors},
            "clips": clips,
        }
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content))
    (folder / "config.yaml").write_text(
        yaml.dump(config, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), sort_keys=False)
    )
    log = (
        json.dumps(
            {
                "step": 10 * (step + 1),
                "phase": "train",
                "time": 1.7e9 + step,
                "values": {"loss": factor / (1 + step / 30)},
            }
        )
        for step in range(lines)
    )
    (folder / "metrics.jsonl").write_text("\n".join(log) + "\n")
