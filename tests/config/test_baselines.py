"""Baselines by configs: published sizes, identities, refusals."""

import pytest
import tiny
from conftest import long_except

from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment
from memmlp.config.compose import compose_config
from memmlp.deploy import latency
from memmlp.motion.normalizer import Normalizer

NAMES = list(tiny.BASELINES)


# Parameters and MACs of a streaming step at the published size, as counted by hand from the papers' layers.
# RPM is without a layer of the released code that nothing uses; of diffusion models every call is counted.
PUBLISHED = {
    "agrol_mlp": (3_735_668, 871_256_820), "agrol_diffusion": (7_480_436, 4_952_044_276),
    "bodiffusion": (21_942_270, 11_964_474_456), "avatar_poser": (4_124_804, 160_462_580),
    "ego_poser": (4_126_340, 161_138_420), "hmd_poser": (17_444_484, 72_069_115),
    "vae_hmd": (853_958, 850_932), "avatar_jlm": (63_807_240, 71_685_013_788),
    "manikin_s": (4_244_566, 160_585_125), "manikin_l": (63_889_240, 71_688_468_961),
    "sage": (120_269_534, 4_113_193_316), "rpm": (9_626_756, 188_221_172),
}  # fmt: skip
LARGE = ("bodiffusion", "avatar_jlm", "manikin_l", "sage")


@pytest.mark.slow
@pytest.mark.parametrize("name", long_except({*PUBLISHED} - {*LARGE}, PUBLISHED))
def test_paper_profile_has_the_published_size(name, monkeypatch):
    monkeypatch.setattr("torch.nn.Linear.reset_parameters", lambda layer: None)
    monkeypatch.setattr("torch.Tensor.normal_", lambda tensor, *_, **options: tensor.zero_())
    architecture = build_experiment(compose_config([f"model={name}", "profile=paper"])).architecture
    model = architecture.build(Normalizer.from_coordinates(architecture.coordinates, tiny.REST), None).eval()
    assert (model.count_parameters(), latency.count_macs(model)) == PUBLISHED[name]


def test_baselines_see_what_their_authors_give_them():
    """World coordinates, and z-scores of the diffusion model's motion and of RPM; what is asked for wins."""
    features = {name: tuple(compose_config([f"model={name}"]).normalizer.values()) for name in NAMES}
    scored = {"agrol_diffusion": ("world", True, True), "rpm": ("world", True, None)}
    assert features == dict.fromkeys(NAMES, ("world", False, None)) | scored
    asked = compose_config(
        ["model=agrol_mlp", "normalizer.coordinates=heading", "normalizer.z_scores=true"]
    ).normalizer
    assert tuple(asked.values()) == ("heading", True, None)
    assert tuple(compose_config([]).normalizer.values()) == ("heading", True, None)


def identity(*overrides: str) -> str:
    return build_experiment(compose_config(list(overrides))).identity("d").id


@pytest.mark.slow
def test_every_network_has_an_id_of_its_own_which_is_stable():
    """Moving code and renaming classes do not change ids."""
    assert len({identity(), *(identity(f"model={name}") for name in NAMES)}) == len(NAMES) + 1
    assert identity("model=agrol_mlp", "vqvae.codes=3") == identity("model=agrol_mlp")
    pinned = {
        (): "3803154ef315bb2c", ("memory=none",): "f04359ed87105979",
        ("experiment=paper",): "ae8e241e6f3b1a5a", ("model=sage", "refiner=sage"): "c8341dea1c4702e4",
    }  # fmt: skip
    assert {words: identity(*words) for words in pinned} == pinned


