"""The shipped sweep files: they load, their variants differ, and their paper values are those printed.

paper_values.yaml has the printed values, transcribed apart from the sweeps. Facts of its own tell whether the
transcription is right: rows that stand in several tables, numbers in the paper's text, and sums that the
errors' definitions imply.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
import yaml
from omegaconf import OmegaConf

from memmlp.config.build import build_experiment, untrained
from memmlp.config.compose import composed
from memmlp.motion.normalizer import Normalizer
from memmlp.runs.identity import flatten
from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import load_sweep
from memmlp.training.loop import train_step
from memmlp.training.train_network import MotionTask

FOLDER = Path(__file__).parent.parent.parent / "sweeps"
FILES = sorted(FOLDER.glob("*.yaml"))
TABLES = [path for path in FILES if path.stem.startswith("table")]
OURS = ("no Multi-Head, no Memory-Block, Mem-MLP's loss",)  # rows of the tables that are not the paper's
LABELLED = (1, 2, 3, 11, 14, 15, 16, 17)  # tables whose labels are the printed ones
PRINTED: dict[int, dict[str, Any]] = yaml.safe_load(
    Path(__file__).with_name("paper_values.yaml").read_text(encoding="utf-8")
)
UPPER_JOINTS, LOWER_JOINTS = 13, 9
OTHERS_JOINTS = (
    "BoDiffusion",
    "EgoPoser",
    "MANIKIN-S",
    "MANIKIN-LN",
)  # their papers divide the body otherwise
FULL = {
    4: 3,
    5: 1,
    7: 1,
    8: 1,
    9: 0,
    10: 2,
    11: 1,
    12: 1,
    13: 1,
    14: 3,
    15: 2,
}  # the full model's row, by table
OTHER_MPJVE = (8, 11)  # tables that print 15.08 for it where all others have 15.02
OTHER_SIZE = ("MMD", "HDM-Poser", "Mem-MLP-41", "Mem-MLP-60")  # more, or less, than parameters


def rows(table: int) -> list[dict[str, Any]]:
    """Return the printed rows of a table: a label and the values that are there, by metric."""
    keys = ["label", *PRINTED[table]["columns"]]
    found = [dict(zip(keys, row, strict=True)) for row in PRINTED[table]["rows"]]
    return [{key: value for key, value in row.items() if value is not None} for row in found]


def row(table: int, label: str) -> dict[str, Any]:
    return next(found for found in rows(table) if found["label"].lower() == label.lower())


def test_variants_differ():
    for path in FILES:
        sweep = load_sweep(path)
        alike = (
            {"MANIKIN-LN"} if sweep.table == 16 else set()
        )  # its size is that of MANIKIN-L's network, as its note says
        variants = [
            variant
            for variant in sweep.variants
            if variant.overrides is not None and variant.label not in alike
        ]
        runnable = [(variant.overrides, variant.branch) for variant in variants]
        assert len(set(runnable)) == len(runnable)
        assert path.stem != sweep.title


def test_tables_carry_their_number_and_values():
    for path in TABLES:
        sweep = load_sweep(path)
        assert path.stem == f"table{sweep.table:02}"
        assert all(variant.paper for variant in sweep.variants if variant.label not in OURS)
        assert len(sweep.variants) > len(OURS)
        assert all(metric in sweep.metrics for variant in sweep.variants for metric in variant.paper or {})


def test_every_table_of_the_paper_is_there():
    assert [load_sweep(path).table for path in TABLES] == list(range(1, 18)) == list(PRINTED)


def test_values_are_those_printed():
    """Each row has the printed values, and none beside them."""
    for path in TABLES:
        sweep = load_sweep(path)
        assert sweep.table
        variants = [(variant.label, dict(variant.paper)) for variant in sweep.variants if variant.paper]
        printed = rows(sweep.table)
        labels = [found.pop("label") for found in printed]
        assert [values for _, values in variants] == printed
        if sweep.table in LABELLED:
            assert [label for label, _ in variants] == labels


def test_wrong_heads_are_noted():
    for table in (12, 13):
        sweep: Sweep = load_sweep(FOLDER / f"table{table}.yaml")
        assert sweep.metrics == ("MPJRE", "MPJPE", "MPJVE", "Jitter")
        assert any("printed heads" in note for note in sweep.notes)


AFTER_IK = {"MPJPE": 3.08, "Jitter": 6.03}  # Table 6, "Rotation + Position Branch"


def test_rows_with_table_6s_combined_values_show_the_combined_branch():
    """The file also says how we know the branch. A network with rotations alone shows these."""
    for path in TABLES[:15]:
        sweep = load_sweep(path)
        assert sweep.branch_source
        full = [variant for variant in sweep.variants if AFTER_IK.items() <= (variant.paper or {}).items()]
        assert bool(full) == (sweep.table not in (2, 3))
        assert {variant.branch for variant in full} <= {"combined"}
        for variant in sweep.runnable():
            words = sweep.all_overrides(variant)
            single = any(word.startswith(("model=", "predictor=rotation_only")) for word in words)
            assert (variant.branch == "rotation") == (single or variant.label == "Rotation Branch")
            assert ("evaluation.ik=off" in words) == single
            assert ("evaluation.ik=lbfgs" in words) != single


def test_the_first_row_of_table_4_is_agrols():
    first = load_sweep(FOLDER / "table04.yaml").variants[0]
    assert {"model=agrol_mlp", "model.frames=41"} <= set(first.overrides or ())
    assert (first.paper or {})["Jitter"] == 22.70


def test_tables_of_amass_name_the_body():
    for number in (1, 2, 3):
        assert "data.body=" in load_sweep(FOLDER / f"table{number:02}.yaml").notes[0]


DECOMPOSITION = load_sweep(FOLDER / "decomposition.yaml")


@pytest.mark.slow
def test_the_decomposition_changes_one_ingredient_a_step():
    """Each variant's config differs from its control's in what its label names, or only its branch does."""
    variants = {variant.label: variant for variant in DECOMPOSITION.variants}
    configs = {
        label: flatten(
            OmegaConf.to_container(composed([*DECOMPOSITION.all_overrides(variant)]), resolve=True)
        )
        for label, variant in variants.items()
    }
    changed = {}
    for label, variant in variants.items():
        control = DECOMPOSITION.control_of(variant)
        if control and label != "AGRoL-MLP-41":
            one, other = configs[label], configs[control]
            keys = {key for key in one.keys() | other.keys() if one.get(key) != other.get(key)}
            changed[label] = {key.split(".")[0] for key in keys}
            changed[label] |= {"branch"} if variant.branch != variants[control].branch else set()
    assert changed == {
        "+ features": {"normalizer"},
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
    """Return the part of a config that the training depends on."""
    return {key: value for key, value in config.items() if not key.startswith("evaluation.ik")}


def test_the_backbone_is_agrols_mlp_of_ten_blocks():
    """Without memory and with one head, it computes the same function of the same weights."""
    small = ["model.frames=41", "profile=tiny", "normalizer.coordinates=world", "normalizer.z_scores=false"]
    mem = untrained([*small, "memory=none", "predictor=rotation_only", "hand=off", "loss=agrol"])
    agrol = untrained([*small, "model=agrol_mlp", "model.depth=10"])
    names = [name for name in mem.state_dict() if not name.startswith("normalizer.")]
    theirs = [name for name in agrol.state_dict() if not name.startswith("normalizer.")]
    ours = {name: mem.state_dict()[other] for name, other in zip(theirs, names, strict=True)}
    agrol.load_state_dict(ours, strict=False)
    inputs = torch.randn(2, 41, 54, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        found, expected = (network.advance(inputs, network.initial_state(2))[0] for network in (mem, agrol))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_every_variant_of_the_decomposition_trains():
    """A step of each variant changes the weights, under the loss that its label names."""
    for variant in DECOMPOSITION.variants:
        experiment = build_experiment(composed([*DECOMPOSITION.all_overrides(variant), "profile=tiny"]))
        torch.manual_seed(0)
        architecture, frames = experiment.architecture, tiny.frames((60, 70))
        normalizer = Normalizer.raw(architecture.coordinates, tiny.REST)
        model = architecture.build(normalizer, architecture.vqvae() if architecture.uses_codes else None)
        before = model.stem.weight.clone()
        loss, rollout = experiment.training.loss(model.branches), experiment.training.rollout
        optim = replace(experiment.training.optim, steps=1)
        task = MotionTask(model, loss, rollout, frames, optim, 0, lambda network: {})
        result = train_step(task, optim, optim.build(task.parameter_groups()), 0)
        assert not torch.equal(model.stem.weight, before)
        assert set(result.terms) == set(TERMS.get(variant.label, TERMS["rest"]))


TERMS = {
    "AGRoL-MLP-41": ["rotation_all"],
    "+ features": ["rotation_all"],
    "+ Mem-MLP's backbone": ["rotation_all"],
    "+ Eqs. 1-2": ["rotation_all", "rotation_velocity"],
    "+ learned weights": ["rotation_all", "rotation_velocity"],
    "less second branch": ["rotation_all", "rotation_velocity"],
    "+ second branch": ["rotation_all", "rotation_velocity", "position_branch", "velocity_lower_body"],
    "less hand term": ["rotation_all", "rotation_velocity", "position_branch", "velocity_lower_body"],
    "rest": ["rotation_all", "rotation_velocity", "position_branch", "velocity_lower_body", "hand"],
}


# Facts that tell whether the transcription is right


def test_the_cells_of_scaling_are_lines_through_one_point():
    """Of each variant as many cells, with a memory in proportion to the width as the paper's is."""
    sweep = load_sweep(FOLDER / "scaling.yaml")
    assert len(sweep.runnable()) == 66
    cells = [
        dict(word.split("=") for word in variant.cell)
        for variant in sweep.variants
        if variant.series == "Mem-MLP"
    ]
    centre = {"data.split.train_fraction": "1.0", "profile.width": "128", "optim.steps": "2000"}
    away = [[key for key in centre if cell[key] != centre[key]] for cell in cells]
    assert sorted(map(tuple, away)) == sorted(
        [(), *[("optim.steps",)] * 4, *[("profile.width",)] * 3, *[("data.split.train_fraction",)] * 3]
    )
    for words in (["profile=paper"], *([f"profile.width={cell['profile.width']}"] for cell in cells)):
        cfg = composed(words)
        assert 8 * cfg.memory.width == 3 * cfg.model.width
    for variant in sweep.variants:
        assert (
            variant.series == "Mem-MLP" or sweep.control_of(variant) == f"Mem-MLP, {', '.join(variant.cell)}"
        )


