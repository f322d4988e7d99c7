"""`memmlp sweep --until-decided`, on made-up runs and, once, on trained ones whose processes are killed."""

import hashlib
import json
import re
from pathlib import Path

import pytest
import yaml
from cli.conftest import replace_planning
from conftest import Memmlp, one_line
from fake_runs import fake_run

from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep
from memmlp.sweep.plan import Entry, Plan, RunTask

VARIANTS = {"full": [], "worse": ["a=1"], "same": ["a=2"]}
FACTORS = {"worse": 1.5, "newer": 1.4}


class Runs:
    """Replaces planning and training by runs of made-up numbers, and remembers which were made."""

    def __init__(self, outputs: Path):
        self.outputs, self.made, self.version = outputs, [], ""
        self.groups: dict[str, str] | None = None
        self.failing: set[str] = set()
        self.patience = 1000  # how many runs are made before Ctrl-C

    def planned(self, sweep: Sweep, outputs: Path, prepare: bool = False) -> Plan:
        cells = [(one.label, seed) for one in sweep.list_runnable() for seed in sweep.get_seeds(one)]
        entries = [Entry(label, seed, self._id(label, seed)) for label, seed in cells]
        tasks = [RunTask(entry.id, "memmlp", {"optim": {"steps": 1}, "device": "cpu"}) for entry in entries]
        return Plan(sweep.name, self.outputs, tuple(entries), tuple(tasks))

    def _id(self, label: str, seed: int) -> str:
        return hashlib.sha256(f"{label}{self.version} {seed}".encode()).hexdigest()[:16]

    def work(self, sweep: Sweep, plan: Plan, workers: object) -> None:
        for entry in plan.entries:
            if any(entry.id == task.id for task in plan.list_remaining()):
                self.make(entry)

    def make(self, entry: Entry) -> None:
        if len(self.made) == self.patience:
            raise KeyboardInterrupt
        if entry.label in self.failing:
            failed = Run.from_id(self.outputs, entry.id)
            failed.folder.mkdir(parents=True, exist_ok=True)
            failed.fail("loss is nan")
            return
        self.made.append((entry.label, entry.seed))
        factor = FACTORS.get(entry.label, 1.0)
        fake_run(self.outputs, f"{entry.label}{self.version}", entry.seed, factor, groups=self.groups)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Runs:
    monkeypatch.chdir(tmp_path)
    write(VARIANTS)
    found = Runs(tmp_path / "outputs")
    replace_planning(monkeypatch, found.planned)
    monkeypatch.setattr("memmlp.cli.sweep.run_workers", found.work)
    return found


def write(variants: dict, **others: object) -> None:
    content = {"metrics": ["MPJPE"], "variants": variants, **others}
    Path("trial.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def record() -> dict:
    return json.loads(Path("outputs/sweeps/trial/rounds.json").read_text())


def analysed() -> list[tuple[int, list[str]]]:
    return [(look["seeds"], sorted(look["runs"])) for look in record()["analyses"]]


SWEEP = ("sweep", "trial.yaml", "--until-decided")


ANALYSED = [(3, ["same", "worse"]), (5, ["same"]), (8, ["same"])]


def test_seeds_go_where_verdicts_are_open(memmlp: Memmlp, runs: Runs):
    ran = memmlp(*SWEEP)
    assert ran.code == 0, ran.err
    assert analysed() == ANALYSED
    expected = [("worse", s) for s in range(3)] + [(one, s) for one in ("full", "same") for s in range(8)]
    assert sorted(runs.made) == sorted(expected)
    for seeds, level, decided in ((3, "0.33", 2), (5, "0.67", 2), (8, "1.3", 4)):
        assert f"analysis at {seeds} seeds ({level} %): {decided} of 4 comparisons decided" in ran.out
    assert re.search(r"^worse +2 +0 +3$", ran.out, re.M)
    assert re.search(r"^same +0 +2 +5 +at 5$", ran.out, re.M)
    assert "all verdicts are decided" in ran.out
    assert "19 runs were done; without interim analyses: 24 with 8 seeds for every variant, 39" in ran.out
    before = record()
    assert (memmlp(*SWEEP).code, len(runs.made), record()) == (0, 19, before)
    out = " ".join(memmlp("table", "trial.yaml").out.split())
    for words in ("higher (3)", "equivalent (8)", "seeds were added where verdicts were inconclusive"):
        assert words in out
    assert (out.count("3/3"), out.count("8/8")) == (2, 4)
    for words, reason in (
        (["seed=0,1,2"], "used other seeds, "),
        (["--branch", "position"], "used other variants"),
    ):
        assert f"earlier interim analyses {reason}" in " ".join(
            memmlp("table", "trial.yaml", *words).out.split()
        )
    runs.version = "of other data"
    assert "earlier interim analyses do not apply" in " ".join(memmlp("table", "trial.yaml").out.split())


@pytest.mark.slow
@pytest.mark.parametrize("patience", [0, 11, *(pytest.param(n, marks=pytest.mark.long) for n in (9, 18))])
def test_interrupted_anywhere_it_ends_the_same(memmlp: Memmlp, runs: Runs, patience: int):
    runs.patience = patience
    assert memmlp(*SWEEP).code == 130
    runs.patience = 1000
    assert (memmlp(*SWEEP).code, analysed()) == (0, ANALYSED)
    assert len(runs.made) == len(set(runs.made)) == 19


def test_what_was_decided_is_of_the_sweep_as_it_was(memmlp: Memmlp, runs: Runs):
    memmlp(*SWEEP)
    before = record()
    for variants, others, word in (
        ({**VARIANTS, "newer": ["a=3"]}, {}, "variants"), (VARIANTS, {"metrics": ["MPJRE"]}, "variants"),
        (VARIANTS, {"smallest": {"MPJPE": 0.5}}, "smallest"), (VARIANTS, {"branch": "position"}, "variants"),
        (VARIANTS, {"seeds": [7]}, "seeds"),
    ):  # fmt: skip
        write(variants, **others)
        line = f"rounds.json: the interim analyses in this file have other {word}; remove the file"
        assert one_line(memmlp(*SWEEP), line)
    write(VARIANTS)
    assert one_line(memmlp(*SWEEP, "--max-seeds", "8"), "--max-seeds 8: must be 13")
    runs.version = "of other data"
    assert one_line(memmlp(*SWEEP), "versions of 'worse' changed since its interim analyses")
    assert record() == before
    runs.version = ""
    Path("outputs/sweeps/trial/rounds.json").write_text("{")
    assert one_line(memmlp(*SWEEP), "rounds.json: damaged")


def test_bad_combinations_are_one_line(memmlp: Memmlp, runs: Runs):
    assert one_line(memmlp("sweep", "trial.yaml", "--max-seeds", "5"), "--max-seeds: ")
    assert one_line(memmlp(*SWEEP, "--max-seeds", "2"), "--max-seeds 2: must be at least 3")
    assert one_line(memmlp(*SWEEP, "seed=0,1"), "seed=0,1: ")
