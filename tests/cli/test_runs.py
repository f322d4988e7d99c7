"""`memmlp runs` on folders made by hand."""

import json
import re
from pathlib import Path

import pytest
from conftest import Memmlp, Ran, one_line

from memmlp.common.files import write_json
from memmlp.runs.run import Run

A, B, C = ("a" * 16, "b" * 16, "c" * 16)
RESULTS = {
    "stream": {"rotation": {"MPJPE": 6.512, "Jitter": 4.2}},
    "window": {"rotation": {"MPJPE": 7.0}},
    "latency": {"median_ms": 1.5},
}


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    folder = tmp_path / "outputs"
    for name, seed in ((A, 0), (B, 1), (C, 2)):
        run = Run.from_id(folder, name)
        run.begin(
            "memmlp", {"seed": seed, "memory": {"layers": [2, 4, 6, 8] * 9}}, data="d" * 64, prerequisite=None
        )
        if name != C:
            write_json(run.results_path, RESULTS | {"stream": {"rotation": {"MPJPE": 6.512 + seed}}})
            run.finish(["results.json"])
    return folder


def test_list_names_the_older_ones_and_counts_finished_vqvaes(memmlp: Memmlp, outputs: Path):
    runs = [Run.from_id(outputs, f"{i:016x}") for i in range(25)]
    for run in runs:
        run.begin("vqvae", {}, data="d", prerequisite=None)
    said = memmlp("runs", "list").out
    assert said.count("VQ-VAE") < 25
    assert "8 older runs" in said
    assert memmlp("runs", "list", "--all").out.count("VQ-VAE") == 25
    runs[3].finish([])
    said = memmlp("runs", "list").out
    assert runs[3].id not in said
    assert "1 finished VQ-VAE: memmlp runs list --all\n" in said
    assert runs[3].id in memmlp("runs", "list", "--where", "kind=vqvae").out


def test_show(memmlp: Memmlp, outputs: Path):
    ran = memmlp("runs", "show", "a", "--config")
    assert ran.code == 0
    assert max(map(len, ran.out.splitlines())) <= 80
    for word in (A, "done", "packages.torch", "stream.rotation.MPJPE", "6.512", "memory.layers"):
        assert word in ran.out
    assert "changed since" not in ran.out
    assert "training from step 0" in ran.out
    assert "interrupted" in memmlp("runs", "show", C).out
    (outputs / "runs" / A / "results.json").write_text("{}")
    Run(outputs / "runs" / A).fail("the loss is infinite")
    said = memmlp("runs", "show", A).out
    assert re.search(r"changed since +results.json", said)
    assert re.search(r"status +failed\s+failed with +the loss is infinite", said)


def rows(ran: Ran) -> list[list[str]]:
    return [line.split() for line in ran.out.splitlines()]


def test_diff(memmlp: Memmlp, outputs: Path):
    ran = memmlp("runs", "diff", "a", "b")
    assert ["seed", "0", "1"] in rows(ran)
    assert ["stream.rotation.MPJPE", "6.512", "7.512", "+1", "cm"] in rows(ran)
    assert "memory.layers" not in ran.out
    assert "can be chance" in ran.out
    assert memmlp("runs", "diff", "a", "a").out == "config: no difference\nresults: no difference\n"
    assert one_line(memmlp("runs", "diff", "a", "zz"), "run 'zz'")


def test_where_sort_and_columns(memmlp: Memmlp, outputs: Path):
    memmlp("runs", "tag", A, "good")
    where = ["--where", "stream.MPJPE>1 and status=done"]
    ran = memmlp("runs", "list", *where, "--sort", "-seed", "--columns", "seed")
    rows = [line.split() for line in ran.out.splitlines() if line.strip()[:1] in set("abc")]
    assert [(row[0], row[-1]) for row in rows] == [(B, "1"), (A, "good")]
    assert "2 of 3 runs" in ran.out
    assert one_line(memmlp("runs", "list", "--where", "memry.layers=2"), "memory.layers")
    assert one_line(memmlp("runs", "list", "--sort", "sed"), "--sort", "did you mean seed")
    assert one_line(memmlp("runs", "list", "--columns", "seed,sed"), "--columns")
    assert one_line(memmlp("runs", "list", "--where", "seed="), "expected a comparison")


