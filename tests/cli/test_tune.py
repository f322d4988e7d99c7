"""`memmlp tune` as a person types it, on tiny runs, calm and under SIGKILLs."""

import csv
import re
import shlex
import shutil
import signal
from pathlib import Path

import pytest
from command_line import BRIEF, in_folder, run_apart
from command_line import run as command
from processes import forked, until

from benchmarks.chaos import examine, wait_for_release
from memmlp.cli.tune import prepare_search, search
from memmlp.cli.workers import Workers
from memmlp.common.errors import InputError
from memmlp.runs.run import Run
from memmlp.sweep.search import director as director_module
from memmlp.sweep.search.director import Director
from memmlp.sweep.search.search_file import Range
from memmlp.sweep.search.study import Study

TINY = [*BRIEF, "optim.validate_every=3"]
TFLOP = 2e-5
TRIALS = ["memory=none", "search.n_trials=2", "search.seeds=2", f"search.tflop={TFLOP}"]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a search of two trials, each of two seeds. Its controller is killed during the second trial."""
    folder = tmp_path_factory.mktemp("tune")
    words = ["tune", *TINY, *TRIALS, "--workers", "1"]
    with forked(in_folder, folder, *words) as process:
        until(lambda: (study := view(folder)) and len(study.trials) == 2, "the second trial", process)
        process.kill()
        assert process.wait() == -signal.SIGKILL
    (folder / "said.txt").write_text(run_apart(folder, *words))
    wait_for_release(folder / "outputs")
    return folder


def view(home: Path) -> Study | None:
    setup = prepare_search([*TINY, *TRIALS], home / "outputs")
    return Study.view(setup.search, setup.folder.name, setup.folder)


def read_trials(folder: Path) -> list[dict[str, str]]:
    with open(folder / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


def folder_of(home: Path) -> Path:
    (folder,) = (home / "outputs/tune").iterdir()
    return folder


def test_a_search_ends_with_its_best_trial_and_the_command_for_it(home: Path):
    said = (home / "said.txt").read_text()
    assert "2 of 2 trials: 2 complete" in said
    assert "importance: needs 25 complete trials" in said
    rows = read_trials(folder_of(home))
    assert (rows[0]["loss.rotation_velocity"], examine(home / "outputs", 2)) == ("30.0", [])
    best = min(rows, key=lambda row: float(row["MPJPE"]))
    assert f"{float(best['MPJPE']):.3f} ± {float(best['MPJPE sd']):.3f}" in said
    first, second = best["run"].split()
    run = Run.from_id(home / "outputs", second)
    assert (run.config["seed"], run.manifest["tflop"]) == (1, pytest.approx(TFLOP, rel=0.05))
    (words,) = re.findall(r"next: memmlp (.*)", said)
    assert f"outputs/runs/{first}" in command(home, *shlex.split(words), "export.graph=off")
    assert len(list((home / "outputs/runs").iterdir())) == 4  # none was repeated


def test_a_killed_search_has_the_trials_of_an_undisturbed_one(home: Path, tmp_path: Path):
    study = view(home)
    undisturbed = Study.open(study.search, "undisturbed", tmp_path)
    assert [trial.params for trial in study.trials] == [undisturbed.ask().params for _ in range(2)]


def test_the_same_command_does_nothing_and_status_shows_the_same(home: Path):
    before = (folder_of(home) / "study.journal").read_bytes()
    for words in ([], ["--status"]):
        assert "2 of 2 trials: 2 complete" in command(home, "tune", *TINY, *TRIALS, *words)
    assert "not started" in command(home, "tune", *TINY, "search.seed=5", "--status")
    fewer = [word for word in TRIALS if not word.startswith("search.n_trials")]
    assert "2 of 2 trials" in command(home, "tune", *TINY, *fewer, "search.n_trials=1", "--status")
    assert (folder_of(home) / "study.journal").read_bytes() == before


def test_searches_of_one_and_of_two_seeds_share_the_first_seeds_runs(home: Path, tmp_path: Path):
    for name in ("runs", "data", "cache"):
        shutil.copytree(home / "outputs" / name, tmp_path / "outputs" / name, copy_function=shutil.copy2)
    words = [*TINY, *TRIALS, "search.n_trials=1", "search.seeds=1"]
    said = command(tmp_path, "tune", *words, "--workers", "1")
    assert "1 of 1 trials: 1 complete" in said
    (row,), two = read_trials(folder_of(tmp_path)), read_trials(folder_of(home))[0]
    assert (row["run"], row["MPJPE"]) == (two["run"].split()[0], two["MPJPE, run 1"])


BAD_SEARCHES = {
    "search.space.loss.rotation_all.low=-1": "search.space.loss.rotation_all.low=-1: ",
    "+search.space.optim.batch={low: -4, high: 8}": "search.space: optim.batch=-4: ",
    "+search.space.memory.blend={low: 0.0, high: 1.0}": "search.space.memory.blend: ",
    "+search.space.data={choices: [synth, mocap], first: synth}": "search.space: ",
    "executor=debug": "executor=debug: ",
}  # fmt: skip


def test_bad_searches_are_refused_before_anything_runs(tmp_path: Path):
    for word, message in BAD_SEARCHES.items():
        said = command(tmp_path, "tune", *TINY, word, code=2)
        assert said.startswith("memmlp: ")
        assert said.count("\n") == 1
        assert message in said
        assert not (tmp_path / "outputs").exists()


@pytest.mark.slow
def test_a_search_is_named_after_what_its_trials_follow_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The interval of validations decides which trials are pruned, how a network is used what they show."""
    monkeypatch.setattr(Range, "list_corners", lambda self: ())  # which are checked above, and name nothing

    def folder(*words: str) -> str:
        return prepare_search([*TINY, *words], tmp_path).folder.name

    base = folder()
    assert folder("search.n_trials=99", "optim.checkpoint_every=7", "search.seeds=1") == base
    others = [
        folder("search.seed=1"), folder("search.objectives=[Jitter]"), folder("optim.lr=2e-3"),
        folder("search.space.loss.hand.high=2.0"), folder("search.pruner=none"), folder("seed=3"),
        folder("search.seeds=2"), folder("search.seeds=3"), folder("optim.validate_every=11"),
        folder("memory.blend=0"),
    ]  # fmt: skip
    assert len({base, *others}) == 11


def test_a_search_ends_where_its_clips_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Further trials would be judged by other clips than those before, and ranked with them."""
    command(tmp_path, "data", "synth", "--out", "mine", "--minutes", "2")
    monkeypatch.chdir(tmp_path)
    own = [word for word in TINY if "synth" not in word]
    setup = prepare_search([*own, "data=mocap", "data.root=mine"], tmp_path / "outputs")
    study = Study.open(setup.search, "mine", tmp_path)

    def replaced(director: Director, *_: object) -> None:
        director.update(1)
        next(Path("mine").rglob("*.npz")).unlink()
        director.update(2)

    monkeypatch.setattr(director_module, "run_search", replaced)
    with pytest.raises(InputError, match="mine: clips have changed since the search started"):
        search(setup, study, Workers())
    assert len(study.trials) == 1
