"""The FLOPs of a config's training, of finished runs, and of a training at another scale."""

from __future__ import annotations

from pathlib import Path

import command_line
import pytest
import yaml

from memmlp.common.errors import InputError
from memmlp.config.compose import composed
from memmlp.config.flops_of_configs import flops_of, predicted_flops, with_flops
from memmlp.runs.lookup import list_runs
from memmlp.sweep.sweep_file import parse_sweep
from memmlp.tables.measured_run import load

TINY = ["profile=tiny", "memory=none"]


@pytest.mark.slow
def test_a_training_grows_with_steps_batch_and_width():
    flops = flops_of(composed(TINY))
    assert flops_of(composed([*TINY, "optim.steps=60", "optim.batch=16"])) == 6 * flops
    assert 2 * flops < flops_of(composed([*TINY, "profile.width=32"])) < 4 * flops
    assert flops_of(composed([*TINY, "rollout=streams", "optim.compile=true"])) == flops
    with pytest.raises(InputError, match="refiner: the operations"):
        flops_of(composed([*TINY, "refiner=sage"]))


def test_finished_runs_are_counted_from_their_own_configs(tiny_home: Path, home: Path):
    runs = [
        next(run for run in list_runs(one / "outputs") if run.manifest["kind"] == "memmlp")
        for one in (tiny_home, home)
    ]
    config = runs[1].config
    config["optim"]["steps"] *= 2
    runs[1].config_path.write_text(yaml.safe_dump(config))
    found = with_flops({"a": {0: load(runs[0].folder)}, "b": {0: load(runs[1].folder)}})
    once = flops_of(composed(list(command_line.TINY)))
    assert [found[label][0].training["flops"] for label in "ab"] == [once, 2 * once]
    assert found["a"][0].training["seconds"] == runs[0].manifest["seconds"]["train"]


@pytest.mark.slow
def test_a_prediction_is_of_the_control_without_its_cell():
    content = {
        "base": TINY,
        "arms": {"full": ["optim.batch=4"], "manual": {"overrides": ["loss=manual"], "against": "full"}},
        "axes": {"optim.steps": [5, 50], "profile.width": [32]},
        "scale": {"predict": ["optim.steps=40"]},
    }
    expected = float(flops_of(composed([*TINY, "optim.batch=4", "optim.steps=40"])))
    assert predicted_flops(parse_sweep("s", content)) == {"optim.steps=40": expected}
    assert predicted_flops(parse_sweep("s", content | {"scale": {}})) == {}
    turned = {
        "arms": dict(reversed(content["arms"].items()))
    }  # the first arm's is what others are compared with
    with pytest.raises(InputError, match=r"scale\.predict: allowed is one control, not 'full.* 'manual"):
        predicted_flops(parse_sweep("s", content | turned))
    third = {"third": {"overrides": ["loss=manual", "optim.batch=6"], "against": "manual"}}
    with pytest.raises(InputError, match=r"scale\.predict: allowed is one control, not 'full.* 'manual"):
        predicted_flops(parse_sweep("s", content | {"arms": content["arms"] | third}))
