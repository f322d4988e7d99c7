"""The shipped sweep files: they load, their arms differ, and their paper values are those printed."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import tiny
import torch
from omegaconf import OmegaConf

from memmlp.cli.build import build_experiment, untrained
from memmlp.cli.train import composed
from memmlp.features import Frame
from memmlp.identity import flatten
from memmlp.sweep.spec import Arm, Sweep, load_sweep
from memmlp.training import MotionTask, train_step

FOLDER = Path(__file__).parent.parent / "sweeps"
FILES = sorted(FOLDER.glob("*.yaml"))
TABLES = [path for path in FILES if path.stem.startswith("table")]
PAPER = Path(__file__).parent.parent.parent / "shared" / "paper" / "mem-mlp.txt"
NUMBER = re.compile(r"\d+\.\d+")
OURS = ("no Multi-Head, no Memory-Block, Mem-MLP's loss",)  # rows of the tables that the paper has not
LABELLED = (1, 2, 3, 11, 14, 15, 16, 17)  # tables whose labels are the printed ones


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_arms_differ(path: Path):
    sweep = load_sweep(path)
    runnable = [(arm.overrides, arm.branch) for arm in sweep.arms if arm.overrides is not None]
    assert len(set(runnable)) == len(runnable)
    assert path.stem != sweep.title


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_tables_carry_their_number_and_values(path: Path):
    sweep = load_sweep(path)
    assert path.stem == f"table{sweep.table:02}"
    assert all(arm.paper for arm in sweep.arms if arm.label not in OURS)
    assert len(sweep.arms) > len(OURS)
    assert all(metric in sweep.metrics for arm in sweep.arms for metric in arm.paper or {})


def test_every_table_of_the_paper_is_there():
    assert [load_sweep(path).table for path in TABLES] == list(range(1, 18))


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_values_are_those_printed(path: Path):
    if not PAPER.is_file():
        pytest.skip("the paper's text is not here")
    sweep = load_sweep(path)
    assert sweep.table
    rows, arms = printed(sweep.table), [arm for arm in sweep.arms if arm.label not in OURS]
    assert len(rows) == len(arms)
    columns = [metric for metric in sweep.metrics if any(metric in (arm.paper or {}) for arm in sweep.arms)]
    for arm, cells in zip(arms, rows, strict=True):
        values = [number(cell) for cell in cells[-len(columns) :]]
        assert [(arm.paper or {}).get(metric) for metric in columns] == values, arm.label
        if sweep.table in LABELLED:
            assert arm.label == re.sub(r"\s*\[\d+\]", "", cells[0]).strip()


@pytest.mark.parametrize("table", [12, 13])
def test_wrong_heads_are_noted(table: int):
    sweep: Sweep = load_sweep(FOLDER / f"table{table}.yaml")
    assert sweep.metrics == ("MPJRE", "MPJPE", "MPJVE", "Jitter")
    assert any("printed heads" in note for note in sweep.notes)


AFTER_IK = {"MPJPE": 3.08, "Jitter": 6.03}  # Table 6, "Rotation + Position Branch"


@pytest.mark.parametrize("path", TABLES[:15], ids=lambda path: path.stem)
def test_rows_with_table_6s_combined_values_show_the_combined_branch(path: Path):
    """And the file says how we know; a network of one head, which has no other, shows its rotations."""
    sweep = load_sweep(path)
    assert sweep.branch_source
    full = [arm for arm in sweep.arms if AFTER_IK.items() <= (arm.paper or {}).items()]
    assert bool(full) == (sweep.table not in (2, 3))
    assert {arm.branch for arm in full} <= {"combined"}
    for arm in sweep.runnable():
        words = sweep.overrides(arm)
        single = any(word.startswith(("model=", "predictor=rotation_only")) for word in words)
        assert (arm.branch == "rotation") == (single or arm.label == "Rotation Branch")
        assert ("evaluation.ik=off" in words) == single
        assert ("evaluation.ik=lbfgs" in words) != single


def test_the_first_row_of_table_4_is_agrols():
    first = load_sweep(FOLDER / "table04.yaml").arms[0]
    assert {"model=agrol_mlp", "model.frames=41"} <= set(first.overrides or ())
    assert (first.paper or {})["Jitter"] == 22.70


def test_tables_of_amass_name_the_body():
    for number in (1, 2, 3):
        assert "data.body=" in load_sweep(FOLDER / f"table{number:02}.yaml").notes[0]


DECOMPOSITION = load_sweep(FOLDER / "decomposition.yaml")


def test_the_decomposition_changes_one_ingredient_a_step():
    """Each arm's config differs from its control's in what its label names, or in the branch alone."""
    arms = {arm.label: arm for arm in DECOMPOSITION.arms}
    configs = {
        label: flatten(OmegaConf.to_container(composed([*DECOMPOSITION.overrides(arm)]), resolve=True))
        for label, arm in arms.items()
    }
    changed = {}
    for label, arm in arms.items():
        control = DECOMPOSITION.control(arm)
        if control and label != "AGRoL-MLP-41":
            one, other = configs[label], configs[control]
            keys = {key for key in one.keys() | other.keys() if one.get(key) != other.get(key)}
            changed[label] = {key.split(".")[0] for key in keys}
            changed[label] |= {"branch"} if arm.branch != arms[control].branch else set()
    assert changed == {
        "+ features": {"frame"},
        "+ Mem-MLP's backbone": {"model", "memory", "predictor", "hand"},
        "+ Eqs. 1-2": {"loss"},
        "+ learned weights": {"loss"},
        "+ second branch": {"predictor", "evaluation"},
        "+ hand term": {"hand"},
        "+ memory": {"memory"},
        "+ IK: the full model": {"branch"},
        "less memory": {"memory"},
        "less hand term": {"hand"},
        "less second branch": {"predictor", "hand", "evaluation", "branch"},
        "less learned weights": {"loss"},
        "less Eq. 2": {"loss"},
    }
    assert configs["+ Eqs. 1-2"]["loss.rotation_velocity"] == 30
    assert configs["less Eq. 2"]["loss.rotation_velocity"] == 0
    assert len({tuple(sorted(map(str, _trained(config).items()))) for config in configs.values()}) == 12


def _trained(config: dict[str, object]) -> dict[str, object]:
    """What of a config the training depends on."""
    return {key: value for key, value in config.items() if not key.startswith("evaluation.ik")}


def test_the_backbone_is_agrols_mlp_of_ten_blocks():
    """With one head and no memory: the same function of the same weights."""
    small = ["model.frames=41", "profile=tiny", "frame.coordinates=world", "frame.normalize=false"]
    mem = untrained([*small, "memory=none", "predictor=rotation_only", "hand=off", "loss=agrol"])
    agrol = untrained([*small, "model=agrol_mlp", "model.depth=10"])
    names = [name for name in mem.state_dict() if not name.startswith("frame.")]
    theirs = [name for name in agrol.state_dict() if not name.startswith("frame.")]
    ours = {name: mem.state_dict()[other] for name, other in zip(theirs, names, strict=True)}
    agrol.load_state_dict(ours, strict=False)
    inputs = torch.randn(2, 41, 54, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        found, expected = (network.advance(inputs, network.initial_state(2))[0] for network in (mem, agrol))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("arm", DECOMPOSITION.arms, ids=lambda arm: arm.label)
def test_an_arm_of_the_decomposition_trains(arm: Arm):
    """A step of each changes the weights, under the loss that its label names."""
    experiment = build_experiment(composed([*DECOMPOSITION.overrides(arm), "profile=tiny"]))
    torch.manual_seed(0)
    architecture, frames = experiment.architecture, tiny.frames((60, 70))
    frame = Frame.raw(architecture.coordinates, tiny.REST)
    model = architecture.build(frame, architecture.vqvae() if architecture.uses_codes else None)
    before = model.stem.weight.clone()
    loss, rollout = experiment.loss(model.branches), experiment.rollout
    optim = replace(experiment.optim, steps=1)
    task = MotionTask(model, loss, rollout, frames, optim, 0, lambda network: {})
    result = train_step(task, optim, optim.build(task.parameter_groups()), 0)
    assert not torch.equal(model.stem.weight, before)
    assert set(result.terms) == set(TERMS.get(arm.label, TERMS["rest"]))


TERMS = {
    "AGRoL-MLP-41": ["rotation"],
    "+ features": ["rotation"],
    "+ Mem-MLP's backbone": ["rotation"],
    "+ Eqs. 1-2": ["rotation", "rotation_velocity"],
    "+ learned weights": ["rotation", "rotation_velocity"],
    "less second branch": ["rotation", "rotation_velocity"],
    "+ second branch": ["rotation", "rotation_velocity", "position", "velocity"],
    "less hand term": ["rotation", "rotation_velocity", "position", "velocity"],
    "rest": ["rotation", "rotation_velocity", "position", "velocity", "hand"],
}


def printed(table: int) -> list[list[str]]:
    """The cells of a table's rows: the lines with tabs and numbers between its head and its caption."""
    lines = PAPER.read_text(encoding="utf-8").splitlines()
    caption = next(i for i, line in enumerate(lines) if line.startswith(f"Table {table}. "))
    rows: list[list[str]] = []
    for line in reversed(lines[:caption]):
        if "\t" in line and NUMBER.search(line):
            rows.insert(0, line.split("\t"))
        elif rows:
            return rows
    return rows


def number(cell: str) -> float | None:
    """The number of a cell, less its markup and its unit; None for a dash."""
    found = NUMBER.search(cell)
    return float(found[0]) if found else None