@pytest.mark.parametrize(("sort", "order"), [("stream.MPJPE", [B, A, C]), ("-stream.MPJPE", [A, B, C])])
def test_a_run_that_diverged_is_sorted_behind_all(memmlp: Memmlp, outputs: Path, sort: str, order: list[str]):
    """Its NaN is a word in its file; the order of the others stays that of numbers, not of texts."""
    for name, error in ((A, 12.4), (B, 5.3), (C, float("nan"))):
        write_json(Run.from_id(outputs, name).results_path, {"stream": {"rotation": {"MPJPE": error}}})
    lines = memmlp("runs", "list", "--sort", sort).out.splitlines()
    assert [line[:16] for line in lines if line[:16] in order] == order


def test_a_damaged_run_is_listed_and_named(memmlp: Memmlp, outputs: Path):
    (outputs / "runs" / A / "config.yaml").write_text("{")
    ran = memmlp("runs", "list")
    assert "damaged" in ran.out
    assert "cannot be read" in ran.err


def test_tag_and_note(memmlp: Memmlp, outputs: Path):
    assert memmlp("runs", "tag", A, "good", "odd").out == f"{A}: good, odd\n"
    assert memmlp("runs", "tag", A, "odd", "--remove").out == f"{A}: good\n"
    assert memmlp("runs", "note", A).out == f"{A}: no note\n"
    for words in (["a note"], []):
        assert memmlp("runs", "note", A, *words).out == f"{A}: a note\n"
    assert one_line(memmlp("runs", "tag", A, "two words"), "tag")


def test_gc_shows_first_and_deletes_on_yes(memmlp: Memmlp, outputs: Path):
    run = Run.from_id(outputs, C)
    assert memmlp("runs", "gc").out == "nothing to delete\n"
    run.fail("loss is nan")
    shown = memmlp("runs", "gc")
    assert "loss is nan" in shown.out
    assert "1 runs" in shown.out
    assert run.folder.exists()
    assert memmlp("runs", "gc", "--only", "old").out == "nothing to delete\n"
    assert "deleted 1 runs" in memmlp("runs", "gc", "--yes").out
    assert not run.folder.exists()
    assert Run.from_id(outputs, A).folder.exists()


def test_export_and_import(memmlp: Memmlp, outputs: Path):
    said = memmlp("runs", "export", A, "--out", "run.zip").out
    there = ["--outputs", "there", "--sha256", said.split()[-1]]
    assert memmlp("runs", "import", "run.zip", *there).out == f"run {A}: imported\n"
    assert one_line(memmlp("runs", "import", "run.zip", "--sha256", "0" * 64), "SHA-256")
    assert one_line(memmlp("runs", "import", "none.zip"), "no such file")
    assert one_line(memmlp("runs", "export", C), C)


def test_stop_archive_rename_and_delete(memmlp: Memmlp, outputs: Path):
    assert memmlp("runs", "stop", "c").out == f"{C}: stopped\n"
    assert memmlp("runs", "retry", "c").out == f"{C}: interrupted\n"
    assert one_line(memmlp("runs", "stop", "a"), "must be unfinished")
    assert memmlp("runs", "rename", "a", "My best").code == 0
    assert memmlp("runs", "archive", "b").code == 0
    said = memmlp("runs", "list").out
    assert "My best" in said
    assert B[:8] not in said
    assert B[:8] in memmlp("runs", "list", "--all").out
    Run.from_id(outputs, C).write_manifest({"prerequisite": B})
    ran = memmlp("runs", "delete", "b")
    assert f"run {C} was trained from it" in ran.out
    assert (outputs / "runs" / B).exists()
    assert memmlp("runs", "delete", "b", "--yes").code == 0
    assert not (outputs / "runs" / B).exists()
    assert json.loads((outputs / "actions.jsonl").read_text())["value"] == B