OFFLINE = ["model=bodiffusion", "model.offline=true", "evaluation.modes=[window]", "export.graph=off"]
REFUSED = [
    (["model=agrol_mlp", "memory=vq"], "memory"), (["model=avatar_poser", "memory=none"], "memory"),
    (["model=agrol_mlp", "hand=fk"], "hand"), (["model=agrol_diffusion", "rollout=streams"], "rollout"),
    (["model=agrol_mlp", "evaluation.ik=lbfgs"], "evaluation.ik"),
    (["model=agrol_mlp", "memory.width=4"], "memory.width"),
    (["model=avatar_poser", "model.heads=7"], "model.heads"),
    (["model=agrol_diffusion", "model.sampling_steps=2000"], "model.sampling_steps"),
    ([*OFFLINE, "model.sampler=released", "model.sampling_steps=1"], "model.sampling_steps=1: must be"),
    (["loss=agrol"], "predictor=rotation_only hand=off"),
    (["loss=agrol", "predictor=rotation_only", "hand=fk"], "predictor=rotation_only hand=off"),
    (["model=agrol_mlp", "loss.error=cube"], "loss.error=cube"),
    (["model=ego_poser", "normalizer.z_scores=true"], "normalizer.z_scores=true"),
    (["model=rpm", "model.frames=19"], "model.context + model.horizon = 20"),
    (["model=manikin_l", "model.offline=true"], "evaluation.modes=[window] and export.graph=off"),
    ([*OFFLINE, "refiner=sage"], "refiner: must be null"),
    (["model=sage", "prerequisite=null"], "prerequisite=null"),
    (["prerequisite=sage"], "prerequisite=sage: must be null"),
    (["model=sage", "model.frames=21"], "model.frames=21: must be even"),
    (["model=sage", "model.code_width=21", "model.code_heads=1"], "model.code_width=21"),
    (["model=avatar_poser", "loss=of_network"], "loss=of_network"), (["loss=terms"], "loss=terms"),
    (["model=manikin_s", "loss=terms", "loss.contact=1"], "loss.contact: must be null"),
    (["model=hmd_poser", "model.frames=3", "loss=calm"], "loss.velocity_3: must be null"),
    (["model=agrol_mlp", "export.precision=int8", "export.graph=naive"], "export.precision=int8: must be"),
    (["model=recurrent_poser", "evaluation.ik=arms"], "evaluation.ik=arms: must be off"),
]  # fmt: skip


@pytest.mark.slow
def test_an_impossible_combination_is_one_line():
    for overrides, word in REFUSED:
        with pytest.raises(InputError) as refusal:
            compose_config(overrides)
        assert word in str(refusal.value), overrides
        assert "\n" not in str(refusal.value)
    cfg = compose_config(["model=recurrent_poser", "refiner=sage", "evaluation.ik=arms"])
    assert (cfg.model.output, cfg.evaluation.ik) == ("reaching", "arms")


def test_a_scale_multiplies_the_widths_of_any_network():
    poser = compose_config(["model=avatar_poser", "profile=small", "profile.scale=2"])
    assert (poser.model.width, poser.model.feedforward, poser.model.depth) == (128, 1024, 3)
    mem = compose_config(["profile=small", "profile.scale=0.5", "profile.width=64"])
    assert (mem.model.width, mem.memory.width, mem.vqvae.width) == (32, 12, 128)


def test_the_kinematic_loss_has_no_movements_for_a_network_that_learns_one_frame():
    one, many = (compose_config([f"model={name}", "loss=kinematic"]) for name in ("ego_poser", "rpm"))
    assert [one.loss.velocity, one.loss.velocity_5] == [None, None]
    assert [many.loss.velocity, many.loss.velocity_5] == [1000.0, 250.0]


def test_the_recipe_is_the_default_at_its_size_and_the_command_line_wins():
    """The small Mem-MLP has the rate that a search found; the paper's size has the paper's."""

    def recipe(*words: str) -> tuple[float, float]:
        optim = compose_config(list(words)).optim
        return optim.lr, optim.warmup

    assert recipe("profile=small") == (8e-3, 0.05)
    assert recipe("profile=small", "optim.lr=1e-3", "optim.warmup=100") == (1e-3, 100)
    assert recipe("experiment=paper") == (3e-4, 0)
    assert recipe("profile=paper", "profile.lr=1e-4") == (1e-4, 0)
    with pytest.raises(InputError, match=r"profile\.lr=2e-3: has no effect"):
        recipe("profile=small", "profile.lr=2e-3")
