"""Make damaged and hostile runs and archives beside a good run, and measure commands on all of them.

    python benchmarks/mutated_runs.py --runs 500

tests/kills checks what the commands print.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import random
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import yaml

from memmlp.common.files import file_digest
from memmlp.runs.records import compute_digest
from memmlp.runs.run import Run

CONFIG = {
    "plugins": [], "paths": {"outputs": "outputs"}, "profile": {"sizes": "tiny"},
    "data": {"name": "synth", "synth": None, "split": {"name": "seeded"}},
    "model": {"name": "mem_mlp", "frames": 11},
    "memory": {"name": "vq", "layers": [2, 4], "history": "first"}, "predictor": {"name": "two_branch"},
    "refiner": None, "optim": {"name": "adamw", "steps": 600, "batch": 8, "tflop": None, "lr": 1e-3},
    "evaluation": {"modes": ["window", "stream"], "ik": "off", "metrics": []},
    "export": {"graph": "auto", "precision": "fp32", "opset": 18}, "loggers": {},
}  # fmt: skip
STAGES, FINISHED = ("window-0", "stream-0", "fp32-0"), "2026-01-02T04:00:00+00:00"
VALUES = (
    None, True, -1, 0, 5, 1e308, 2**70, 10**400, "", "x", "nan", "\ud800", "../../../etc/passwd", "a\nb",
    "2026-13-45", [], {}, [None], [[]], {"": None}, {"a": {"a": {"a": {}}}},
)  # fmt: skip
BOMB = "a: &a [x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 10)}]\n"
    for before, name in itertools.pairwise("abcdefghij")
)
"""YAML of 10^9 leaves."""
CONTENTS = (
    b"", b"\0", b"null", b"5", b"[]", b'"x"', b"\xff\xfe\x00", b"NaN", b"[" * 100_000, b'{"a":' * 100_000,
    b"{}\n" * 9, b'{"step": Infinity, "phase": "train", "time": 1, "values": {}}\n', b'{"values": 1e999}',
    b"a: &a {b: *a}\n", b"a: 2026-01-02\n", BOMB.encode(), b" " * 17_000_000,
    b"[" + b"1," * 4_000_000 + b"1]",
)  # fmt: skip


@click.command()
@click.option("--runs", default=500, show_default=True, help="Number of damaged runs, and of archives.")
def main(runs: int) -> None:
    """Print each command's CPU seconds and memory."""
    with tempfile.TemporaryDirectory() as folder:
        outputs, archives = Path(folder) / "outputs", Path(folder) / "archives"
        make_run(outputs, "the good run")
        make_mutants(outputs, runs)
        for words in (["runs", "list", "--all"], ["loggers", "sync", "--logger", "tensorboard"]):
            measure([*words, "--outputs", str(outputs)])
        for path in make_archives(archives, runs)[:10]:
            measure(["runs", "import", str(path), "--outputs", str(outputs)])


def measure(words: Sequence[str]) -> None:
    """Run a command line, and print what it used."""
    line = [sys.executable, "-c", "from memmlp.cli.main import main; main()", *words]
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    seconds = used.ru_utime + used.ru_stime
    code = os.waitstatus_to_exitcode(status)
    click.echo(f"{' '.join(words[:2])}: exit {code}, {seconds:.1f} CPU-s, {used.ru_maxrss / 1000:.0f} MB")


