"""Every shipped config composes, and every bad command line gives one line that names the key."""

from pathlib import Path

import pytest
from conftest import Memmlp, one_line
from hydra import compose
from omegaconf import DictConfig, OmegaConf

from memmlp.common.components import SLOTS, list_component_names
from memmlp.common.files import find_packaged_folder
from memmlp.config.build import build_experiment
from memmlp.config.compose import _initialize_hydra, compose_config, compose_jobs, parse_hydra_arguments

OF_TERMS = [path.stem for path in find_packaged_folder("conf").glob("loss/*.yaml")]


@pytest.mark.slow
@pytest.mark.parametrize("step", [8, pytest.param(1, marks=pytest.mark.long)])
def test_every_option_composes_and_passes(tmp_path: Path, step: int):
    root, lists = f"data.root={tmp_path}", f"data.split.folder={tmp_path}"
    needed = {
        "data=mocap": [root],
        "data=cmu_bandai": [f"data.sources.{source}.root={tmp_path}" for source in ("cmu", "bandai")],
        "data=persons": [root], "data=amass_s1": [root, lists], "data=amass_s2": [root],
        "data=amass_s3": [root], "data=cmu_s1": [root], "data=cmu_persons": [root],
        "loss=avatar_poser": ["model=avatar_poser"],
        "loss=of_network": ["model=bodiffusion"], "prerequisite=sage": ["model=sage"],
        **{f"loss={name}": ["model=agrol_mlp"] for name in (*OF_TERMS, "agrol", "rpm", "terms")},
        **{f"predictor={name}": ["hand=fk"] for name in ("rotation_only", "rotation_only_memory")},
    }  # fmt: skip
    options = [f"{slot}={name}" for slot in SLOTS for name in list_component_names(slot)]
    for group in ("data", "experiment", "loggers", "loss", "profile"):
        options += [f"{group}={path.stem}" for path in (find_packaged_folder("conf") / group).glob("*.yaml")]
    assert len(options) > 60
    for option in options[::step]:
        assert isinstance(compose_config([option, *needed.get(option, [])]), DictConfig), option


def test_a_component_has_the_sizes_of_the_profile():
    for profile, *sizes in (
        ("tiny", 11, 16, 8, 20, 8), ("small", 41, 128, 48, 2000, 32), ("paper", 41, 512, 192, 300_000, 256),
    ):  # fmt: skip
        cfg = compose_config([f"profile={profile}"])
        found = [cfg.model.frames, cfg.model.width, cfg.memory.width, cfg.optim.steps, cfg.optim.batch]
        assert (found, list(cfg.memory.layers)) == (sizes, [2, 4, 6, 8])
    cfg = compose_config(["profile=tiny", "profile.sizes=small", "profile.width=64", "model.depth=4"])
    assert (cfg.model.width, cfg.memory.width, list(cfg.memory.layers)) == (64, 24, [2, 4])
    assert cfg.optim.steps == 20


def test_a_vqvaes_epochs_are_of_the_training_frames():
    """100 epochs of 1000 frames in batches of 256 are 390.6 steps; steps are steps, whatever the frames."""
    optim = build_experiment(compose_config(["profile=paper"])).prerequisites[0].optim
    assert [optim(frames).steps for frames in (1000, 5_000_000)] == [391, 1_953_125]
    assert optim(1000).validate_every == 391
    half = build_experiment(compose_config(["vqvae.epochs=0.5", "vqvae.steps=null"])).prerequisites[0].optim
    assert half(5120).steps == 10
    steps = build_experiment(compose_config([])).prerequisites[0].optim
    assert [steps(frames).steps for frames in (1000, 5_000_000)] == [2000, 2000]


def test_the_last_of_several_choices_wins_and_texts_are_kept(monkeypatch: pytest.MonkeyPatch):
    cfg = compose_config(["memory=vq", "seed=1", "memory=none", "seed=2"])
    assert (cfg.memory.name, cfg.seed) == ("none", 2)
    for word in ("'2024_11'", "2024", "2024_a", "007", "'[x]_1'", "True"):
        assert compose_config([f"save_predictions={word}"]).save_predictions == word.strip("'")
    monkeypatch.setenv("MEMMLP_OUTPUTS", "/somewhere")
    assert compose_config([]).data.root == "/somewhere/data/synth"


