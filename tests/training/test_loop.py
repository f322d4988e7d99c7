"""The training loop: learning, resuming bit for bit after a kill, stopping at NaN; checkpoints."""

from dataclasses import replace
from unittest import mock

import pytest
import tiny
import torch
from tiny_tasks import OPTIM, ROLLOUTS, TASKS, motion_task, weights

from memmlp.common import progress
from memmlp.common.errors import TrainingDiverged
from memmlp.config.build import build_experiment
from memmlp.config.compose import composed
from memmlp.motion.dataset import WindowSampler
from memmlp.runs.run import Run
from memmlp.training import loop
from memmlp.training.loop import train
from memmlp.training.optim import SCHEDULES
from memmlp.training.rollout import TeacherForcing
from memmlp.training.train_network import MotionTask
from memmlp.training.train_vqvae import perplexity


def test_drawn_by_decides_which_clips_a_step_sees():
    """Clips of 60, 45 and 80 frames have 54, 39 and 74 windows of 7, so by windows the last is drawn most."""
    drawn = {}
    for drawn_by in ("frames", "clips"):
        experiment = build_experiment(composed([f"data.drawn_by={drawn_by}"]))
        task = motion_task()
        task = MotionTask(
            task.model, task.loss, TeacherForcing(), task.dataset, replace(OPTIM, batch=3000), 0,
            task.validate, experiment.training.drawn_by,
        )  # fmt: skip
        drawn[drawn_by] = torch.bincount(task.sampler.draw(0)[0], minlength=3) / 3000
    expected = {"frames": torch.tensor([54, 39, 74]) / 167, "clips": torch.ones(3) / 3}
    for drawn_by, shares in expected.items():
        torch.testing.assert_close(drawn[drawn_by], shares, atol=0.03, rtol=0)
    assert torch.equal(motion_task().sampler.draw(3)[1], WindowSampler(tiny.frames(), 4, 7, 0).draw(3)[1])


class Kill(Exception):
    """Raised where a process is killed."""


STATEFUL = [
    "rpm",
    "avatar_poser",
    "bodiffusion",
    "upper_codes",
    "lower_diffusion",
    "recurrent streams",
    "vqvae",
]
SHORT = replace(OPTIM, steps=8, checkpoint_every=3)


@pytest.mark.slow
@pytest.mark.parametrize("make", [*ROLLOUTS, *STATEFUL])
def test_a_resumed_run_is_the_same_run(make, tmp_path):
    """It is stopped at step 5 of 8, two steps after the last checkpoint, and resumed with new objects."""

    def task():
        return TASKS[make](optim=SHORT)

    whole, broken = Run(tmp_path / "a"), Run(tmp_path / "b")
    for run in (whole, broken):
        run.folder.mkdir()
    train(task(), SHORT, whole, 0, "whole")
    victim = task()
    step = victim.step

    def dying(number: int):
        if number == 5:
            raise Kill
        return step(number)

    victim.step = dying
    with pytest.raises(Kill):
        train(victim, SHORT, broken, 0, "broken")
    torch.rand(99)
    train(task(), SHORT, broken, 0, "again")
    expected, got = weights(whole), weights(broken)
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
    assert [m.values for m in whole.metrics()] == [m.values for m in broken.metrics()]


def test_a_killed_training_says_from_where_it_goes_on_and_counts_all_its_seconds(monkeypatch, tmp_path):
    """A step takes a second here. It is killed in its eighth step, of which its checkpoint has five."""
    clock, run = iter(range(1000)), Run(tmp_path)
    now = mock.Mock(monotonic=lambda: now.seconds, seconds=0)
    monkeypatch.setattr(loop, "time", now)

    def task(killed_at: int | None):
        made = motion_task()
        step = made.step

        def timed(number: int):
            if number == killed_at:
                raise Kill
            now.seconds = next(clock)
            return step(number)

        made.step = timed
        return made

    said: list[str] = []
    with progress.announce_to(said.append):
        with pytest.raises(Kill):
            train(task(7), OPTIM, run, 0, "killed")
        assert not said
        train(task(None), OPTIM, run, 0, "again")
    assert said == [f"again: resumes at step 5 of {OPTIM.steps}, the last checkpoint"]
    assert run.manifest["seconds"] == {"train": OPTIM.steps - 1}


