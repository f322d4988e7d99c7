"""Finished runs opened again: which keys may then have other values."""

import re
from pathlib import Path

import pytest
import yaml

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.config.build import build_experiment
from memmlp.config.compose import compose_config
from memmlp.config.open_run import build_run_experiment
from memmlp.runs.run import Run


@pytest.fixture
def trained(tmp_path: Path) -> Run:
    run = Run.from_id(tmp_path, "0123456789abcdef")
    run.folder.mkdir(parents=True)
    config = build_experiment(
        compose_config(["profile=tiny", "memory=none", f"paths.outputs={tmp_path}"])
    ).config
    run.config_path.write_text(yaml.safe_dump(config))
    write_json(run.manifest_path, {"id": run.id, "kind": "memmlp"})
    write_json(run.marker, {"id": run.id, "artifacts": {}})
    return run


def test_keys_of_later_stages_may_have_other_values(trained: Run):
    words = ["evaluation.ik=arms", "export.precision=int8", "data.strict=true"]
    config = build_run_experiment(trained, "cpu", words).config
    values = config["evaluation"]["ik"], config["export"]["precision"], config["data"]["strict"]
    assert values == ("arms", "int8", True)


@pytest.mark.parametrize("word", [
    "force=true", "device=cuda", "save_predictions=a", "profile.steps=3", "optim.log_every=7",
    "evaluation.ik=off,arms",
])  # fmt: skip
def test_a_key_without_effect_or_with_several_values_is_refused(trained: Run, word: str):
    with pytest.raises(InputError, match=f"^.*{word}"):
        build_run_experiment(trained, "cpu", [word])


@pytest.mark.parametrize(("word", "line"), [
    ("evaluation.modez=1", "evaluation.modez: no such key; did you mean modes? expected one of modes, batch"),
    ("evaluation.modes=a", "evaluation.modes=a: expected a list"), ("evaluation.ik=[", "expected KEY=VALUE"),
    ("~evaluation.modes=[stream]", "must be KEY=VALUE"),
])  # fmt: skip
def test_a_wrong_override_of_a_finished_run_is_explained(trained: Run, word: str, line: str):
    with pytest.raises(InputError, match=re.escape(line)):
        build_run_experiment(trained, "cpu", [word])


def test_a_recorded_config_decides_nowhere_where_a_command_writes(trained: Run, tmp_path: Path):
    victim = tmp_path / "victim"
    recorded = {"paths": {"outputs": str(victim)}, "save_predictions": str(victim), "force": True}
    recorded["loggers"] = {"mlflow": {"uri": f"sqlite:///{victim}/m.db"}}
    here = tmp_path / "here"
    for root, expected in (
        (victim / "data" / "synth", here / "data" / "synth"),
        (victim / "other", here / "other"),
        (tmp_path / "elsewhere", here / "data" / "synth"),
        (victim / ".." / "elsewhere", here / "data" / "synth"),
    ):
        config = trained.config | recorded
        config["data"] = config["data"] | {"root": str(root)}
        trained.config_path.write_text(yaml.safe_dump(config))
        experiment = build_run_experiment(trained, outputs=here)
        assert experiment.outputs == here
        assert experiment.motion.caches == here / "cache"
        assert experiment.motion.clips.root.parent == expected
        assert experiment.loggers == ()
        assert (experiment.config["save_predictions"], experiment.config["force"]) == (None, False)
    assert build_run_experiment(trained).outputs == trained.folder.parent.parent
    assert not victim.exists()


@pytest.mark.parametrize("slot", ["hand", "model", "optim", "loss"])
def test_only_registered_components_are_built(trained: Run, slot: str):
    attack = {"name": "memmlp.common.npm.os.abort", "_target_": "memmlp.common.npm.os.abort"}
    trained.config_path.write_text(yaml.safe_dump(trained.config | {slot: attack}))
    with pytest.raises(InputError, match=r"abort|_target_"):
        build_run_experiment(trained)
    attack["name"] = str(compose_config(["profile=tiny"])[slot].name)
    trained.config_path.write_text(yaml.safe_dump(trained.config | {slot: attack}))
    with pytest.raises(InputError, match=r"_target_"):
        build_run_experiment(trained)
