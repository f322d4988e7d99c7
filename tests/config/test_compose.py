"""Every shipped config composes, and every bad command line gives one line that names the key."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from conftest import Memmlp, one_line
from hydra import compose
from omegaconf import DictConfig, OmegaConf
from processes import finished

from memmlp.common.errors import InputError
from memmlp.config import schema
from memmlp.config.build import build_experiment
from memmlp.config.compose import _hydra, composed, parse, preflight
from memmlp.config.package_data import packaged
from memmlp.runs.identity import NEUTRAL, flatten

FOLDERS = packaged("conf").glob("*/")
GROUPS = {folder.name: sorted(path.stem for path in folder.glob("*.yaml")) for folder in FOLDERS}
del GROUPS["search"]  # of `memmlp tune`
OF_TERMS = [
    path.stem
    for path in packaged("conf").glob("loss/*.yaml")
    if any(words in path.read_text() for words in ("loss_terms", "- kinematic"))
]
OPTIONS = [f"{group}={name}" for group, names in GROUPS.items() for name in names]


@pytest.fixture
def needed(tmp_path: Path) -> dict[str, list[str]]:
    """Return, by option, overrides for the values that the option leaves to the user."""
    root, lists = f"data.root={tmp_path}", f"data.split.folder={tmp_path}"
    return {
        "data=mocap": [root],
        "data=cmu_bandai": [f"data.sources.{source}.root={tmp_path}" for source in ("cmu", "bandai")],
        "data=amass_s1": [root, lists],
        "data=amass_s2": [root],
        "data=amass_s3": [root],
        "predictor=rotation_only": ["hand=fk"],
        "loss=agrol": ["model=agrol_mlp"],
        "loss=avatar_poser": ["model=avatar_poser"],
        "loss=of_network": ["model=bodiffusion"],
        "loss=rpm": ["model=rpm"],
        "upstream=sage": ["model=sage"],
        **{f"loss={name}": ["model=agrol_mlp"] for name in OF_TERMS},
        "predictor=rotation_only_memory": ["hand=fk"],
    }


@pytest.mark.slow
@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_composes_and_passes(option: str, needed: dict[str, list[str]]):
    assert isinstance(composed([option, *needed.get(option, [])]), DictConfig)


@pytest.mark.slow
@pytest.mark.parametrize("profile", GROUPS["profile"])
@pytest.mark.parametrize("memory", GROUPS["memory"])
def test_a_profiles_sizes_reach_every_group(profile: str, memory: str):
    cfg = composed([f"profile={profile}", f"memory={memory}"])
    sizes = cfg.profile
    assert (cfg.model.frames, cfg.model.width, cfg.model.depth) == (sizes.frames, sizes.width, sizes.depth)
    assert (cfg.optim.steps, cfg.optim.batch, cfg.optim.lr) == (sizes.steps, sizes.batch, sizes.lr)
    assert (cfg.vqvae.codes, cfg.vqvae.width) == (sizes.codes, sizes.code_width)
    if memory == "none":
        assert set(cfg.memory) == {"name", "_target_", "_partial_"}
    else:
        assert (cfg.memory.layers, cfg.memory.width) == (sizes.memory_layers, sizes.memory_width)


def test_every_size_is_read_by_a_group():
    raw = "".join(path.read_text() for path in packaged("conf").rglob("*.yaml"))
    assert [key for key in composed([]).profile if f"${{profile.{key}}}" not in raw] == []


def test_a_group_may_differ_from_its_profile():
    cfg = composed(["profile=tiny", "memory.width=5", "optim.steps=7"])
    assert (cfg.memory.width, cfg.optim.steps, cfg.profile.steps) == (5, 7, 20)


def test_the_most_literal_reading():
    cfg = composed(["experiment=paper"])
    assert (cfg.model.width, cfg.model.depth, cfg.model.frames) == (512, 8, 41)
    assert (cfg.normalizer.coordinates, cfg.normalizer.z_scores) == ("world", False)
    assert (cfg.memory.shift, cfg.memory.history, cfg.memory.fusion) == ("frame", "latest", "residual")
    assert cfg.rollout._target_.endswith("TeacherForcing")
    assert (cfg.optim.steps, cfg.optim.batch, cfg.optim.drop_at) == (300_000, 256, 0.75)
    assert (cfg.vqvae.epochs, cfg.vqvae.steps, cfg.vqvae.codebook) == (100, None, "gradient")
    assert (cfg.data.drawn_by, cfg.evaluation.ik) == ("clips", "lbfgs")
    assert (composed([]).data.drawn_by, composed([]).evaluation.ik) == ("frames", "off")


@pytest.mark.parametrize("experiment", ["profile=paper", "experiment=paper"])
def test_the_literal_reading_leaves_other_networks_their_coordinates(experiment: str):
    def seen(model: str) -> tuple[str, bool]:
        features = composed([experiment, f"model={model}"]).normalizer
        return features.coordinates, features.z_scores

    assert seen("agrol_diffusion") == ("world", True)
    assert seen("recurrent_poser") == ("heading", True)
    assert seen("avatar_poser") == ("world", False)


def test_a_network_without_positions_has_no_inverse_kinematics_in_the_literal_reading():
    assert composed(["experiment=paper", "model=agrol_mlp"]).evaluation.ik == "off"
    with pytest.raises(InputError, match=r"evaluation\.ik=lbfgs needs positions"):
        composed(["experiment=paper", "model=agrol_mlp", "evaluation.ik=lbfgs"])


def test_a_vqvaes_epochs_are_of_the_training_frames():
    """100 epochs of 1000 frames in batches of 256 are 390.6 steps; steps are steps, whatever the frames."""
    optim = build_experiment(composed(["profile=paper"])).prerequisites[0].optim
    assert [optim(frames).steps for frames in (1000, 5_000_000)] == [391, 1_953_125]
    assert optim(1000).validate_every == 391
    half = build_experiment(composed(["vqvae.epochs=0.5", "vqvae.steps=null"])).prerequisites[0].optim
    assert half(5120).steps == 10
    steps = build_experiment(composed([])).prerequisites[0].optim
    assert [steps(frames).steps for frames in (1000, 5_000_000)] == [2000, 2000]


@pytest.mark.parametrize("name", [n for n in schema.SCHEMAS if n != "config"])
def test_every_target_is_there(name: str):
    target = {f.name: f.default for f in schema.SCHEMAS[name].__dataclass_fields__.values()}.get("_target_")
    if isinstance(target, str):
        from hydra.utils import get_class

        get_class(target)


def test_ignored_keys_are_keys_of_the_config():
    keys = {*flatten(OmegaConf.to_container(composed([]), resolve=True))}
    for ignored in set(NEUTRAL) - {"hydra"}:
        assert any(key == ignored or key.startswith(f"{ignored}.") for key in keys), ignored


def test_a_foreign_class_has_a_name_of_its_own(tmp_path: Path):
    (tmp_path / "predictor").mkdir()
    for name, refused in (("two_branch", True), ("mine", False)):
        (tmp_path / "predictor/mine.yaml").write_text(f"{{name: {name}, _target_: mine.Mine, depth: 2}}")
        words = ["--config-dir", str(tmp_path), "predictor=mine"]
        if refused:
            with pytest.raises(InputError, match=r"predictor\.name=two_branch: allowed for mine\.Mine"):
                composed(words)
        else:
            assert composed(words).predictor.name == "mine"


def test_the_last_of_several_choices_wins():
    assert composed(["memory=vq", "seed=1", "memory=none", "seed=2"]).seed == 2
    assert composed(["memory=vq", "memory=none"]).memory._target_ == "memmlp.networks.memory.NoMemory"


@pytest.mark.parametrize("word", ["'2024_11'", "2024", "2024_a", "007", "[x]_1", "True"])
def test_a_text_is_kept_as_it_was_written(word: str):
    kept = composed([f"save_predictions={word}"] if "[" not in word else [f"save_predictions='{word}'"])
    assert kept.save_predictions == word.strip("'")


def test_outputs_come_from_the_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MEMMLP_OUTPUTS", "/somewhere")
    assert composed([]).data.root == "/somewhere/data/synth"


BAD = [
    # arguments, what the line must name
    # unknown keys
    (["model.widht=3"], ["model.widht", "did you mean width?", "frames, width, depth"]),
    (["+model.widht=3"], ["model.widht", "did you mean width?"]),
    (["++model.widht=3"], ["model.widht", "width"]),
    (["typo=1"], ["typo", "seed, device"]),
    (["+typo=1"], ["typo", "seed, device"]),
    (["data.split.tset=0.1"], ["data.split.tset", "did you mean test?"]),
    (["memory=none", "memory.width=3"], ["memory.width", "none"]),
    (["loss.rotation=3"], ["loss.rotation", "lr"]),
    (["hydra.runn.dir=."], ["hydra.runn", "did you mean run?"]),
    (["rollout.max_passes=2"], ["rollout.max_passes", "no such key"]),
    # wrong types
    (["model.width=abc"], ["model.width=abc", "an integer"]),
    (["model.width=1.5"], ["model.width=1.5", "an integer"]),
    (["model.width=null"], ["model.width=null", "an integer"]),
    (["model.width=[1]"], ["model.width", "an integer"]),
    (["optim.lr=fast"], ["optim.lr=fast", "a number"]),
    (["force=maybe"], ["force=maybe", "true or false"]),
    (["memory.layers=3"], ["memory.layers=3", "a list"]),
    (["memory.layers=[a]"], ["memory.layers[0]", "an integer"]),
    (["memory.layers=[1,[2]]"], ["memory.layers", "a list"]),
    (["memory.blend=true"], ["memory.blend=true", "a number"]),
    (["data.split=3"], ["data.split=3", "test, val"]),
    (["seed=1e3"], ["seed=1e3", "an integer"]),
    (["model.width=${profile.schedule}"], ["model.width", "Integer"]),
    # unknown options
    (["model=big"], ["model=big", "mem_mlp"]),
    (["memory=mamba"], ["memory=mamba", "gru, lstm, no_codes, none, vq, vq_joint"]),
    (["experiment=papr"], ["experiment=papr", "did you mean paper?"]),
    (["profile=tinny"], ["profile=tinny", "did you mean tiny?"]),
    (["lauss=manual"], ["lauss", "did you mean loss?"]),
    (["hydra/launcher=cluster"], ["hydra/launcher=cluster", "basic"]),
    # out of range
    (["model.width=0"], ["model.width=0", "at least 1"]),
    (["model.frames=1"], ["model.frames=1", "at least 2"]),
    (["seed=-1"], ["seed=-1", "at least 0"]),
    (["device=tpu"], ["device=tpu", "auto or cpu or cuda"]),
    (["optim.lr=0"], ["optim.lr=0", "above 0"]),
    (["optim.lr=nan"], ["optim.lr=nan", "above 0"]),
    (["optim.lr=inf"], ["optim.lr=inf", "above 0"]),
    (["optim.batch=0"], ["optim.batch=0", "at least 1"]),
    (["optim.drop_at=1"], ["optim.drop_at=1", "below 1"]),
    (["optim.schedule=linear"], ["optim.schedule=linear", "step or cosine"]),
    (["optim.warmup=-1"], ["optim.warmup=-1", "at least 0"]),
    (["optim.ema=1"], ["optim.ema=1", "above 0 and below 1"]),
    (["optim=muon", "optim.other_lr=0"], ["optim.other_lr=0", "above 0"]),
    (["optim=schedule_free", "optim.schedule=step"], ["optim.schedule", "no such key"]),
    (["optim=sgd"], ["optim=sgd", "adamw, muon, schedule_free"]),
    (["optim.warmup=2001"], ["optim.warmup=2001", "at most optim.steps=2000"]),
    (["optim.precision=fp16"], ["optim.precision=fp16", "fp32 or bf16"]),
    (["memory.blend=1.5"], ["memory.blend=1.5", "at most 1 or sampled"]),
    (["memory.blend=always"], ["memory.blend=always", "sampled"]),
    (["rollout=own_predictions", "memory.shift=frame"], ["rollout.max_passes=3", "at least model.frames=41"]),
    (["memory.shift=window2"], ["memory.shift=window2", "frame or window"]),
    (["memory.history=all"], ["memory.history=all", "first or latest"]),
    (["memory.fusion=sum"], ["memory.fusion=sum", "residual or plain"]),
    (["memory.layers=[0]"], ["memory.layers=[0]", "at least 1"]),
    (["memory.layers=[]"], ["memory.layers=[]", "not empty"]),
    (["memory.layers=[2,2]"], ["memory.layers=[2, 2]", "without repetitions"]),
    (["evaluation.modes=[stream,stream]"], ["evaluation.modes", "without repetitions"]),
    (["evaluation.modes=[live]"], ["evaluation.modes=['live']", "window or stream"]),
    (["vqvae.epochs=3"], ["vqvae.epochs=3.0, vqvae.steps=2000", "one of them", "null"]),
    (["vqvae.steps=null"], ["vqvae.epochs=None, vqvae.steps=None", "one of them"]),
    (["vqvae.steps=null", "vqvae.epochs=0"], ["vqvae.epochs=0", "above 0"]),
    (["data.drawn_by=even"], ["data.drawn_by=even", "frames or clips"]),
    (["vqvae.codebook=random"], ["vqvae.codebook=random", "ema or gradient"]),
    (["vqvae.decay=1"], ["vqvae.decay=1", "below 1"]),
    (["normalizer.coordinates=polar"], ["normalizer.coordinates=polar", "head_relative or world"]),
    (["data.synth.minutes=0"], ["data.synth.minutes=0", "above 0"]),
    (["paths.outputs="], ["paths.outputs=", "not empty"]),
    (
        ["memory._target_=os.system"],
        ["memory._target_=os.system", "CodeMemory"],
    ),
    # impossible combinations
    (["~memory"], ["memory", "memory=none for none"]),
    (["~hand"], ["hand", "hand=off for none"]),
    (["~predictor"], ["predictor", "one of its options"]),
    (["memory.layers=[2,9]"], ["memory.layers=[2, 9]", "model.depth=8"]),
    (["model.depth=3"], ["memory.layers", "model.depth=3"]),
    (["optim.final_lr=1"], ["optim.final_lr=1", "optim.lr"]),
    (["predictor=rotation_only"], ["hand=position", "hand=fk or hand=off"]),
    (["rollout=streams", "rollout.streams=4"], ["rollout.streams=4", "optim.batch"]),
    (["data.split.test=0.6", "data.split.val=0.4"], ["data.split.val=0.4", "data.split.test"]),
    (["data=mocap", "data.root=.", "data.synth.minutes=3"], ["data.synth.minutes=3"]),
    (["save_predictions="], ["save_predictions=:", "a folder, or null"]),
    # texts that would be others
    (["save_predictions=2024_11"], ["save_predictions=2024_11", "202411", "\"save_predictions='2024_11'\""]),
    (["paths.outputs=1e3"], ["paths.outputs=1e3", "1000.0", "in quotes"]),
    (["paths.outputs=true"], ["paths.outputs=true", "True", "in quotes"]),
    (["-m", "seed=0,1", "paths.outputs=2024_11"], ["paths.outputs=2024_11", "202411"]),
    (["-m", "save_predictions=a,1_0"], ["save_predictions=a,1_0", "10", "in quotes"]),
    (["data=mocap", "data.root=.", "data.split.groups=[a,10_01]"], ["data.split.groups=[a,10_01]", "1001"]),
    # missing
    (["data=mocap"], ["data.root", "no value"]),
    (["data=amass_s1", "data.root=."], ["data.split.folder", "no value"]),
    (["data=mocap", "data.root=nowhere"], ["data.root=nowhere", "an existing folder"]),
    (["data.body=nowhere.npz"], ["data.body=nowhere.npz", "an existing file or builtin"]),
    (["data=amass_s1", "data.root=.", "data.split.folder=no"], ["data.split.folder=no", "existing folder"]),
    (["data.root=${oc.env:NOT_SET}"], ["data.root", "NOT_SET"]),
    (["model.width=${profile.nope}"], ["model.width", "profile.nope"]),
    (["~model.width"], ["model.width", "cannot be removed"]),
    (["~model"], ["model.", "no value"]),
    # broken command lines
    (["model.width"], ["model.width", "KEY=VALUE"]),
    (["model.width=["], ["model.width=[", "KEY=VALUE"]),
    (["a b"], ["a b", "KEY=VALUE"]),
    (["=3"], ["=3"]),
    (["model.width='${nope'"], ["model.width"]),
    (["model.width=1,2"], ["model.width=1,2", "-m"]),
    (["--no-such-flag"], ["--no-such-flag"]),
    (["--config-dir", "nowhere"], ["nowhere", "existing folder"]),
    (["--config-name", "nowhere"], ["nowhere"]),
    (["--cfg", "everything"], ["everything", "job"]),
    (["--cfg", "job", "model.widht=3"], ["model.widht", "did you mean width?"]),
    # sweeps: the second job is bad, and the first must not start
    (["-m", "model.width=16,-1"], ["model.width=-1", "at least 1"]),
    (["model.width=16,x", "--multirun"], ["model.width=x", "an integer"]),
    (["-m", "memory=vq,mamba"], ["memory=mamba", "no_codes, none, vq"]),
    (["-m", "model.width=range(1,"], ["model.width=range(1,", "KEY=VALUE"]),
]


@pytest.fixture
def _nothing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(cfg: DictConfig) -> None:
        pytest.fail("a job ran")

    monkeypatch.setattr("memmlp.cli.train.run_training", fail)


@pytest.mark.usefixtures("_nothing_runs")
@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[" ".join(case[0]) for case in BAD])
def test_a_bad_command_line_is_one_line(
    memmlp: Memmlp, tmp_path: Path, arguments: list[str], words: list[str]
):
    ran = memmlp("train", *arguments)
    assert one_line(ran, *words), ran
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["model.width=abc"], ["-m", "seed=0,-1"], ["--nope"]])
def test_a_bad_command_line_in_a_process_of_its_own(tmp_path: Path, arguments: list[str]):
    command = [sys.executable, "-m", "memmlp", "train", *arguments]
    ran = finished(command, cwd=tmp_path)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.startswith("memmlp: ")
    assert ran.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


EXTRA = """
# @package _global_
model:
  width: {}
