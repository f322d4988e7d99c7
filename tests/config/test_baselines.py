"""Baselines by configs: published sizes, identities, refusals."""

import pytest
import tiny

from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment
from memmlp.config.compose import composed
from memmlp.deploy import latency
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import MotionModel

NAMES = list(tiny.BASELINES)


def built(*overrides: str) -> MotionModel:
    """The network of a command line, with random weights."""
    architecture = build_experiment(composed(list(overrides))).architecture
    return architecture.build(Normalizer.raw(architecture.coordinates, tiny.REST), None).eval()


# Parameters: as counted by hand in the docstrings, and in millions; Table 16 has those of the first three so.
# MACs of a streaming step: 12 blocks of T T d + T d d, stem and head for AGRoL; its denoiser five times, with
# a linear a block and the embedding's two for one row. For AvatarPoser and EgoPoser 4 d d + 2 d f a layer and
# token, and the products of attention.
# Of each frame of MANIKIN's, kinematics of the trunk and products of 3 x 3 in the limbs; of the bones, once.
KINEMATICS = 21 * (27 + 9)  # a turn and an offset for each joint but the root
SOLVED, BONES = KINEMATICS + 87 * 27, 16 * 9
PUBLISHED = {
    "agrol_mlp": (3_735_668, 3.74, 12 * (196**2 * 512 + 196 * 512**2) + 196 * 512 * (54 + 132)),
    "agrol_diffusion": (
        7_480_436,
        7.48,
        5 * (12 * (196**2 * 512 + 197 * 512**2) + 196 * 512 * (186 + 132) + 2 * 512**2),
    ),
    "bodiffusion": (
        21_942_270,
        21.94,
        25  # calls of the denoiser; the paper counts one
        * (
            12 * (41 * 6 * 384**2 + 2 * 41**2 * 384 + 6 * 384**2)
            + 41 * (2 * 528 * 384 + 18 * 3 * 22 + 22 * 24 * 12) + 256 * 384 + 384**2
        ),
    ),
    "avatar_poser": (
        4_124_804,
        4.12,
        3 * 40 * (4 * 256**2 + 2 * 256 * 2048 + 2 * 40 * 256) + 40 * 54 * 256 + 2 * 256**2 + 256 * 132,
    ),
    "ego_poser": (
        4_126_340,
        4.13,
        3 * 40 * (4 * 256**2 + 2 * 256 * 2048 + 2 * 40 * 256) + 80 * 60 * 256 + 2 * 256**2 + 256 * 132,
    ),
    "hmd_poser": (
        17_444_484,
        17.44,
        5 * 18 * 64 + 3 * (12 * 120 + 3 * 16) + 16 * 8 * 256**2  # tokens and LSTMs
        + 6 * 8 * (4 * 256**2 + 2 * 256 * 2048 + 2 * 8 * 256) + 8 * 256**2 + 256 * 132
        + 3 * 27 + 2 * (2 * 27 + 2 * 9) + 2 * 27,  # the hands in the head's frame, now and before
    ),
    "vae_hmd": (853_958, 0.85, (27 + 60 + 30 + 132 + 12 * 256) * 256),
    "avatar_jlm": (
        63_807_240,
        63.81,
        41 * ((396 + 1024 + 132) * 1024 + 22 * 9 * 512 + 1024 * 512 + (45 * 512 + 132) * 1024)
        + 12 * 41 * 45 * (4 * 512**2 + 2 * 512 * 2048) + 6 * 41 * 45 * 2 * (45 + 41) * 512
        + 41 * KINEMATICS,  # the coarse pose of each frame
    ),
    "manikin_s": (
        4_244_566,
        4.24,
        3 * 40 * (4 * 256**2 + 2 * 256 * 2048 + 2 * 40 * 256) + 40 * 54 * 256
        + 4 * 256**2 + 256 * 86 + SOLVED + BONES,
    ),
    "manikin_l": (
        63_889_240,
        63.89,
        41 * ((396 + 1024 + 132) * 1024 + 22 * 9 * 512 + 1024 * 512 + (45 * 512 + 212) * 1024)
        + 12 * 41 * 45 * (4 * 512**2 + 2 * 512 * 2048) + 6 * 41 * 45 * 2 * (45 + 41) * 512
        + 41 * KINEMATICS + 41 * SOLVED + BONES,
    ),
    "sage": (
        120_269_534,
        120.27,
        2 * (20 * (3 * 22 * 18 + 396 * 512) + 10 * 20 * 512)  # what the denoisers see, once
        + 5  # calls of both
        * (
            2 * 12 * (10 * 12 * 512**2 + 2 * 10**2 * 512 + 6 * 512**2)
            + 2 * (10 * (896 * 512 + 512 * 384) + 10 * 10 * 384 + 256 * 512 + 512**2) + 10 * 768 * 384
        )
        + 20 * (3 * 22 * 18 + 396 * 384) + 10 * 20 * 384 + 10 * 1152 * 256  # the decoder
        + 4 * (10 * 12 * 256**2 + 2 * 10**2 * 256) + 10 * 3 * 256**2 + 20 * (3 * 256**2 + 256 * 132),
    ),
    "rpm": (
        9_889_412 - 512 * 513,  # the released code has a layer that nothing uses
        9.63,
        4 * 20 * (4 * 512**2 + 2 * 512 * 1024 + 2 * 20 * 512)
        + (2 * 20 + 2 * 11) * 512**2 + 2 * 20 * 11 * 512 + (20 * 132 + 11 * 54 + 10 * 132) * 512,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_paper_profile_has_the_published_size(name, monkeypatch):
    """Weights are counted, not drawn."""
    monkeypatch.setattr("torch.nn.Linear.reset_parameters", lambda layer: None)
    monkeypatch.setattr("torch.Tensor.normal_", lambda tensor, *_, **options: tensor.zero_())
    count, millions, macs = PUBLISHED[name]
    model = built(f"model={name}", "profile=paper")
    assert model.count_parameters() == count
    assert round(model.count_parameters() / 1e6, 2) == millions
    assert latency.macs(model) == macs + KINEMATICS


def test_published_work():
    """Table 16 has the MACs of AGRoL-MLP, 0.88 G, and twice those of AvatarPoser, 0.33 G, as FLOPs.

    Of BoDiffusion it has one call's, 0.46 G; of SAGE-Net the MACs, 4.10 G.
    """
    assert PUBLISHED["agrol_mlp"][2] / 1e9 == pytest.approx(0.88, abs=0.015)
    assert PUBLISHED["bodiffusion"][2] / 25 / 1e9 == pytest.approx(0.46, abs=0.02)
    assert 2 * PUBLISHED["avatar_poser"][2] / 1e9 == pytest.approx(0.33, abs=0.015)
    assert PUBLISHED["sage"][2] / 1e9 == pytest.approx(4.10, abs=0.06)


def test_baselines_see_what_their_authors_give_them():
    """World coordinates, and z-scores of the diffusion model and of RPM alone; what is asked for wins."""
    features = {name: tuple(composed([f"model={name}"]).normalizer.values()) for name in NAMES}
    scored = dict.fromkeys(("agrol_diffusion", "rpm"), ("world", True))
    assert features == dict.fromkeys(NAMES, ("world", False)) | scored
    asked = composed(
        ["model=agrol_mlp", "normalizer.coordinates=heading", "normalizer.z_scores=true"]
    ).normalizer
    assert tuple(asked.values()) == ("heading", True)
    assert tuple(composed([]).normalizer.values()) == ("heading", True)


def identity(*overrides: str) -> str:
    return build_experiment(composed(list(overrides))).identity("d").id


@pytest.mark.slow
def test_networks_have_identities_of_their_own_that_stay_what_they_are():
    """Moving code, renaming classes and new keys that stand at their default change none of them."""
    assert len({identity(), *(identity(f"model={name}") for name in NAMES)}) == len(NAMES) + 1
    assert identity("model=agrol_mlp", "vqvae.codes=3") == identity("model=agrol_mlp")
    assert identity() == "fb6eb5c146b3c909"
    assert identity("profile=tiny") == "2dba0fa264a59214"
    assert identity("memory=none") == "8027b7f0e25d0134"
    assert identity("memory=lstm") == "4bcad95949d5dae3"
    assert identity("experiment=paper") == "b3be0d19ac52afce"
    assert identity("experiment=rotation_only") == "8449a2994b18839f"


OFFLINE = ["model=bodiffusion", "model.offline=true", "evaluation.modes=[window]", "export.graph=off"]
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
    (["loss=agrol"], "predictor=rotation_only hand=off"),
    (["loss=agrol", "predictor=rotation_only", "hand=fk"], "predictor=rotation_only hand=off"),
    (
        ["loss=avatar_poser", "predictor=rotation_only", "hand=off"],
        "loss=avatar_poser",
    ),
    (["model=agrol_mlp", "loss.error=cube"], "loss.error=cube"),
    (["model=avatar_poser", "loss.anchor=foot"], "loss.anchor=foot"),
    (
        ["model=ego_poser", "normalizer.z_scores=true"],
        "normalizer.z_scores=true",
    ),
    (["model=rpm", "model.frames=19"], "model.context + model.horizon = 20"),
    (["model=manikin_l", "model.offline=true"], "evaluation.modes=[window] and export.graph=off"),
    (
        [*OFFLINE, "refiner=sage"],
        "refiner: must be null",
    ),
    (["model=bodiffusion", "model.noise_weight=0"], "model.noise_weight=0"),
    (["model=sage", "upstream=null"], "upstream=null"),
    (["upstream=sage"], "upstream=sage: must be null"),
    (["model=sage", "model.frames=21"], "model.frames=21: must be even"),
    (["model=sage", "model.code_heads=3"], "model.code_heads=3"),
    (["model=sage", "model.code_width=21", "model.code_heads=1"], "model.code_width=21"),
    (["model=sage", "upstream.decoder.lr_drop=0"], "upstream.decoder.lr_drop=0"),
    (["model=avatar_poser", "loss=of_network"], "loss=of_network"),
    (["loss=terms"], "loss=terms"),
    (["model=agrol_mlp", "loss=terms", "loss.jerk=-1"], "loss.jerk=-1"),
    (["model=agrol_mlp", "loss=terms", "loss.jerks=1"], "loss.jerks"),
    (["model=avatar_poser", "loss=kinematic"], "loss.velocity: must be null"),
    (["model=manikin_s", "loss=terms", "loss.contact=1"], "loss.contact: must be null"),
    (["model=sage", "loss=terms", "loss.jerk=1"], "loss.jerk: must be null"),
    (["model=hmd_poser", "model.frames=3", "loss=calm"], "loss.velocity_3: must be null"),
    (
        ["model=agrol_mlp", "export.precision=int8", "export.graph=naive"],
        "export.precision=int8: must be fp32",
    ),
    (["model=recurrent_poser", "evaluation.ik=arms"], "evaluation.ik=arms: must be off"),
]


@pytest.mark.slow
def test_an_impossible_combination_is_one_line():
    for overrides, word in REFUSED:
        with pytest.raises(InputError) as refusal:
            composed(overrides)
        assert word in str(refusal.value), overrides
        assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_arms_that_a_refiner_has_moved_may_reach_again():
    cfg = composed(["model=recurrent_poser", "refiner=sage", "evaluation.ik=arms"])
    assert (cfg.model.output, cfg.evaluation.ik) == ("reaching", "arms")


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["tiny", "small", "paper"])
def test_profiles_and_the_papers_experiment_fit(profile):
    for name in NAMES:
        cfg = composed([f"model={name}", "experiment=paper", f"profile={profile}", "model.frames=22"])
        assert cfg.model.frames == 22
        assert (cfg.memory, cfg.predictor, cfg.hand) == (None, None, None)
        assert build_experiment(cfg).config["model"]["name"] == name
