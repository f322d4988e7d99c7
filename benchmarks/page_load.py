"""Measure the page of all runs: first answer, memory, following, and in Chromium filter, groups and order.

    python benchmarks/page_load.py --runs 2000 --running 200

It makes an outputs folder of invented runs first. The browser's part needs Chromium and the folder `tests`.
"""

import json
import os
import random
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import click
import yaml

from memmlp.config.compose import compose_config
from memmlp.runs.run import Run

TESTS = Path(__file__).parents[1] / "tests"
VARIANTS = ("none", "gru", "lstm", "vq")
LIMITS = {"first answer [s]": 2.0, "filter [s]": 0.3, "group [s]": 0.3, "sort [s]": 0.3, "memory [MB]": 150.0,
          "core for following [%]": 10.0}  # fmt: skip
"""The largest values that are good enough."""

SECONDS = 20.0  # of following


@click.command()
@click.option("--runs", default=2000, show_default=True, help="Finished runs.")
@click.option("--running", default=200, show_default=True, help="Further runs that train.")
@click.option("--steps", default=300, show_default=True, help="Steps of a run, each with a line in its log.")
@click.option("--keep", type=click.Path(path_type=Path), help="Folder for the runs; an existing one is used.")
def main(runs: int, running: int, steps: int, keep: Path | None) -> None:
    """Print each figure beside its limit. Exits with 1 if one is above."""
    sys.path.insert(0, str(TESTS))
    with tempfile.TemporaryDirectory() as folder:
        outputs = keep or Path(folder)
        if not (outputs / "runs").exists():
            make_runs(outputs, runs, steps)
        found = measure(outputs, running)
    for name, value in found.items():
        click.echo(f"{name:26} {value:8.3f}  limit {LIMITS.get(name, float('nan')):g}")
    raise SystemExit(any(found[name] > limit for name, limit in LIMITS.items() if name in found))


def make_runs(outputs: Path, count: int, steps: int) -> None:
    """Write finished runs with full configs, logs, evaluations and latencies."""
    from fake_runs import fake_run
    from omegaconf import OmegaConf

    config = OmegaConf.to_container(compose_config(["profile=tiny"]), resolve=True)
    dice = random.Random(0)
    for number in range(count):
        variant, seed = VARIANTS[number % len(VARIANTS)], number // len(VARIANTS)
        own = {key: config[key] for key in config if key not in ("evaluation", "export", "model")}
        own |= {"seed": seed, "memory": {"name": variant, "size": dice.choice([64, 128])}}
        own["optim"] = {**config["optim"], "lr": 10 ** dice.uniform(-4, -2), "steps": steps}
        day = f"2026-01-{1 + number % 28:02}T03:{number // 60 % 60:02}:{number % 60:02}+00:00"
        origin = {"name": f"memory={variant} · lr={own['optim']['lr']} · seed {seed}", "started": day}
        run = fake_run(outputs, variant, seed, dice.uniform(0.8, 1.2), config=own, origin=origin)
        run.config_path.write_text(yaml.safe_dump(own, sort_keys=False))
        run.metrics_path.write_text("".join(map(make_line, range(1, steps + 1))))


def make_line(step: int) -> str:
    values = {
        "loss": 3 / step,
        "rotation": 2 / step,
        "position": 1 / step,
        "velocity": 0.5 / step,
        "lr": 1e-3,
    }
    return json.dumps({"step": step, "phase": "train", "time": 1.7e9 + step, "values": values}) + "\n"


