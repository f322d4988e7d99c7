"""The baselines: published sizes, their parts computed independently, streams, export, refusals."""

from pathlib import Path

import numpy as np
import pytest
import tiny
import torch

from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment, config_of
from memmlp.config.compose import composed
from memmlp.deploy import latency
from memmlp.deploy.export import export
from memmlp.deploy.parity import TOLERANCE, parity
from memmlp.evaluation import modes as evaluation
from memmlp.motion.body import MOTION_DIM, PARENTS, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.coordinates import Heading, World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.baselines.agrol import TimeEmbedding
from memmlp.networks.baselines.avatar_poser import Attention, EncoderLayer
from memmlp.networks.baselines.diffusion import Diffusion, cosine_schedule
from memmlp.networks.window_model import WindowModel
from memmlp.runs.lookup import list_runs
from memmlp.training.losses import AGRoLLoss, AvatarPoserLoss

NAMES = list(tiny.BASELINES)
CLIP = tiny.clip(40)
SPARSE = CLIP[None, :, :SPARSE_DIM]
SHORT = [
    "profile=tiny",
    "data.synth.minutes=0.2",
    "tracking=none",
    "threads=1",
    "optim.steps=2",
    "model.depth=2",
]


def built(*overrides: str) -> WindowModel:
    """The network of a command line, with random weights."""
    architecture = build_experiment(composed(list(overrides))).architecture
    return architecture.build(Normalizer.raw(architecture.coordinates, tiny.REST), None).eval()


# Parameters: as counted by hand in the docstrings, and as Table 16 prints them. MACs of a streaming step:
# 12 blocks of T T d + T d d, stem and head for AGRoL; its denoiser five times, with a linear a block and the
# embedding's two for one row. For AvatarPoser 4 d d + 2 d f a layer and frame, and the products of attention.
PUBLISHED = {
    "agrol_mlp": (3_735_668, 3.74, 12 * (196**2 * 512 + 196 * 512**2) + 196 * 512 * (54 + 132)),
    "agrol_diffusion": (
        7_480_436,
        7.48,
        5 * (12 * (196**2 * 512 + 197 * 512**2) + 196 * 512 * (186 + 132) + 2 * 512**2),
    ),
    "avatar_poser": (
        4_124_804,
        4.12,
        3 * 40 * (4 * 256**2 + 2 * 256 * 2048 + 2 * 40 * 256) + 40 * 54 * 256 + 2 * 256**2 + 256 * 132,
    ),
}


@pytest.mark.parametrize("name", NAMES)
def test_paper_profile_has_the_published_size(name):
    count, millions, macs = PUBLISHED[name]
    model = built(f"model={name}", "profile=paper")
    assert model.count_parameters() == count
    assert round(model.count_parameters() / 1e6, 2) == millions
    kinematics = 22 * 3**3  # the rotations of the newest frame along the tree
    assert latency.macs(model) == macs + kinematics


