"""BoDiffusion, part by part."""

from functools import partial

import pytest
import tiny
import torch

from memmlp.common.errors import InputError
from memmlp.evaluation import modes
from memmlp.evaluation.ik import NoIK
from memmlp.evaluation.modes import Evaluation
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.networks import diffusion as ancestral
from memmlp.networks.streaming import has_streaming_graph, make_streaming_graph

CLIP = tiny.clip(25)
TRUTH = tiny.clip(7)[None].expand(64, -1, -1)


def test_the_denoiser_learns_from_the_noised_truth_of_the_window():
    """The training call's losses are of the noise that was mixed in; they have weights."""
    found = []
    for weights in ({}, {"noise_weight": 0.5, "bound_weight": 3.0}):
        model, seen = tiny.baseline("bodiffusion", **weights), []
        denoise = model.denoise
        model.denoise = lambda *args, denoise=denoise, seen=seen: (seen.append(args), denoise(*args))[1]
        torch.manual_seed(0)
        motion, _, losses = model.compute_training_outputs(
            TRUTH[:, -1:, :SPARSE_DIM], model.true_state(TRUTH[:, :-1]), TRUTH
        )
        assert float(motion[..., ROTATION].detach().abs().max()) == pytest.approx(1)  # kept within limits
        found.append({name: float(term.detach()) for name, term in losses.items()})
    (noisy, time, encoded), *_ = seen
    frames = model.normalizer.encode(TRUTH)
    signal = model.diffusion.signal[time][:, None, None]
    noise = (noisy - signal.sqrt() * frames[..., SPARSE_DIM:][..., ROTATION]) / (1 - signal).sqrt()
    torch.testing.assert_close(encoded, frames[..., :SPARSE_DIM])
    assert len(set(time.tolist())) > 20
    assert float(noise.std()) == pytest.approx(1, abs=0.02)
    error = float((denoise(noisy, time, encoded).noise.detach() - noise).square().mean())
    assert found[0]["noise"] == pytest.approx(error, rel=1e-4)
    assert found[1] == pytest.approx({"noise": 0.5 * error, "bound": 3 * found[0]["bound"]}, rel=1e-4)


@torch.no_grad()
def test_windows_are_denoised_together_and_averaged_where_they_overlap(monkeypatch):
    """Window by window and frame by frame, with steps that add noise."""
    monkeypatch.setattr(ancestral, "FIRST_NOISY_TIME", 1)
    model = tiny.baseline("bodiffusion", offline=True, sampling_steps=6, depth=1).double()
    sparse = CLIP[:, :SPARSE_DIM].double()
    noise = torch.randn(6, 25, 132, generator=torch.Generator().manual_seed(0)).double()
    found = model.predict_clip(sparse)
    encoded = model.normalizer.encode_sparse(sparse, model.normalizer.find_origin(sparse))
    x = noise[0]
    for index in range(6):
        sums, variances, covered = torch.zeros_like(x), torch.zeros_like(x), torch.zeros(25, 1)
        for begin in (0, 3, 6, 9, 12, 15, 18):
            part = slice(begin, begin + 7)
            mean, variance = model.step(x[None, part], encoded[None, part], index)
            sums[part] += mean[0]
            variances[part] += variance[0]
            covered[part] += 1
        x = sums / covered + (variances.sqrt() / covered * noise[index + 1] if index < 5 else 0)
    torch.testing.assert_close(found, model.normalizer.decode_rotations(x, sparse), atol=1e-9, rtol=0)


@torch.no_grad()
def test_offline_it_is_no_stream():
    model, clip, changed = tiny.baseline("bodiffusion", offline=True), CLIP[:14], CLIP[:14].clone()
    changed[-1] += 0.5
    before, after = (modes.predict_windows(model, [one])[0] for one in (clip, changed))
    assert not torch.allclose(before[4], after[4])  # the windows in between carry it there
    assert not model.is_stream
    assert not has_streaming_graph(model)
    with pytest.raises(InputError, match=r"model\.offline=true"):
        make_streaming_graph(model)
    evaluate = partial(Evaluation(["window"], 4, NoIK(), 0).report, test=tiny.frames((20,)), mode="window")
    assert evaluate(model)["offline"]
    assert "offline" not in evaluate(tiny.baseline("bodiffusion"))