def measure(outputs: Path, running: int) -> dict[str, float]:
    """Start the page's server on a folder, and return its figures."""
    line = [sys.executable, "-c", "from memmlp.cli.main import main; main()", "ui", "--no-browser"]
    line += ["--port", "0", "--outputs", str(outputs)]
    server = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        url = server.stdout.readline().split()[0]
        started = time.monotonic()
        answer = json.loads(urllib.request.urlopen(f"{url}api/runs").read())
        found = {"first answer [s]": time.monotonic() - started}
        while answer.get("unread"):
            time.sleep(0.1)
            answer = json.loads(urllib.request.urlopen(f"{url}api/runs?state={answer['state']}").read())
        found["all runs [s]"] = time.monotonic() - started
        found |= time_page(url)
        found["core for following [%]"] = follow(outputs, url, server.pid, running)
        found["memory [MB]"] = read_memory(server.pid)
        return found
    finally:
        server.terminate()
        server.wait()


def time_page(url: str) -> dict[str, float]:
    """Return the times from a change in the page's controls until it is drawn, the median of five."""
    from chromium import Browser

    actions = {
        "filter": ("f = document.querySelector('#filter'); f.value = 'memory=gru seed<50'; "
                   "f.dispatchEvent(new Event('input'))",
                   "f.value = ''; f.dispatchEvent(new Event('input'))"),
        "group": ("choose('memory.name')", "choose('')"),
        "sort": ("document.querySelector('.runs thead th:nth-child(2) button').click()",) * 2,
    }  # fmt: skip
    found = {}
    with Browser() as browser:
        browser.call("Performance.enable", timeDomain="threadTicks")
        started = time.monotonic()
        browser.open(f"{url}#/runs")
        browser.wait("document.querySelectorAll('.runs tbody tr').length >= 100")
        found["page shown [s]"] = time.monotonic() - started
        browser.value(
            "window.choose = by => { const s = [...document.querySelectorAll('.tools label')]"
            ".find(l => l.textContent.startsWith('Group by')).querySelector('select'); s.value = by; "
            "s.dispatchEvent(new Event('change')); }; window.timed = (action, again) => { "
            "const times = []; for (let i = 0; i < 5; i += 1) { const a = performance.now(); action(); "
            "document.body.offsetHeight; times.push(performance.now() - a); again(); } "
            "return times.sort((a, b) => a - b)[2] / 1000; }"
        )
        for name, (do, undo) in actions.items():
            spent = read_page_seconds(browser)
            found[f"{name} [s]"] = browser.value(f"timed(() => {{ {do} }}, () => {{ {undo} }})")
            found[f"{name}, CPU [s]"] = (read_page_seconds(browser) - spent) / 10  # five times, and back
    return found


def read_page_seconds(browser: Any) -> float:
    """Return the CPU time of the page's main thread: the time on the clock depends on other processes."""
    metrics = browser.call("Performance.getMetrics")["metrics"]
    return float(next(one["value"] for one in metrics if one["name"] == "TaskDuration"))


def follow(outputs: Path, url: str, pid: int, running: int) -> float:
    """Return the share of a core that the server takes, in percent, while runs train and a page is open."""
    runs = [Run.from_id(outputs, f"{number:016x}") for number in range(running)]
    template = next(path for path in (outputs / "runs").iterdir() if (path / "DONE").exists())
    for run in runs:
        run.folder.mkdir(parents=True, exist_ok=True)
        run.config_path.write_bytes((template / "config.yaml").read_bytes())
        about = {"id": run.id, "kind": "memmlp", "started": "2026-02-01T00:00:00+00:00", "steps": 300}
        run.manifest_path.write_text(json.dumps(about))
        run.metrics_path.write_text(make_line(1))
    from chromium import Browser

    with Browser() as browser:
        browser.open(f"{url}#/runs")
        browser.wait("document.querySelectorAll('.runs tbody tr').length >= 100")
        time.sleep(5)
        begun, spent = time.monotonic(), read_seconds(pid)
        step = 2
        while time.monotonic() < begun + SECONDS:
            for run in runs:
                with open(run.metrics_path, "a") as file:
                    file.write(make_line(step))
            step += 1
            time.sleep(1)
        return 100 * (read_seconds(pid) - spent) / (time.monotonic() - begun)


def read_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def read_memory(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return max(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


if __name__ == "__main__":
    main()
