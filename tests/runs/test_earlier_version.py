"""Runs that version 0.1 wrote: found under the ids of today, evaluated, and shown in tables.

A run of today is given the names that 0.1 wrote: the config groups `tracker` and `frame` and former names of
keys, other paths of classes, `frame` for the normalizer's tensors, and the yardstick's times as "reference".
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import TINY
from command_line import run as command
from conftest import INT8
from safetensors import safe_open
from safetensors.torch import save_file

from memmlp.common.files import file_digest, read_json
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run
from memmlp.tables.measured_run import load

TRACKER = {"name": "none", "_target_": "memmlp.runs.tracking.NoTracker"}
"""The group of 0.1, which had a single logger."""

FORMER = {
    "normalizer": "frame", "z_scores": "normalize", "drawn_by": "weighting",
    "baseline_frames": "avatar_poser_frames",
}  # fmt: skip
"""The former names of some groups and keys."""


@pytest.fixture
def earlier(home: Path) -> tuple[Path, Run]:
    """The folder with the runs as 0.1 would have left them, and its motion network's run."""
    runs = list_runs(home / "outputs")
    for run in runs:
        _as_it_was(run)
    return home, next(run for run in runs if run.manifest["kind"] == "memmlp")


def _as_it_was(run: Run) -> None:
    """Give a run's files the names of version 0.1."""
    config: dict[str, Any] = {
        FORMER.get(group, group): {FORMER.get(key, key): value for key, value in content.items()}
        if isinstance(content, dict)
        else content
        for group, content in run.config.items()
        if group != "loggers"
    }
    config["tracker"] = TRACKER
    run.config_path.write_text(yaml.safe_dump(_mapped(config, _earlier_class), sort_keys=False))
    for path in (run.model, run.checkpoint):
        _rename_tensors(path)
    marker = read_json(run.marker)
    marker["artifacts"][run.model.name] = file_digest(run.model)
    run.marker.write_text(json.dumps(marker))
    for path in run.deployments.glob("*/latency.json"):
        path.write_text(path.read_text().replace("yardstick", "reference"))


def _mapped(tree: Any, change: Callable[[str, Any], Any]) -> Any:
    """Return a tree of mappings with `change` applied to each key and value."""
    return {
        key: _mapped(value, change) if isinstance(value, dict) else change(key, value)
        for key, value in tree.items()
    }


def _earlier_class(key: str, value: Any) -> Any:
    if key != "_target_":
        return value
    return value if value == TRACKER[key] else f"memmlp.core.{value.rsplit('.', 1)[-1]}"


def _rename_tensors(path: Path) -> None:
    """Call the normalizer's tensors `frame`."""
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        values = file.metadata()
    named = {re.sub(r"(^|\.)normalizer\.", r"\1frame.", name): tensor for name, tensor in tensors.items()}
    save_file(named, path, values)


def test_the_same_command_finds_it_and_makes_nothing(earlier):
    home, run = earlier
    before = run.model.read_bytes()
    seeds = [f"seed={run.config['seed']}", f"vqvae.seed={run.config['vqvae']['seed']}"]
    assert "finished already" in command(home, "train", *TINY, INT8, *seeds)
    assert run.model.read_bytes() == before
    assert len(list_runs(home / "outputs")) == 2


def test_its_files_have_the_names_that_0_1_wrote(earlier):
    _, run = earlier
    with safe_open(run.model, framework="pt") as file:
        names = set(file.keys())
    assert {name for name in names if "normalizer" in name} == set()
    assert any(name.endswith("frame.rest") for name in names)
    assert {"loggers", "normalizer"} <= run.config.keys()
    written = yaml.safe_load(run.config_path.read_text())
    assert {"tracker", "frame"} <= written.keys()
    assert written.keys().isdisjoint({"loggers", "normalizer"})
    assert (written["data"]["weighting"], run.config["data"]["drawn_by"]) == ("frames", "frames")
    assert "yardstick" not in next(run.deployments.glob("*/latency.json")).read_text()


def test_it_is_evaluated_to_the_same_numbers(earlier):
    home, run = earlier
    first = run.results
    assert run.verify() == []
    assert "evaluation done" in command(home, "eval", run.id, "--again", "--json", "again.json")
    again = read_json(home / "again.json")["mean"]
    for mode in ("stream", "window"):
        for branch, values in first[mode].items():
            assert again[mode][branch] == pytest.approx(values, rel=1e-4, nan_ok=True)


def test_its_times_and_errors_are_in_a_table(earlier):
    home, run = earlier
    costs = load(run.folder).costs
    recorded = read_json(next(run.deployments.glob("*/latency.json")))
    assert costs["ratio"] == recorded["int8"]["ratio_to_reference"]  # of the precision that was asked for
    assert Run(run.folder).preferred_deployment.record["ratio_to_yardstick"] == recorded["ratio_to_reference"]
    content = {
        "base": [*TINY, INT8],
        "metrics": ["MPJPE", "ratio"],
        "seeds": [0],
        "variants": {"earlier": []},
    }
    (home / "sweep.yaml").write_text(yaml.safe_dump(content))
    said = command(home, "sweep", "sweep.yaml")
    assert "2 of 2 runs done" in said
    assert "missing" not in said
    assert f"{run.results['stream']['rotation']['MPJPE']:.2f}" in said
    assert f"{costs['ratio']:.3g}" in said