def test_what_is_drawn_after_training_is_the_same_after_a_resume_at_its_end(tmp_path):
    """An evaluation with memory.blend=sampled draws then; draws within a step are seeded by the step."""
    drawn = []
    for _ in range(2):
        train(motion_task(), OPTIM, Run(tmp_path), 0, "to the end, then nothing left to do")
        drawn.append(torch.rand(3))
        torch.rand(99)
    assert torch.equal(*drawn)


LEARNING = [name for name in tiny.BASELINES if name != "sage"]  # a part of it is quicker

MORE = {
    "recurrent forced": 36, "upper_codes": 36, "avatar_poser": 36, "bodiffusion": 48, "ego_poser": 48,
    "avatar_jlm": 60,
}  # fmt: skip
"""Steps of those that learn slowly; AvatarJLM is the deepest of those that begin with small weights."""


@pytest.mark.slow
@pytest.mark.parametrize("make", ["vqvae", "own", "recurrent forced", *LEARNING, "upper_codes"])
def test_it_learns_and_logs(make, tmp_path):
    steps = MORE.get(make, 24)
    optim = replace(
        OPTIM, steps=steps, lr=1e-2, final_lr=1e-3, batch=8, checkpoint_every=20, validate_every=12
    )
    run = Run(tmp_path)
    train(TASKS[make](optim=optim), optim, run, 0, "learn")
    log = [entry for entry in run.metrics() if entry.phase == "train"]
    assert [entry.step for entry in log] == list(range(4, steps + 1, 4))
    named = [name for name in ("rotation_all", "rotation") if name in log[0].values]
    error = named[0] if named else "loss"
    assert log[-1].values[error] < 0.85 * log[0].values[error]
    assert [entry.step for entry in run.metrics() if entry.phase == "val"] == list(range(12, steps + 1, 12))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_with_step_term_and_clips(bad, tmp_path):
    task = motion_task("forced")
    frames = task.dataset.frames
    start, length = int(task.dataset.starts[1]), int(task.dataset.lengths[1])
    frames[start : start + length, 54 + 132 :] = bad
    with pytest.raises(TrainingDiverged, match=r"step \d+, term .*position.*clip1") as stop:
        train(task, OPTIM, Run(tmp_path), 0, "diverge")
    assert "\n" not in str(stop.value)


def test_every_knob_of_the_optimiser_changes_the_weights(tmp_path):
    knobs = [
        {}, {"batch": 5}, {"lr": 2e-3}, {"final_lr": 5e-4}, {"schedule": "step", "drop_at": 0.5},
        {"weight_decay": 0.5}, {"betas": (0.5, 0.9)}, {"decoupled": False, "weight_decay": 0.5},
        {"clip_norm": 1e-9}, {"precision": "bf16"}, {"warmup": 3}, {"ema": 0.1},
    ]  # fmt: skip
    stems = []
    for number, changes in enumerate(knobs):
        optim, run = replace(OPTIM, steps=4, **changes), Run(tmp_path / str(number))
        run.folder.mkdir()
        train(task := motion_task("forced", optim), optim, run, 0, "knob")
        stems.append(task.model.stem.weight.detach())
    plain, *others = stems
    assert [knobs[n + 1] for n, other in enumerate(others) if torch.equal(plain, other)] == []


def test_compile_compiles_the_training_call(monkeypatch, tmp_path):
    """With a stand-in for the slow compiler: the compiled call is the one that is trained."""
    calls = []

    def compiler(function):
        return lambda *args: (calls.append(1), function(*args))[1]

    monkeypatch.setattr(torch, "compile", compiler)
    for compiled, expected in ((False, 0), (True, 3)):
        optim = replace(OPTIM, steps=3, compile=compiled)
        run = Run(tmp_path / str(compiled))
        run.folder.mkdir()
        train(motion_task("forced", optim), optim, run, 0, "compile")
        assert len(calls) == expected


def test_schedules():
    def rates(name: str) -> list[float]:
        return [SCHEDULES[name](step / 10, 0.1, 0.75) for step in range(10)]

    assert rates("step") == [1.0] * 8 + [0.1] * 2
    assert rates("cosine")[0] == 1
    assert rates("cosine") == sorted(rates("cosine"), reverse=True)
    assert rates("milestones") == pytest.approx([1, 1, 0.2, 0.2, 0.2, 0.04, 0.04, 0.008, 0.008, 0.008])


def test_perplexity():
    assert perplexity(torch.ones(8)) == pytest.approx(8)
    assert perplexity(torch.tensor([5.0, 0, 0])) == pytest.approx(1)
