"""How the history of a training step comes about."""

import pytest
import tiny
import torch

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import WindowSampler
from memmlp.training.rollout import OwnPredictions, PersistentStreams, TeacherForcing

SPLIT = tiny.frames((60, 90))


def sampler() -> WindowSampler:
    return WindowSampler(SPLIT, batch=5, window=7, seed=0)


@pytest.mark.parametrize("shift", ["frame", "window"])
@pytest.mark.parametrize("make", [TeacherForcing, lambda: OwnPredictions(2), lambda: PersistentStreams(5)])
def test_the_call_is_about_the_drawn_window(shift, make):
    model, rollout = tiny.model(shift=shift), make()
    if isinstance(rollout, PersistentStreams):
        rollout.begin(model)
    call = rollout.draw(model, SPLIT, sampler(), step=0)
    clips, end = sampler().draw(0)
    assert torch.equal(call.true_frames, SPLIT.read_stretches(clips, end, model.frames))
    assert torch.equal(call.sparse, call.true_frames[:, -model.stride :, :SPARSE_DIM])
    past = call.state["sparse"]
    before = SPLIT.read_stretches(clips, end - model.stride, past.shape[1])[..., :SPARSE_DIM]
    assert torch.equal(past, before)
    assert model.training or not isinstance(rollout, OwnPredictions)


@pytest.mark.parametrize("shift", ["frame", "window"])
def test_teacher_forcing_has_the_truth_and_zero_passes_have_nothing(shift):
    model = tiny.model(shift=shift)
    call = TeacherForcing().draw(model, SPLIT, sampler(), 0)
    clips, end = sampler().draw(0)
    truth = SPLIT.read_stretches(clips, end - model.stride, model.past_frames)
    known = call.state["motion"]
    known_truth = truth[:, -known.shape[1] :]
    torch.testing.assert_close(known, model.normalizer.encode(known_truth)[..., SPARSE_DIM:])
    model.eval()  # frames that the call does not recall are left out
    torch.testing.assert_close(
        *(model.advance(call.sparse, state)[0] for state in (call.state, model.true_state(truth)))
    )
    empty = OwnPredictions(0).draw(model, SPLIT, sampler(), 0)
    assert float(empty.state["motion"].abs().sum()) == 0


@torch.no_grad()
def test_own_predictions_are_what_the_network_says():
    """With two passes and a shift of one frame, the state is that after two calls on an empty history."""
    model = tiny.model(shift="frame")
    clips, end = sampler().draw(3)
    torch.manual_seed(next(s for s in range(99) if passes(s) == 2))
    call = OwnPredictions(2).draw(model, SPLIT, sampler(), 3)
    model.eval()
    past = SPLIT.read_stretches(clips, end - 3, model.memory.past_frames)
    state = model.running_state(past[..., :SPARSE_DIM])
    for back in (2, 1):
        _, state = model.advance(SPLIT.read_stretches(clips, end - back, 1)[..., :SPARSE_DIM], state)
    torch.testing.assert_close(call.state, state)


def passes(seed: int) -> int:
    torch.manual_seed(seed)
    return int(torch.randint(3, ()))


def test_streams_go_on_where_they_were():
    model, rollout = tiny.model(shift="frame"), PersistentStreams(5)
    rollout.begin(model)
    first = rollout.draw(model, SPLIT, sampler(), 0)
    ends = rollout.end.clone()
    _, state = model.advance(first.sparse, first.state)
    rollout.keep(state)
    second = rollout.draw(model, SPLIT, sampler(), 1)
    going = ends + 1 < SPLIT.lengths[first.clips]
    assert going.any()
    assert torch.equal(rollout.end[going], ends[going] + 1)
    assert torch.equal(second.state["motion"][going], state["motion"][going])
    assert set(rollout.state_dict()) >= {"clip", "end", "lives", "state_motion", "state_sparse"}


@pytest.mark.parametrize("drawn_by", ["frames", "clips", "groups"])
def test_streams_see_every_window_as_often_as_the_sampler_draws_it(drawn_by: str):
    """Long clips and short ones, one shorter than a stride, their beginnings like their ends."""
    lengths = (9, 40, 120, 331)
    frames, model, rollout = tiny.frames(lengths), tiny.model(shift="window"), PersistentStreams(400)
    rollout.begin(model)
    sampler = WindowSampler(frames, 400, model.frames, seed=0, drawn_by=drawn_by)
    seen = torch.zeros(4, 331)
    for step in range(60):
        rollout.draw(model, frames, sampler, step)
        seen.index_put_((rollout.clip, rollout.end), torch.ones(400), accumulate=True)
    windows = [length - model.frames + 1 for length in lengths]
    weights = {"frames": windows, "clips": [1] * 4, "groups": [number**0.5 for number in windows]}[drawn_by]
    wanted = [weight / sum(weights) for weight in weights]
    assert (seen.sum(1) / seen.sum()).tolist() == pytest.approx(wanted, abs=0.04)
    thirds = [float(part.mean()) for part in seen[3, model.frames - 1 :].tensor_split(3)]
    assert thirds == pytest.approx([sum(thirds) / 3] * 3, rel=0.12)
