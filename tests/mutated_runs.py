"""Folders of runs with one damaged or hostile record each."""

from __future__ import annotations

import itertools
import json
import random
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from fake_runs import fake_run

from memmlp.common.files import file_digest, write_json
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
SETTINGS = {"settings": {"mode": "stream", "ik": "off", "memory.history": "first"}}
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


def make_run(outputs: Path, name: str) -> Run:
    run = fake_run(
        outputs,
        name,
        clips=("salsa/01",),
        branches=("rotation",),
        config=CONFIG,
        evaluated=SETTINGS,
        log=True,
    )
    attempt = {"started": "2026-01-02T03:04:05+00:00", "step": 0, "stage": "training", "pid": 1}
    part = {"id": "b" * 16, "kind": "vqvae", "component_versions": {"vqvae": 1}, "sources": {"a.py": "0"}}
    facts = {"name": name, "stages": list(STAGES), "steps": 600, "attempts": [attempt], "finished": FINISHED}
    sources = {f"{number}.py": "0" for number in range(200)}
    run.write_manifest(facts | {"prerequisite_runs": [part], "sources": sources})
    run.model.write_bytes(b"weights")
    artifacts = {run.model.name: file_digest(run.model)}
    write_json(run.marker, {"id": run.id, "finished": FINISHED, "artifacts": artifacts})
    latency = run.deployment("fp32-0").latency
    settings = {"settings": {"graph": "auto", "precision": "fp32", "memory.history": "first"}}
    write_json(latency, json.loads(latency.read_text()) | settings | {"run": run.id, "artifacts": {}})
    write_json(run.folder / "notes.json", {"tags": ["good"], "note": "n"})
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


def make_mutants(outputs: Path, count: int, seed: int = 0) -> list[Run]:
    """Make runs with one mutated record each."""
    dice, found = random.Random(seed), []
    for number in range(count):
        found.append(make_run(outputs, f"mutant {number}"))
        mutate(dice.choice(list_records(found[-1])), dice)
    return found


def make_archives(folder: Path, count: int, seed: int = 0) -> list[Path]:
    """Make archives of runs, each with a mutated record, or with changed bytes of its own."""
    dice, found = random.Random(seed), []
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
