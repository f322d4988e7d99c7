"""Finished runs opened again: which keys may then have other values."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.config.build import build_experiment
from memmlp.config.compose import composed
from memmlp.config.open_run import experiment_of
from memmlp.runs.run import Run


@pytest.fixture
def trained(tmp_path: Path) -> Run:
    """A run that has a record alone."""
    run = Run.of(tmp_path, "0123456789abcdef")
    run.folder.mkdir(parents=True)
    config = build_experiment(composed(["profile=tiny", "memory=none", f"paths.outputs={tmp_path}"])).config
    run.config_path.write_text(yaml.safe_dump(config))
    write_json(run.manifest_path, {"id": run.id, "kind": "memmlp"})
    write_json(run.marker, {"id": run.id, "artifacts": {}})
    return run


@pytest.mark.parametrize(
    ("word", "key", "value"),
    [
        ("evaluation.ik=arms", "evaluation", "arms"),
        ("export.precision=int8", "export", "int8"),
        ("data.strict=true", "data", True),
    ],
)
def test_keys_of_what_follows_a_training_may_have_other_values(trained: Run, word: str, key: str, value):
    assert value in experiment_of(trained, "cpu", [word]).config[key].values()


@pytest.mark.parametrize(
    "word",
    ["force=true", "device=cuda", "threads=2", "save_predictions=a", "profile.ik=arms", "optim.log_every=7"],
)
def test_a_key_that_would_do_nothing_is_refused(trained: Run, word: str):
    with pytest.raises(InputError, match=f"{word}: .*allowed are keys of evaluation and export"):
        experiment_of(trained, "cpu", ["evaluation.ik=arms", word])


def test_several_values_of_a_key_are_refused(trained: Run):
    with pytest.raises(InputError, match=r"^evaluation\.ik=off,arms: allowed is one value"):
        experiment_of(trained, "cpu", ["evaluation.ik=off,arms"])