"""


@pytest.mark.parametrize(("value", "word"), [("wide", "an integer"), ("-3", "at least 1")])
def test_a_bad_file_of_the_users_own(memmlp: Memmlp, tmp_path: Path, value: str, word: str):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    (tmp_path / "mine" / "experiment" / "own.yaml").write_text(EXTRA.format(value))
    assert one_line(memmlp("train", "--config-dir", "mine", "experiment=own"), "model.width", word)


@pytest.mark.parametrize(
    ("place", "option"),
    [
        ("--config-dir", "experiment/paper.yaml"),
        ("--cfg", "experiment/paper.yaml"),
        ("hydra.searchpath", "experiment/paper.yaml"),
        ("sweep", "experiment/paper.yaml"),
        ("--config-dir", "memory/gru.yaml"),
        ("--config-dir", "train.yaml"),
    ],
)
def test_an_option_of_ones_own_that_ours_hides_is_refused(
    memmlp: Memmlp, tmp_path: Path, place: str, option: str
):
    """Hydra takes ours, and says nothing."""
    own = tmp_path / "mine" / option
    own.parent.mkdir(parents=True)
    own.write_text(EXTRA.format(16))
    (tmp_path / "s.yaml").write_text("variants: {a: [experiment=paper]}\n")
    words = {
        "--config-dir": ["train", "--config-dir", "mine", "optim.lr=-1"],
        "--cfg": ["train", "--config-dir", "mine", "--cfg", "job"],
        "hydra.searchpath": ["train", "hydra.searchpath=[file://mine]", "optim.lr=-1"],
        "sweep": ["sweep", "s.yaml", "--config-dir", "mine", "optim.lr=-1"],
    }[place]
    assert one_line(memmlp(*words), f"mine/{option}", f"conf/{option} is used in its place")
    own.write_bytes((packaged("conf") / option).read_bytes())  # the same is no other
    ran = memmlp(*words)
    assert ran.code == 0 if place == "--cfg" else one_line(ran, "optim.lr=-1")


def test_a_folder_hides_no_option_of_another_one(memmlp: Memmlp, tmp_path: Path):
    for name, width in (("a", 16), ("b", 24)):
        (tmp_path / name / "experiment").mkdir(parents=True)
        (tmp_path / name / "experiment" / "own.yaml").write_text(EXTRA.format(width))
    both = ["hydra.searchpath=['file://a', b]", "experiment=own", "optim.lr=-1"]
    assert one_line(memmlp("train", *both), "b/experiment/own.yaml", "a/experiment/own.yaml is used")


def test_help_lists_the_groups_and_the_config(memmlp: Memmlp):
    said = memmlp("train", "--help", "memory=gru").out
    groups, config = said.split("== Config ==")
    assert re.search(r"^memory: .*\bgru\b", groups, re.MULTILINE)
    assert "search" not in re.findall(r"^(\w+): ", groups, re.MULTILINE)
    assert "name: gru" in config


def test_an_experiment_does_not_replace_another_one_in_silence(memmlp: Memmlp):
    for words in (["optim.lr=-1"], ["--cfg", "job"], ["--help"]):
        ran = memmlp("train", "experiment=no_codes", "experiment=manual_weights", *words)
        assert one_line(ran, "experiment=manual_weights", "would replace experiment=no_codes", "=[A,B]")
    both = composed(["experiment=[no_codes,manual_weights]"])
    assert (both.memory.name, both.loss.name) == ("no_codes", "manual")


def test_an_experiment_that_leads_back_to_itself_is_refused(memmlp: Memmlp, tmp_path: Path):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    own = tmp_path / "mine" / "experiment" / "own.yaml"
    own.write_text("# @package _global_\ndefaults: [{/experiment: no_codes}]\n")
    ran = memmlp("train", "--config-dir", "mine", "experiment=own")
    assert one_line(ran, "experiment=own", "leads back to itself", "'- NAME'")


def test_a_config_without_the_schema_is_refused(memmlp: Memmlp, tmp_path: Path):
    (tmp_path / "bare.yaml").write_text("seed: 1\n")
    assert one_line(memmlp("train", "--config-dir", ".", "--config-name", "bare"), "/schema/config@_here_")


@pytest.mark.parametrize(
    "overrides",
    [
        ["model.width=8", "seed=3"],
        ["profile=tiny", "memory=gru", "experiment=no_memory", "optim.steps=4"],
        ["model=avatar_poser", "loss.position=2", "~loggers"],
        ["profile.width=16", "data.split.groups=[a,b]", "paths.outputs=elsewhere", "loggers=none"],
    ],
)
def test_a_job_is_composed_as_hydra_composes_it(overrides):
    """Options of groups are chosen once for many jobs (twice here), and changes of one job are its own."""
    args = parse(overrides)
    for _ in range(2):
        (own,) = preflight(args)
        with _hydra(args):
            assert own == compose("train", list(overrides))
        assert OmegaConf.is_struct(own)
        own.model.frames, own.seed = 99, 99
