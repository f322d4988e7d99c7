"""The compute of a training step, against counts of the step itself and a formula."""

from dataclasses import replace

import pytest
import torch
from tiny_tasks import OPTIM, TASKS
from torch.utils.flop_counter import FlopCounterMode

from memmlp.runs.run import Run
from memmlp.training import loop
from memmlp.training.compute import StepCompute, measure_step
from memmlp.training.optim import Muon

COUNTED = ["forced", "avatar_poser", "recurrent forced"]


@pytest.mark.parametrize("name", COUNTED)
def test_it_is_what_torch_counts_in_a_step(name):
    task = TASKS[name]()
    with FlopCounterMode(display=False) as counter:
        loop.train_step(task, OPTIM, OPTIM.build(task.parameter_groups()), 0)
    assert measure_step(TASKS[name](), OPTIM).network == pytest.approx(counter.get_total_flops(), rel=0.05)


def test_lstms_count_like_other_products():
    """HMD-Poser's LSTMs run in a kernel that torch does not count. There are three products of each weight
    with each frame; the first hidden state has no gradient."""
    task = TASKS["hmd_poser"]()
    (block,) = task.model.blocks
    inward, again = (sum(part.directions[n].numel() for part in block.over_time) for n in (0, 1))
    with FlopCounterMode(display=False) as counter:
        task.step(0).loss.backward()
    expected = 2 * OPTIM.batch * (3 * (inward + again) * task.model.frames - again)
    assert measure_step(task, OPTIM).network == counter.get_total_flops() + expected


def test_a_longer_rollout_costs_its_calls():
    forced, own = (measure_step(TASKS[name](), OPTIM).network for name in ("forced", "own"))
    assert own == pytest.approx(forced * (1 + 1 / 3), rel=0.15)  # one call forward, the mean of 0 to 2


def test_muon_multiplies_matrices():
    """Five iterations on each matrix of r rows and c columns, r <= c, each 4 r^2 c + 2 r^3 FLOPs."""
    muon = Muon(steps=3, batch=4, lr=1e-3)
    task = TASKS["avatar_poser"](optim=muon)
    sizes = [sorted(one.shape) for one in task.model.parameters() if one.dim() == 2 and min(one.shape) > 1]
    expected = sum(5 * (4 * r * r * c + 2 * r**3) for r, c in sizes)
    assert measure_step(task, muon).optimiser == expected
    assert measure_step(task, OPTIM).optimiser == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["own", "joint", "vqvae"])
def test_counting_changes_no_training(name, tmp_path, monkeypatch):
    found = {}
    for counted in (True, False):
        run = Run(tmp_path / str(counted))
        run.folder.mkdir()
        if not counted:
            monkeypatch.setattr(loop, "measure_step", lambda task, optim: StepCompute(1, 0))
        task = TASKS[name]()
        loop.train(task, replace(OPTIM, steps=2), run, 0, "it")
        found[counted] = task.module.state_dict()
    assert all(torch.equal(one, found[False][key]) for key, one in found[True].items())


def test_a_budget_sets_the_steps_and_fractions_follow(tmp_path):
    task = TASKS["forced"]()
    step = measure_step(task, OPTIM).tflop
    spent = 3 * step
    run = Run(tmp_path)
    run.write_manifest({"prerequisite_tflop": spent})
    optim = replace(OPTIM, tflop=spent + 20.3 * step, warmup=0.25, validate_every=0.5)
    loop.train(task, optim, run, 0, "it")
    assert run.total_steps == 20
    assert run.manifest["tflop"] == pytest.approx(23 * step)
    assert [entry.step for entry in run.metrics() if entry.phase == "val"] == [10, 20]
    assert optim.resolve(step, spent).warmup == 5
