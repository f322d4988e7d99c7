"""SAGE-Net by one command: a run for each part, each upon the one before, and the whole upon the last."""

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment, load_config
from memmlp.config.compose import compose_config
from memmlp.networks import checkpoint
from memmlp.networks.sage_net import SAGENet
from memmlp.runs.lookup import check_trained, list_runs
from memmlp.training.run_stages import make_prerequisites
from memmlp.training.train_sage import PARTS

SHORT = [
    "model=sage", "profile=tiny", "data.synth.minutes=0.05", "loggers=none", "threads=1", "export.graph=off",
    "optim.steps=2", *(f"prerequisite.{part}.steps=2" for part in PARTS), "model.sampling_steps=1",
]  # fmt: skip


def tensors(run, prefix: str) -> dict[str, torch.Tensor]:
    return {name: tensor for name, tensor in checkpoint.read(run.model)[0].items() if name.startswith(prefix)}


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    assert one
    assert one.keys() == other.keys()
    return all(torch.equal(tensor, other[name]) for name, tensor in one.items())


@pytest.mark.slow
def test_one_command_trains_each_part_and_then_the_whole(memmlp):
    ran = memmlp("train", *SHORT)
    assert ran.code == 0, ran.err
    runs = {run.manifest["kind"]: run for run in list_runs(Path("outputs"))}
    chain = [runs[kind] for kind in (*PARTS, "memmlp")]
    assert [run.manifest["prerequisite"] for run in chain] == [None, *(run.id for run in chain[:-1])]
    assert all(run.done for run in chain)
    above = [one.id for one in reversed(chain[:-1])]
    assert [one["id"] for one in chain[-1].manifest["prerequisite_runs"]] == above
    assert [run.manifest["name"].partition(" ·")[0] for run in chain[:2]] == ["upper codes", "lower codes"]
    whole = chain[-1]
    assert isinstance(build_experiment(load_config(whole)).architecture.load(whole.model), SAGENet)
    errors = [whole.results[mode]["rotation"]["MPJPE"] for mode in ("window", "stream")]
    assert errors[0] == pytest.approx(errors[1], rel=0.01)  # every frame is the last one of its own window
    # what is finished stays as it is, until the whole is trained
    for at, prefix in enumerate(("codes.upper.", "codes.lower.", "model.upper.", "model.lower.")):
        assert same(tensors(chain[at], prefix), tensors(chain[3], prefix))
    for prefix in ("model.upper.", "model.lower."):
        assert same(tensors(chain[3], prefix), tensors(chain[4], prefix))
        assert not same(tensors(chain[4], prefix), tensors(whole, prefix))
    assert not same(tensors(chain[4], "model.decoder."), tensors(whole, "model.decoder."))
    assert not tensors(whole, "codes")
    stems = [tensors(chain[1], f"codes.{half}.stem.weight") for half in ("upper", "lower")]
    assert [stem.shape[1] for half in stems for stem in half.values()] == [14 * 24, 9 * 24]  # of each joint
    with pytest.raises(InputError, match="must be a finished"):
        check_trained(chain[0])
    # a part alone that is gone is made again, with the same weights
    weights = chain[2].model.read_bytes()
    chain[2].reset()
    experiment = build_experiment(compose_config(SHORT))
    made = make_prerequisites(experiment, experiment.motion.prepare(), chain[2].id)
    assert (made.id, made.model.read_bytes()) == (chain[2].id, weights)
    assert "finished already" in memmlp("train", *SHORT).out


FIRST = {
    "seed": (1, 0), "normalizer.z_scores": (True, 0), "model.frames": (10, 0), "model.code_width": (8, 0),
    "model.code_depth": (2, 0), "model.code_heads": (1, 0), "model.dropout": (0.2, 0),
    "data.drawn_by": ("clips", 0), "data.mirror": (True, 0), "optim.precision": ("bf16", 0),
    "prerequisite.upper_codes.steps": (3, 0), "prerequisite.upper_codes.lr_drop": (0.5, 0),
    "prerequisite.lower_codes.lr": (0.1, 1),
    "model.width": (8, 2), "model.depth": (2, 2), "model.heads": (1, 2), "model.diffusion_steps": (99, 2),
    "prerequisite.upper_diffusion.batch": (9, 2), "prerequisite.upper_diffusion.lr_drops_at": ([0.1], 2),
    "model.sampling_steps": (2, 3), "model.noise": (0.1, 3), "model.noise_seed": (1, 3),
    "prerequisite.lower_diffusion.steps": (3, 3),
    "loss.orientation": (1.0, 4), "prerequisite.decoder.lr": (0.1, 4),
    "optim.steps": (3, 5), "optim.lr": (0.1, 5), "optim.clip_norm": (1.0, 5),
    "optim.log_every": (3, 6), "evaluation.batch": (3, 6), "vqvae.codes": (3, 6),
}  # fmt: skip
"""By key: another value, and the first run of the chain that it changes; 5 is the network's, 6 is none."""


@pytest.mark.slow
def test_a_key_changes_the_runs_in_which_it_acts_and_all_that_build_upon_them():
    cfg = compose_config(SHORT)
    before = chain_of(cfg)
    assert len(set(before)) == 6
    for key, (value, first) in FIRST.items():
        other = cfg.copy()
        OmegaConf.update(other, key, value)
        after = chain_of(other)
        assert [one == two for one, two in zip(before, after, strict=True)] == [
            number < first for number in range(6)
        ], key


def chain_of(cfg) -> list[str]:
    experiment = build_experiment(cfg)
    return [identity.id for identity in experiment.compute_identities("d")]