def test_the_full_model_is_the_same_in_every_table():
    for table in FULL:
        headline = row(1, "Mem-MLP-41") | ({"MPJVE": 15.08} if table in OTHER_MPJVE else {})
        found = {key: value for key, value in rows(table)[FULL[table]].items() if key != "label"}
        assert found == {key: headline[key] for key in found}


def test_rows_that_stand_in_two_tables_are_the_same():
    pairs = [
        ((1, "Mem-MLP-41"), (6, "Rotation + Position Branch")),
        ((1, "Mem-MLP-60"), (10, "60")),
    ]
    sizes = {"SAGE Net": "SAGE-Net", "HMD-Poser": "HDM-Poser", "AGRoL-MLP-196": "AGRoL-MLP"}
    named = [found["label"] for found in rows(1) if "FLOPs" in found]
    pairs += [((1, label), (16, sizes.get(label, label))) for label in named]
    for one, two in pairs:
        first, second = row(*one), row(*two)
        shared = first.keys() & second.keys() - {"label"}
        assert shared
        assert {key: first[key] for key in shared} == {key: second[key] for key in shared}, (one, two)


def test_a_mean_over_the_body_lies_between_its_halves():
    """MPJPE is the mean over 13 upper and 9 lower joints, up to rounding (0.015 in one row)."""
    for table in (1, 3, 6):
        for found in rows(table):
            if "Upper PE" in found and found["label"] not in OTHERS_JOINTS:
                both = (UPPER_JOINTS * found["Upper PE"] + LOWER_JOINTS * found["Lower PE"]) / 22
                assert both == pytest.approx(found["MPJPE"], abs=0.015), found["label"]