BAD = {
    "unknown keys": [
        (["model.widht=3"], ["model.widht", "did you mean width?", "frames, width, depth"]),
        (["memory=none", "memory.width=3"], ["memory.width"]), (["loss.rotation=3"], ["loss.rotation", "lr"]),
        (["--cfg", "job", "model.widht=3"], ["model.widht", "did you mean width?"]),
    ],
    "wrong types": [
        (["model.width=abc"], ["model.width=abc", "an integer"]),
        (["model.width=${profile.schedule}"], ["model.width", "Integer"]),
    ],
    "unknown options": [
        (["memory=mamba"], ["memory=mamba", "gru, lstm, no_codes, none, vq, vq_joint"]),
        (["experiment=papr"], ["experiment=papr", "did you mean paper?"]),
        (["normalizer.coordinates=polar"], ["normalizer.coordinates=polar", "head_relative or world"]),
    ],
    "out of range": [
        (["model.width=0"], ["model.width=0", "at least 1"]), (["profile.ema=0"], ["profile.ema=0", "above"]),
        (["optim.lr=nan"], ["optim.lr=nan", "above 0"]), (["optim.lr=inf"], ["optim.lr=inf", "above 0"]),
        (["memory.blend=1.5"], ["memory.blend=1.5", "at most 1 or sampled"]),
        (["hand=null", "seed=1"], ["hand=null: must be one of its options; ~hand"]),
        (["memory.layers=[2,2]"], ["memory.layers=[2, 2]", "without repetitions"]),
        (["vqvae.steps=null", "vqvae.epochs=0"], ["vqvae.epochs=0", "above 0"]),
        (["memory.name=gru"], ["memory.name=gru", "vq"]),
    ],
    "impossible combinations": [
        (["~memory"], ["memory", "none for no memory"]),
        (["memory.layers=[2,9]"], ["memory.layers=[2, 9]", "model.depth=8"]),
        (["predictor=two_branch_memory", "predictor.depth=0"], ["predictor.depth=0"]),
        (["loss=avatar_poser"], ["loss=avatar_poser", "uncertainty or manual"]),
        (["vqvae.epochs=3"], ["vqvae.epochs=3.0, vqvae.steps=2000", "null"]),
        (["data.split.test=0.6", "data.split.val=0.4"], ["data.split.val=0.4", "data.split.test"]),
        (["data=mocap", "data.root=.", "data.synth.minutes=3"], ["data.synth.minutes=3"]),
        (["export.precision=int8", "memory.history=latest"], ["export.precision=int8", "memory.history"]),
    ],
    "texts that would be others": [
        (["save_predictions="], ["save_predictions=:", "a folder, or null"]),
        (["paths.outputs=1e3"], ["paths.outputs=1e3", "1000.0", "quote the value"]),
        (["data=mocap", "data.root=.", "data.split.groups=[a,10_01]"], ["data.split.groups", "1001"]),
    ],
    "missing values": [
        (["data=mocap"], ["data.root", "no value"]), (["~model.width"], ["model.width", "cannot be removed"]),
        (["data.root=${oc.env:NOT_SET}"], ["data.root", "NOT_SET"]),
    ],
    "broken command lines": [
        (["--no-such-flag"], ["--no-such-flag"]), (["-m", "--cfg", "job"], ["--multirun, --cfg", "only one"]),
        (["--config-dir", "nowhere"], ["nowhere", "existing folder"]),
        (["hydra.searchpath=[file:///tmp]"], ["hydra.searchpath: use --config-dir"]),
        (["evaluation.metrics=[é]"], ["evaluation.metrics=['é']"]),
        (["refiner=null", "--cfg", "job"], ["refiner=null"]),
    ],
    "a bad second job, before the first starts": [
        (["-m", "model.width=16,-1"], ["model.width=-1", "at least 1"]),
        (["-m", "model={width:16},{width:32}", "model={depth:3}"], ["model={depth:3}", "model={width:16}"]),
    ],
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_command_line_is_one_line(memmlp: Memmlp, tmp_path: Path, monkeypatch, kind: str):
    monkeypatch.setattr("memmlp.cli.train.run_training", lambda cfg: pytest.fail("a job ran"))
    for arguments, words in BAD[kind]:
        ran = memmlp("train", *arguments)
        assert one_line(ran, *words), (arguments, ran)
    assert list(tmp_path.iterdir()) == []


HIDDEN = {
    "--config-dir": ["train", "--config-dir", "mine", "optim.lr=-1"],
    "--cfg": ["train", "--config-dir", "mine", "--cfg", "job"],
    "sweep": ["sweep", "s.yaml", "--config-dir", "mine", "optim.lr=-1"],
}


@pytest.mark.parametrize(
    ("place", "option"),
    [*((place, "experiment/paper.yaml") for place in HIDDEN), ("--config-dir", "train.yaml")],
)
def test_an_option_of_ones_own_that_ours_hides_is_refused(memmlp, tmp_path: Path, place: str, option: str):
    """Hydra takes ours, and says nothing."""
    own = tmp_path / "mine" / option
    own.parent.mkdir(parents=True)
    own.write_text("# @package _global_\nmodel:\n  width: 16\n")
    (tmp_path / "s.yaml").write_text("variants: {a: [experiment=paper]}\n")
    assert one_line(memmlp(*HIDDEN[place]), f"mine/{option}", f"conf/{option} instead")
    own.write_bytes((find_packaged_folder("conf") / option).read_bytes())  # the same is no other
    ran = memmlp(*HIDDEN[place])
    assert ran.code == 0 if place == "--cfg" else one_line(ran, "optim.lr=-1")


@pytest.mark.parametrize(("file", "text", "choice", "words"), [
    ("memory/gru.yaml", "name: gru", [], ("mine/memory/gru.yaml", "rename the file")),
    *((
        "experiment/own.yaml", f"# @package _global_\ndata: {{split: {{groups: [a, '010', {text}]}}}}",
        ["experiment=own"], ("own.yaml, line 2", f"reads {text} as {value}; write '{text}'"),
    ) for text, value in {"010": 8, "10_01": 1001, "12:30": 750, "off": False}.items()),
    (
        "experiment/own.yaml", "# @package _global_\ndefaults: [{/experiment: no_codes}]",
        ["experiment=own"], ("experiment=own", "includes itself", "'- NAME'"),
    ),
])  # fmt: skip
def test_a_config_file_that_hydra_would_misread_is_refused(
    memmlp: Memmlp, tmp_path: Path, file: str, text: str, choice: list[str], words: tuple[str, ...]
):
    (tmp_path / "mine" / file).parent.mkdir(parents=True)
    (tmp_path / "mine" / file).write_text(f"{text}\n")
    assert one_line(memmlp("train", "--config-dir", "mine", *choice), *words)


def test_limits_include_their_ends():
    ones = [
        f"profile.{key}=1" for key in ("steps", "batch", "checkpoint_every", "validate_every", "log_every")
    ]
    ones += ["profile.evaluation_batch=1", "vqvae.codes=1", "vqvae.width=1", "vqvae.encoder_depth=0"]
    assert compose_config([*ones, "vqvae.decoder_depth=0", "vqvae.commitment=0"]).vqvae.codes == 1


def test_an_experiment_does_not_replace_another_one_in_silence(memmlp: Memmlp):
    for words in (["optim.lr=-1"], ["--cfg", "job"], ["--help"]):
        ran = memmlp("train", "experiment=no_codes", "experiment=manual_weights", *words)
        assert one_line(ran, "experiment=manual_weights", "would replace experiment=no_codes", "=[A,B]")
    both = compose_config(["experiment=[no_codes,manual_weights]"])
    assert (both.memory.name, both.loss.name) == ("no_codes", "manual")


@pytest.mark.parametrize("overrides", [
    ["model=bodiffusion", "refiner=sage", "profile=paper"],
    ["model=recurrent_poser", "loss=calm", "optim=adamw", "loggers=all"],
    ["hand='off'", "predictor=rotation_only", "memory=none", "loss=manual"],
    ["profile=tiny", "memory=gru", "experiment=no_memory", "optim.steps=4"],
    ["model=avatar_poser", "loss.position=2", "~loggers"],
    ["profile.width=16", "data.split.groups=[a,b]", "paths.outputs=elsewhere", "loggers=none"],
    ["model.width=8", "seed=3"], ["optim=muon", "loss=kinematic", "model=rpm", "optim.lr=0.1"],
])  # fmt: skip
def test_a_job_is_composed_as_hydra_composes_it(overrides):
    """Options of groups are chosen once for many jobs (twice here), and changes of one job are its own."""
    args = parse_hydra_arguments(overrides)
    for _ in range(2):
        (own,) = compose_jobs(args)
        with _initialize_hydra(args):
            assert own == compose("train", list(overrides))
        assert OmegaConf.is_struct(own)
        own.model.frames, own.seed = 99, 99
