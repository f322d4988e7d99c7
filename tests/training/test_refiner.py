"""A refiner's run builds upon the run of its network, which is that without a refiner."""

from pathlib import Path

import pytest

from memmlp.common import distributed
from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment, load_config
from memmlp.config.compose import compose_config
from memmlp.networks.refiner import RefinedModel
from memmlp.runs.lookup import list_runs
from memmlp.training.run_stages import run_in_processes

SHORT = [
    "profile=tiny", "data.synth.minutes=0.05", "loggers=none", "threads=1", "optim.steps=2",
    "export.graph=off", "model=vae_hmd",
]  # fmt: skip


@pytest.mark.slow
def test_one_command_trains_the_network_and_then_its_refiner(memmlp):
    assert memmlp("train", *SHORT, "evaluation.modes=[stream]").code == 0
    (bare,) = list_runs(Path("outputs"))
    weights = bare.model.read_bytes()
    ran = memmlp("train", *SHORT, "refiner=sage")
    assert ran.code == 0, ran.err
    (refined,) = (run for run in list_runs(Path("outputs")) if run.id != bare.id)
    assert refined.manifest["prerequisite"] == bare.id
    assert [one["id"] for one in refined.manifest["prerequisite_runs"]] == [bare.id]
    assert bare.model.read_bytes() == weights
    assert refined.manifest["component_versions"].keys() - bare.manifest["component_versions"].keys() == {
        "refiner.sage"
    }
    assert set(refined.results) == {"window", "stream"}
    assert refined.results["window"] == refined.results["stream"]
    assert refined.results["stream"]["rotation"]["MPJPE"] != bare.results["stream"]["rotation"]["MPJPE"]
    assert isinstance(build_experiment(load_config(refined)).architecture.load(refined.model), RefinedModel)
    assert "finished already" in memmlp("train", *SHORT, "refiner=sage").out


def experiment(*overrides: str):
    return build_experiment(compose_config([*SHORT, *overrides]))


@pytest.mark.slow
def test_its_identity_is_of_all_that_its_pieces_follow_from():
    bare, refined = experiment().identity("d"), experiment("refiner=sage").identity("d")
    assert refined.prerequisite == bare
    assert refined.id not in (bare.id, experiment("refiner=sage", "refiner.pieces=9").identity("d").id)
    words = ["model=agrol_diffusion", "refiner=sage"]
    sampled = [experiment(*words, f"model.sampling_steps={steps}").identity("d") for steps in (2, 3)]
    assert sampled[0].prerequisite.id == sampled[1].prerequisite.id
    assert sampled[0].id != sampled[1].id


def test_several_processes_are_refused(monkeypatch):
    monkeypatch.setattr(distributed, "world_size", lambda: 2)
    with pytest.raises(InputError, match="refiner: must be null"):
        run_in_processes(experiment("refiner=sage"))
