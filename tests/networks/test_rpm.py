"""RPM, part by part."""

import numpy as np
import pytest
import tiny
import torch

from memmlp.motion.body import ROTATION, SPARSE_DIM

TRUTH = torch.stack([tiny.clip(9, seed) for seed in (1, 2)])
SPARSE = TRUTH[..., :SPARSE_DIM]


@torch.no_grad()
def test_predictions_roll_as_an_independent_computation():
    """In NumPy: shifted by a frame at each step, moved by tanh of the difference, the nearest the least."""
    model, news = tiny.baseline("rpm").double(), []
    predicted = model.predict
    model.predict = lambda *given: (news.append((given, made := 3 * predicted(*given))), made)[1]
    state, shown = model.initial_state(1), []
    for frame in SPARSE[:1].double().split(1, 1):
        made, state = model.step_frame(model.encode(frame), state)
        shown.append(made[0].numpy())
    share = 1 - np.cos(np.arange(1, 5) / 4 * np.pi / 2)[:, None]
    expected = news[0][1][0].numpy()
    for step in range(9):
        new = news[step][1][0].numpy()
        if step:
            old = np.concatenate([expected[1:], new[-1:]])
            expected = old + share * np.tanh(new - old)
        np.testing.assert_allclose(shown[step], expected, atol=1e-6)
        past = [*np.zeros((3, 132)), *(made[0] for made in shown[:step])][-3:]
        np.testing.assert_allclose(news[step][0][0][0].numpy(), past, atol=1e-12)
    assert share[0] < 0.1
    np.testing.assert_allclose(share[-1], 1)


@torch.no_grad()
def test_before_the_first_frame_are_its_inputs():
    model, seen = tiny.baseline("rpm"), []
    predicted = model.predict
    model.predict = lambda motion, inputs: (seen.append(inputs), predicted(motion, inputs))[1]
    model.advance(SPARSE, model.initial_state(2))
    encoded = model.encode(SPARSE)
    torch.testing.assert_close(seen[0], encoded[:, :1].expand(-1, 4, -1))
    torch.testing.assert_close(seen[8], encoded[:, 5:])


@pytest.mark.parametrize("own_dropout", [False, True])
def test_training_predicts_the_last_frames_after_free_running(monkeypatch, own_dropout):
    """The one step with gradient sees the inputs up to its own frame, and motion that has no gradient."""
    model, steps, training = tiny.baseline("rpm", own_dropout=own_dropout).train(), [], []
    rolled = model.step_frame
    model.step_frame = lambda *given: (steps.append((torch.is_grad_enabled(), given)), rolled(*given))[1]
    predicted = model.predict
    model.predict = lambda *given: (training.append(model.layers[0].training), predicted(*given))[1]
    monkeypatch.setattr(torch, "rand_like", lambda like: torch.tensor([[0.1], [0.9]]))
    for running in range(3):
        steps.clear()
        monkeypatch.setattr(torch, "randint", lambda high, size, running=running: torch.tensor(running))
        motion, *_ = model.compute_training_outputs(SPARSE, model.initial_state(2), TRUTH)
        assert motion.shape[:2] == (2, 4)
        assert [grad for grad, _ in steps] == [False] * running + [True]
        assert training[-running - 1 :] == [own_dropout] * running + [True]
        encoded = model.encode(SPARSE)
        for index, (_, (frame, _)) in enumerate(steps):
            torch.testing.assert_close(frame, encoded[:, 5 - running + index, None])
        first, last = steps[0][1][1], steps[-1][1][1]
        assert first["started"].flatten().tolist() == [0, 1]  # a fresh start, and true frames before
        assert not first["motion"][0].any()
        true = model.normalizer.encode(TRUTH)[1, 2 - running : 5 - running, SPARSE_DIM:][..., ROTATION]
        torch.testing.assert_close(first["motion"][1], true)
        assert not last["motion"].requires_grad
        motion.sum().backward()
    model.true_start = (
        True  # as in the released code: the frame before the first prediction, and what follows
    )
    model.compute_training_outputs(SPARSE, model.initial_state(2), TRUTH)
    true = model.normalizer.encode(TRUTH)[:, 2:6, SPARSE_DIM:][..., ROTATION]
    torch.testing.assert_close(steps[-3][1][1]["prediction"], true)