def make_run(outputs: Path, name: str) -> Run:
    """Make a finished and evaluated run by its files."""
    run = Run.from_id(outputs, hashlib.sha256(name.encode()).hexdigest()[:16])
    attempt = {"started": "2026-01-02T03:04:05+00:00", "step": 0, "stage": "training", "pid": 1}
    part = {"id": "b" * 16, "kind": "vqvae", "component_versions": {"vqvae": 1}, "sources": {"a.py": "0"}}
    manifest = {
        "id": run.id, "kind": "memmlp", "name": name, "started": attempt["started"], "finished": FINISHED,
        "seconds": {"train": 300.0}, "stages": list(STAGES), "steps": 600, "attempts": [attempt],
        "prerequisite_runs": [part], "sources": {f"{number}.py": "0" for number in range(200)},
        "data": "d" * 64, "git": {"commit": "0123456789abcdef", "dirty": False}, "cpu": "A processor",
        "packages": {"torch": "2.0.0"}, "component_versions": {"memory": 1}, "body": "builtin",
    }  # fmt: skip
    settings = {"graph": "auto", "precision": "fp32", "memory.history": "first"}
    place = run.deployment("fp32-0")
    latency = {"median_ms": 0.8, "p95_ms": 1.1, "ratio_to_yardstick": 0.6, "parameters": 356_798}
    records = {
        run.manifest_path: manifest,
        run.config_path: {"seed": 0, **CONFIG},
        place.latency: latency | {"settings": settings, "run": run.id, "artifacts": {}, "made": "2026"},
        run.folder / "notes.json": {"tags": ["good"], "note": "n"},
    }
    errors = {"MPJPE": 6.5, "MPJRE": 4.15, "Jitter": 11.0}
    for mode in ("window", "stream"):
        report = {
            "run": run.id, "name": f"{mode}-0", "mode": mode, "mean": {"rotation": errors}, "made_by": {},
            "settings": {"mode": mode, "ik": "off", "memory.history": "first"}, "made": "2026",
            "clips": [{"name": "salsa/01", "frames": 600, "rotation": errors}],
        }  # fmt: skip
        records[run.evaluation(f"{mode}-0")] = report | {"digest": compute_digest(report)}
    for path, content in records.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
    line = {"step": 600, "phase": "val", "time": 1.0, "values": {"rotation MPJPE": 6.5}}
    run.metrics_path.write_text(json.dumps(line) + "\n")
    run.model.write_bytes(b"weights")
    artifacts = {run.model.name: file_digest(run.model)}
    run.marker.write_text(json.dumps({"id": run.id, "finished": FINISHED, "artifacts": artifacts}))
    return run


def list_records(run: Run) -> list[Path]:
    return sorted(
        path
        for path in run.folder.rglob("*")
        if path.suffix in (".json", ".yaml", ".jsonl", "") and path.is_file()
    )


def list_places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Each mapping or list in a tree, with each of its keys."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield value, key
        yield from list_places(item)


def mutate(path: Path, dice: random.Random) -> None:
    """Change one record: a value, all of it, or where it ends."""
    content, kind = path.read_bytes(), dice.choice(["value", "value", "content", "cut"])
    if kind == "value":
        first, end, rest = content.partition(b"\n") if path.suffix == ".jsonl" else (content, b"", b"")
        tree = yaml.safe_load(first) if path.suffix == ".yaml" else json.loads(first)
        place, key = dice.choice(list(list_places(tree)))
        place[key] = dice.choice(VALUES)
        changed = json.dumps(tree).encode() + end + rest
    else:
        changed = dice.choice(CONTENTS) if kind == "content" else content[: dice.randrange(len(content))]
    path.write_bytes(changed)


def make_mutants(outputs: Path, count: int) -> list[Run]:
    """Make runs with one mutated record each."""
    dice, found = random.Random(0), []
    for number in range(count):
        found.append(make_run(outputs, f"mutant {number}"))
        mutate(dice.choice(list_records(found[-1])), dice)
    return found


def make_archives(folder: Path, count: int) -> list[Path]:
    """Make archives of runs, each with a mutated record, or with changed bytes of its own."""
    dice, found = random.Random(0), []
    for number in range(count):
        run = make_run(folder, f"archived {number}")
        if number % 2:
            mutate(dice.choice(list_records(run)), dice)
        found.append(folder / f"{number}.zip")
        with zipfile.ZipFile(found[-1], "w", zipfile.ZIP_DEFLATED) as archive:
            for path in filter(Path.is_file, sorted(run.folder.rglob("*"))):
                archive.write(path, path.relative_to(run.folder.parent))
        if number % 2 == 0:
            content = bytearray(found[-1].read_bytes())
            for _ in range(dice.randint(1, 4)):
                content[-dice.randint(1, min(len(content), dice.choice([100, 2000, 10**6])))] = (
                    dice.randrange(256)
                )
            found[-1].write_bytes(content[: dice.choice([None, dice.randrange(len(content))])])
    return found


if __name__ == "__main__":
    main()