def test_published_work():
    """Table 16 has the MACs of AGRoL-MLP, 0.88 G, and twice those of AvatarPoser, 0.33 G, as FLOPs."""
    assert PUBLISHED["agrol_mlp"][2] / 1e9 == pytest.approx(0.88, abs=0.015)
    assert 2 * PUBLISHED["avatar_poser"][2] / 1e9 == pytest.approx(0.33, abs=0.015)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_stream_is_the_last_frame_of_windows_with_full_history(name):
    model = tiny.baseline(name, Heading())
    size = model.frames
    stream = evaluation.stream(model, [CLIP])[0]
    for end in (size, 20, 40):
        window = model.advance(SPARSE[:, end - size : end], model.initial_state(1))[0]
        torch.testing.assert_close(window[0, -1], stream[end - 1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_fresh_start_is_the_first_frame_for_a_window(name):
    model = tiny.baseline(name)
    first = model.advance(SPARSE[:, :1], model.initial_state(1), 1)[0]
    still = model.advance(SPARSE[:, :1].expand(-1, model.frames, -1), model.initial_state(1), 1)[0]
    torch.testing.assert_close(first, still)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("mode", ["stream", "window"])
@torch.no_grad()
def test_side_by_side_is_one_by_one_and_short_clips_count(name, mode):
    model = tiny.baseline(name)
    clips = [tiny.clip(n, seed=n) for n in (4, 25, 14)]
    for together, clip in zip(evaluation.predict(model, clips, mode, 8), clips, strict=True):
        assert together.shape == (len(clip), MOTION_DIM)
        alone = evaluation.predict(model, [clip], mode, 8)[0]
        torch.testing.assert_close(together, alone, atol=1e-5, rtol=0)


@torch.no_grad()
def test_avatar_poser_is_the_same_in_both_modes():
    """Every frame has its own window, so a clip of whole windows is the same in both."""
    model = tiny.baseline("avatar_poser")
    clip = CLIP[: 5 * model.frames]
    torch.testing.assert_close(evaluation.window(model, [clip])[0], evaluation.stream(model, [clip])[0])


@torch.no_grad()
def test_agrol_windows_see_nothing_of_other_windows():
    model, changed = tiny.baseline("agrol_mlp"), CLIP.clone()
    changed[:7] += 0.5
    before, after = evaluation.window(model, [CLIP])[0], evaluation.window(model, [changed])[0]
    assert torch.equal(before[7:], after[7:])
    assert not torch.allclose(before[6], after[6])


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_positions_are_forward_kinematics_of_the_rotations(name):
    model = tiny.baseline(name, Heading())
    motion = evaluation.stream(model, [CLIP])[0]
    expected = model.normalizer.pose(motion, CLIP[:, :SPARSE_DIM]).flatten(1)
    torch.testing.assert_close(motion[:, ROTATION.stop :], expected, atol=1e-5, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_torch_and_onnx_agree_on_a_whole_clip(name, tmp_path):
    """Relative to the heading, which makes the larger graph; in the world in the command below."""
    model = tiny.baseline(name, Heading())
    export(model, tmp_path / "step.onnx", "0" * 16)
    assert parity(model, tmp_path / "step.onnx", CLIP) <= TOLERANCE


def test_cosine_schedule_is_the_papers():
    signal = cosine_schedule(1000).numpy()
    level = np.cos((np.arange(1001) / 1000 + 0.008) / 1.008 * np.pi / 2) ** 2
    np.testing.assert_allclose(signal[:-1], (level / level[0])[1:-1], rtol=1e-9)
    assert signal[-1] == pytest.approx(signal[-2] * 0.001)


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_ddim_is_an_independent_numpy_computation(steps):
    """The denoiser is an affine map of the noisy signal and the time."""
    diffusion = Diffusion(20, steps).double()
    noise = np.random.default_rng(0).normal(size=(2, 4, 3))
    found = diffusion.sample(lambda x, t: 0.7 * x + 0.1 + 0.01 * t[:, None, None], torch.tensor(noise))
    betas = [
        min(1 - np.cos(((i + 1) / 20 + 0.008) / 1.008 * np.pi / 2) ** 2 /
            np.cos((i / 20 + 0.008) / 1.008 * np.pi / 2) ** 2, 0.999)
        for i in range(20)
    ]  # fmt: skip
    alphas = np.cumprod(1 - np.array(betas))
    x, times = noise, [20 * k // steps - 1 for k in range(steps, 0, -1)]
    for origin, t in enumerate(times):
        clean = 0.7 * x + 0.1 + 0.01 * t
        epsilon = (x - np.sqrt(alphas[t]) * clean) / np.sqrt(1 - alphas[t])
        after = alphas[times[origin + 1]] if origin + 1 < steps else 1.0
        x = np.sqrt(after) * clean + np.sqrt(1 - after) * epsilon
    assert times[0] == 19
    np.testing.assert_allclose(found.numpy(), x, atol=1e-5)


def test_training_noise_has_the_schedules_variance():
    diffusion = Diffusion(10, 2)
    clean, noise = torch.full((10, 3), 2.0), torch.full((10, 3), 0.5)
    noisy = diffusion.noised(clean, torch.arange(10), noise).numpy()
    signal = cosine_schedule(10).numpy()
    expected = (np.sqrt(signal) * 2 + np.sqrt(1 - signal) * 0.5)[:, None].repeat(3, 1)
    np.testing.assert_allclose(noisy, expected, rtol=1e-5)


def test_a_perfect_denoiser_is_found_again():
    """Whatever the noise and the steps, a denoiser that knows the answer gives it."""
    answer = torch.randn(2, 5)
    torch.testing.assert_close(Diffusion(50, 4).sample(lambda x, t: answer, torch.randn(2, 5)), answer)


def test_the_denoiser_learns_from_the_noised_truth_of_the_window():
    """The training call gives the denoiser noised true rotations, drawn times and the window's inputs."""
    model, seen = tiny.baseline("agrol_diffusion"), []
    denoise = model.denoise
    model.denoise = lambda *args: (seen.append(args), denoise(*args))[1]
    truth = tiny.clip(7)[None].expand(64, -1, -1)
    state = model.true_state(truth[:, :-1])
    torch.manual_seed(0)
    motion, _ = model.learn(truth[:, -1:, :SPARSE_DIM], state, truth)
    (noisy, time, encoded), *_ = seen
    frames = model.normalizer.encode(truth)
    signal = model.diffusion.signal[time][:, None, None]
    noise = (noisy - signal.sqrt() * frames[..., SPARSE_DIM:][..., ROTATION]) / (1 - signal).sqrt()
    assert motion.shape == (64, 7, MOTION_DIM)
    torch.testing.assert_close(encoded, frames[..., :SPARSE_DIM])
    assert set(time.tolist()) <= set(range(50))
    assert len(set(time.tolist())) > 20
    assert float(noise.mean()) == pytest.approx(0, abs=0.02)
    assert float(noise.std()) == pytest.approx(1, abs=0.02)


def test_time_embedding_is_of_sines_and_cosines():
    embedding = TimeEmbedding(8)
    embedding.mlp = torch.nn.Identity()
    angles = 7 * 10_000 ** -(np.arange(4) / 4)
    expected = np.concatenate([np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose(embedding(torch.tensor([7]))[0].numpy(), expected, rtol=1e-5)


@torch.no_grad()
def test_attention_is_an_independent_computation():
    """Frame by frame and head by head, in NumPy; and the same as torch's own with the same weights."""
    attention, h = Attention(8, 2).double(), torch.randn(3, 5, 8, dtype=torch.float64)

    def linear(layer, x):
        return x @ layer.weight.numpy().T + layer.bias.numpy()

    expected = np.zeros((3, 5, 8))
    for b, x in enumerate(h.numpy()):
        query, key, value = (linear(of, x) for of in (attention.query, attention.key, attention.value))
        for t in range(5):
            for part in (slice(0, 4), slice(4, 8)):
                scores = np.array([query[t, part] @ key[s, part] / 2.0 for s in range(5)])
                share = np.exp(scores) / np.exp(scores).sum()
                expected[b, t, part] = sum(share[s] * value[s, part] for s in range(5))
    found = attention(h).numpy()
    np.testing.assert_allclose(found, linear(attention.out, expected), atol=1e-12)


@torch.no_grad()
def test_avatar_poser_reads_the_newest_frame_and_knows_no_order_of_the_others():
    model, window = tiny.baseline("avatar_poser").double(), torch.randn(1, 7, SPARSE_DIM).double()
    found = model.rotations(window)
    torch.testing.assert_close(model.rotations(window[:, [3, 1, 5, 0, 2, 4, 6]]), found)
    assert not torch.allclose(model.rotations(window[:, [6, 1, 2, 3, 4, 5, 0]]), found, atol=1e-3)


@torch.no_grad()
def test_the_encoder_layer_is_torchs():
    layer, torchs = EncoderLayer(8, 2, 16, 0.1).eval(), torch.nn.TransformerEncoderLayer(8, 2, 16).eval()
    parts = [layer.attention.query, layer.attention.key, layer.attention.value]
    torchs.self_attn.in_proj_weight.copy_(torch.cat([part.weight for part in parts]))
    torchs.self_attn.in_proj_bias.copy_(torch.cat([part.bias for part in parts]))
    pairs = [
        (torchs.self_attn.out_proj, layer.attention.out), (torchs.linear1, layer.widen),
        (torchs.linear2, layer.narrow), (torchs.norm1, layer.attention_norm), (torchs.norm2, layer.norm),
    ]  # fmt: skip
    for theirs, ours in pairs:
        theirs.load_state_dict(ours.state_dict())
    h = torch.randn(5, 3, 8)
    torch.testing.assert_close(layer(h.transpose(0, 1)), torchs(h).transpose(0, 1), atol=1e-5, rtol=0)


DRAWN = [torch.randn(2, 3, MOTION_DIM, generator=torch.Generator().manual_seed(i)) for i in (1, 2)]


@pytest.mark.parametrize("error", ["norm", "square"])
def test_agrols_loss_is_that_of_its_code_or_of_its_paper(error):
    """The mean over frames and joints of each joint's L2 norm, or the mean of squares, in network space."""
    (motion, truth), normalizer = DRAWN, tiny.normalizer(World())
    loss, terms = AGRoLLoss(error)(motion, truth, SPARSE[:, :3].expand(2, -1, -1), normalizer)
    scaled = (motion - truth)[..., ROTATION].numpy() / normalizer.std[SPARSE_DIM:][ROTATION].numpy()
    norms = [np.sqrt((scaled[b, t, 6 * j : 6 * j + 6] ** 2).sum()) for b, t, j in np.ndindex(2, 3, 22)]
    expected = {"norm": np.mean(norms), "square": np.mean(scaled**2)}
    assert float(loss) == pytest.approx(expected[error], rel=1e-4)
    assert set(terms) == {"rotation"}
    assert float(AGRoLLoss()(motion, truth, SPARSE[:, :3].expand(2, -1, -1), normalizer)[0]) == pytest.approx(
        expected["norm"], rel=1e-4
    )


@pytest.mark.parametrize("anchor", ["pelvis", "head"])
def test_avatar_posers_loss_compares_bodies_at_the_pelvis_or_at_the_tracker(anchor):
    """Joint by joint down the tree, in NumPy; by default as its released code has it."""
    (motion, truth), normalizer = DRAWN, tiny.normalizer(World())
    sparse = SPARSE[:, :3].expand(2, -1, -1)
    loss, terms = AvatarPoserLoss(anchor=anchor)(motion, truth, sparse, normalizer)
    difference = (motion - truth)[..., ROTATION].numpy()
    errors = []
    for b, t in np.ndindex(2, 3):
        body = posed(motion[b, t, ROTATION].numpy())
        true = truth[b, t, ROTATION.stop :].numpy().reshape(22, 3)
        head = sparse[b, t, SPARSE_POSITION][:3].numpy()
        pair = {"pelvis": (body, true - true[0]), "head": (body + head - body[15], true)}
        errors.append(np.abs(pair[anchor][0] - pair[anchor][1]))
    expected = {
        "orientation": np.abs(difference[..., :6]).mean(),
        "rotation": np.abs(difference[..., 6:]).mean(),
        "position": np.mean(errors),
    }
    assert {name: float(term) for name, term in terms.items()} == pytest.approx(expected, rel=1e-4)
    weights = {"orientation": 0.02, "rotation": 1.0, "position": 1.0}
    assert float(loss) == pytest.approx(sum(weights[name] * expected[name] for name in weights), rel=1e-4)
    assert (float(AvatarPoserLoss()(motion, truth, sparse, normalizer)[0]) == float(loss)) == (
        anchor == "pelvis"
    )


def posed(rotation: np.ndarray) -> np.ndarray:
    """Return the joints (22, 3) of local 6D rotations (132,), the pelvis at the origin."""
    turns, places = [], []
    for joint, sixd in enumerate(rotation.reshape(22, 2, 3).astype(np.float64)):
        x = sixd[0] / np.linalg.norm(sixd[0])
        y = sixd[1] - (x @ sixd[1]) * x
        y /= np.linalg.norm(y)
        local, parent = np.stack([x, y, np.cross(x, y)], 1), PARENTS[joint]
        rest = tiny.REST.numpy()
        turns.append(local if parent < 0 else turns[parent] @ local)
        places.append(
            np.zeros(3) if parent < 0 else places[parent] + turns[parent] @ (rest[joint] - rest[parent])
        )
    return np.array(places)


def test_baselines_see_what_their_authors_give_them():
    """World coordinates, and z-scores of the diffusion model alone; what is asked for wins."""
    features = {name: tuple(composed([f"model={name}"]).frame.values()) for name in NAMES}
    raw = ("world", False)
    assert features == {"agrol_mlp": raw, "avatar_poser": raw, "agrol_diffusion": ("world", True)}
    asked = composed(["model=agrol_mlp", "frame.coordinates=heading", "frame.normalize=true"]).frame
    assert tuple(asked.values()) == ("heading", True)
    assert tuple(composed([]).frame.values()) == ("heading", True)


def test_avatar_posers_loss_on_positions_reaches_the_rotations():
    motion = CLIP[None, :3, SPARSE_DIM:].clone().requires_grad_()
    truth = tiny.clip(3, seed=9)[None, :, SPARSE_DIM:]
    AvatarPoserLoss(0, 0, 1)(motion, truth, SPARSE[:, :3], tiny.normalizer())[0].backward()
    assert float(motion.grad[..., ROTATION].abs().sum()) > 0


KNOBS = [
    ("agrol_mlp", {"frames": 6}), ("agrol_mlp", {"depth": 3}), ("agrol_mlp", {"width": 12}),
    ("agrol_diffusion", {"diffusion_steps": 60}), ("agrol_diffusion", {"sampling_steps": 2}),
    ("agrol_diffusion", {"noise_seed": 1}), ("agrol_diffusion", {"depth": 3}),
    ("avatar_poser", {"frames": 6}), ("avatar_poser", {"heads": 2}), ("avatar_poser", {"feedforward": 16}),
    ("avatar_poser", {"depth": 3}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change"), KNOBS, ids=str)
@torch.no_grad()
def test_every_knob_changes_the_motion(name, change):
    base, other = (evaluation.stream(tiny.baseline(name, **c), [CLIP])[0] for c in ({}, change))
    assert not torch.allclose(base, other, atol=1e-4)


def test_dropout_drops_in_training_alone():
    model = tiny.baseline("avatar_poser", dropout=0.5)
    call = SPARSE[:, :7], model.initial_state(1), CLIP[None, :7]
    assert torch.equal(model.learn(*call)[0], model.learn(*call)[0])
    model.train()
    assert not torch.equal(model.learn(*call)[0], model.learn(*call)[0])


def test_sampling_draws_nothing():
    model = tiny.baseline("agrol_diffusion")
    runs = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        runs.append(evaluation.stream(model, [CLIP])[0])
    assert torch.equal(*runs)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_command_does_it_all_and_finds_it_again(name, memmlp):
    ran = memmlp("train", f"model={name}", *SHORT)
    assert ran.code == 0, ran.err
    (run,) = list_runs(Path("outputs"))
    assert run.done
    assert set(run.results) == {"window", "stream", "latency"}
    assert run.results["stream"]["rotation"]["MPJPE"] > 0
    assert run.results["latency"]["onnx_parity"] <= TOLERANCE
    assert run.results["latency"]["macs"] > 0
    assert run.manifest["upstream"] is None
    assert "finished already" in memmlp("train", f"model={name}", *SHORT).out
    loaded = build_experiment(config_of(run)).architecture.load(run.model)
    assert parity(loaded, run.onnx, CLIP) <= TOLERANCE


def identity(*overrides: str) -> str:
    return build_experiment(composed(list(overrides))).identity("d").id


@pytest.mark.slow
def test_networks_have_identities_of_their_own_that_stay_what_they_are():
    """Moving code, renaming classes and new keys that stand at their default change none of them."""
    assert len({identity(), *(identity(f"model={name}") for name in NAMES)}) == 4
    assert identity("model=agrol_mlp", "vqvae.codes=3") == identity("model=agrol_mlp")
    assert identity() == "fb6eb5c146b3c909"
    assert identity("profile=tiny") == "2dba0fa264a59214"
    assert identity("memory=none") == "8027b7f0e25d0134"
    assert identity("memory=lstm") == "4bcad95949d5dae3"
    assert identity("experiment=paper") == "b3be0d19ac52afce"
    assert identity("experiment=rotation_only") == "8449a2994b18839f"


REFUSED = [
    (["model=agrol_mlp", "memory=vq"], "memory"),
    (["model=avatar_poser", "memory=none"], "memory"),
    (["model=avatar_poser", "predictor=rotation_only"], "predictor"),
    (["model=agrol_mlp", "hand=fk"], "hand"),
    (["model=agrol_diffusion", "rollout=streams"], "rollout"),
    (["model=agrol_mlp", "rollout=own_predictions"], "rollout"),
    (["model=agrol_mlp", "loss=uncertainty"], "loss"),
    (["model=agrol_mlp", "experiment=manual_weights"], "loss"),
    (["model=agrol_mlp", "evaluation.ik=lbfgs"], "evaluation.ik"),
    (["model=agrol_mlp", "memory.width=4"], "memory.width"),
    (["model=agrol_mlp", "model.heads=4"], "model.heads"),
    (["model=avatar_poser", "model.heads=7"], "model.heads"),
    (["model=agrol_diffusion", "model.sampling_steps=2000"], "model.sampling_steps"),
    (["model=agrol_diffusion", "model.diffusion_steps=0"], "model.diffusion_steps"),
    (["loss=agrol"], "predictor=rotation_only with hand=off"),
    (["loss=agrol", "predictor=rotation_only", "hand=fk"], "predictor=rotation_only with hand=off"),
    (
        ["loss=avatar_poser", "predictor=rotation_only", "hand=off"],
        "allowed is loss=uncertainty or loss=manual",
    ),
    (["model=agrol_mlp", "loss.error=cube"], "loss.error=cube"),
    (["model=avatar_poser", "loss.anchor=foot"], "loss.anchor=foot"),
]


@pytest.mark.parametrize(("overrides", "word"), REFUSED, ids=[" ".join(options) for options, _ in REFUSED])
def test_what_makes_no_sense_is_refused_in_one_line(overrides, word):
    with pytest.raises(InputError) as refusal:
        composed(overrides)
    assert word in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("profile", ["tiny", "small", "paper"])
def test_profiles_and_the_papers_experiment_fit(name, profile):
    cfg = composed([f"model={name}", "experiment=paper", f"profile={profile}", "model.frames=9"])
    assert cfg.model.frames == 9
    assert (cfg.memory, cfg.predictor, cfg.hand) == (None, None, None)
    assert build_experiment(cfg).config["model"]["_target_"].startswith("memmlp.networks.baselines.")
