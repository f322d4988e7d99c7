"""Training of a refiner behind a finished network."""

import pytest
import tiny
import torch

from memmlp.evaluation import modes
from memmlp.motion.body import SPARSE_DIM
from memmlp.networks.refiner import SAGERefinerSettings
from memmlp.training.optim import Optim
from memmlp.training.train_refiner import RefinerTask, RefinerTraining, SAGERefinerLoss

OPTIM = Optim(steps=12, batch=4, lr=1e-2, final_lr=1e-3, schedule="cosine", checkpoint_every=5, log_every=4)
REFINER = SAGERefinerSettings(width=6, depth=2, frames=20, pieces=6)


def task(optim: Optim = OPTIM) -> RefinerTask:
    dataset, model = tiny.frames(), tiny.refined(tiny.baseline("avatar_poser"))
    pieces = RefinerTraining(0, REFINER, optim, "frames").draw_pieces(dataset)
    return RefinerTask(model, SAGERefinerLoss(), dataset, pieces, optim, validate=lambda: {})


def test_pieces_are_of_the_training_clips_and_the_network_streams_through_each():
    one, dataset = task(), tiny.frames()
    assert one.frames.shape == (6, 20, 252)
    for piece, clip, motion in zip(one.frames, one.clips, one.streamed, strict=True):
        known = dataset.read_clip(int(clip)).unfold(0, 20, 1).transpose(1, 2)
        assert (known == piece).flatten(1).all(1).any()
        (expected,) = modes.predict_stream(one.model.network, [piece])
        torch.testing.assert_close(motion, expected, atol=1e-5, rtol=0)


def test_a_step_compares_the_corrected_pieces_and_reaches_the_refiner_alone():
    one = task()
    torch.manual_seed(3)
    result = one.step(0)
    result.loss.backward()
    slopes = {name for name, weight in one.model.named_parameters() if weight.grad is not None}
    parts = ((part, getattr(one.model, part).named_parameters()) for part in ("layers", "head"))
    assert slopes == {f"{part}.{name}" for part, weights in parts for name, _ in weights}
    torch.manual_seed(3)
    drawn = torch.randint(6, (4,))
    true = one.frames[drawn]
    motion = torch.stack(modes.predict_stream(one.model, list(true)))
    given = motion, true[..., SPARSE_DIM:], true[..., :SPARSE_DIM], one.model.normalizer
    terms = one.loss.terms(*given)
    found = {name: float(term.detach()) for name, term in result.terms.items()}
    assert found == pytest.approx({name: float(term) for name, term in terms.items()}, rel=1e-3)
    assert torch.equal(one.clips[drawn], result.clips)


def test_the_network_streams_without_gradients_and_without_dropout():
    model = tiny.refined(tiny.baseline("avatar_poser").train())
    given = (torch.stack([tiny.clip(12, seed) for seed in (1, 2)]), torch.tensor([0, 1])), OPTIM, dict
    made = [RefinerTask(model, SAGERefinerLoss(), tiny.frames(), *given).streamed for _ in range(2)]
    assert not made[0].requires_grad
    torch.testing.assert_close(made[0], made[1])