def test_sizes_are_four_bytes_a_parameter():
    for found in rows(16):
        if "size" in found and found["label"] not in OTHER_SIZE:
            assert 4e6 * found["parameters"] / 2**20 == pytest.approx(found["size"], rel=0.004), found[
                "label"
            ]


def test_numbers_of_the_papers_text_stand_in_its_tables():
    base, memory, *_ = rows(4)
    assert (base["Jitter"], memory["Jitter"], base["MPJVE"], memory["MPJVE"]) == (22.70, 8.42, 35.77, 19.57)
    assert row(1, "AGRoL-MLP-196")["Jitter"] == 13.01
    ours, published = (row(1, name)["MPJPE"] for name in ("Mem-MLP-41", "AvatarPoser"))
    assert round(100 * (1 - ours / published)) == 26
    assert [row(16, name)["parameters"] for name in ("AGRoL-MLP", "MMD", "BoDiffusion", "SAGE-Net")] == [
        3.74, 101.72, 21.94, 120.27,
    ]  # fmt: skip
    assert (row(16, "Mem-MLP-41")["size"], row(16, "Mem-MLP-41")["parameters"]) == (15.38, 4.10)
    assert [found["ms"] for found in rows(17) if found["label"] != "AGRoL-MLP"] == [6.0, 290.5, 6.8, 8.5]
    assert row(17, "AGRoL-Diffusion")["FPS"] == pytest.approx(
        1000 / row(17, "AGRoL-Diffusion")["ms"], abs=0.1
    )


def best(table: int, metric: str) -> str:
    """Return the label of the row with the lowest value."""
    return min(rows(table), key=lambda found: found[metric])["label"]


def test_orders_that_the_papers_text_tells_are_those_of_its_tables():
    assert [best(9, metric) for metric in ("MPJRE", "MPJPE", "MPJVE", "Jitter")] == ["8", "10", "10", "8"]
    for metric in ("MPJRE", "MPJPE", "MPJVE", "Jitter"):
        assert best(15, metric) == "Ours"
        assert best(14, metric) == "2, 4, 6, 8"
        assert best(11, metric) == "Mem-MLP w/ VQ-VAE"
        assert best(5, metric) == "automatic"
        assert rows(4)[2][metric] < rows(4)[0][metric]
        assert best(8, metric) == ("MHP w/ MB" if metric == "Jitter" else "MHP wo/ MB")
    for metric in ("MPJVE", "Jitter"):
        by_length = [found[metric] for found in rows(10)]
        assert by_length == sorted(by_length, reverse=True)
    for metric in rows(3)[0].keys() - {"label"}:
        assert best(3, metric) == "Mem-MLP"
    assert best(16, "FLOPs") == "Mem-MLP-41"
    assert best(16, "parameters") == "AGRoL-MLP"
