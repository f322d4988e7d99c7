"""Users' packages: which are used, what they add, and that nothing is imported that nobody named."""

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from own_package import EXAMPLE, PACKAGE, registers_kept

from memmlp.cli.workers import split_executor
from memmlp.common import components
from memmlp.common.errors import InputError
from memmlp.config import plugins
from memmlp.config.build import build_experiment, load_config
from memmlp.config.build_request import build_request
from memmlp.config.compose import compose_config
from memmlp.config.compose_plan import find_sweep
from memmlp.config.schema import restore_config
from memmlp.report.tables.table_text import make_heading
from memmlp.runs import environment
from memmlp.runs.environment import describe_user_packages
from memmlp.runs.identity import compute_evaluation_id, select_evaluation_settings
from memmlp.runs.run import Run
from memmlp.sweep.search.search_file import parse_search

OWN = [f"plugins=[{PACKAGE}]", "experiment=feet", "profile=tiny"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.syspath_prepend(tmp_path)
    with registers_kept():
        yield tmp_path


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    environment._read_user_code.cache_clear()  # as in a process that starts now


@pytest.mark.parametrize(
    ("value", "names"), [(" [mine, 'other']", ["mine", "other"]), ("[mine", []), ("[mine],[other]", [])]
)
def test_packages_are_named_by_a_yaml_list(value: str, names: list[str]):
    assert plugins.find_named_packages([f"plugins={value}", "seed=1"]) == names


@pytest.mark.parametrize("how", ["overrides", "environment", "entry point"])
def test_a_package_is_used_where_somebody_names_it(on_path: Path, how: str, tmp_path: Path, monkeypatch):
    if how == "environment":
        monkeypatch.setenv("MEMMLP_PLUGINS", f" {PACKAGE},")
    if how == "entry point":
        write(tmp_path, {"feet-1.dist-info/entry_points.txt": f"[memmlp.plugins]\nfeet = {PACKAGE}\n"})
        write(tmp_path, {"feet-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: feet\nVersion: 1\n"})
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setattr(plugins, "list_installed", plugins.list_installed.__wrapped__)
    cfg = compose_config([*OWN[how != "overrides" :]])
    assert (cfg.memory.name, cfg.term.name, list(cfg.evaluation.metrics)) == ("mean", "skate", ["FootSkate"])


def test_keys_of_a_custom_component_are_checked(on_path: Path):
    for words, line in (
        (["memory=mean"], "memory=mean: no such option"),
        (["evaluation.metrics=[FootSkate]"], "evaluation.metrics="),
    ):
        with pytest.raises(InputError, match=line):
            compose_config(words)
        assert PACKAGE not in sys.modules
    for word, line in (
        ("memory.width=0", "memory.width=0: must be at least 1"),
        ("memory.depth=2", "memory.depth: no such key"),
        ("term.weight=-1", "term.weight=-1.0: must be at least 0"),
    ):
        with pytest.raises(InputError, match=line):
            compose_config([*OWN, word])


def raise_version(monkeypatch: pytest.MonkeyPatch, slot: str, name: str) -> None:
    newer = replace(components.find_component(slot, name), version=2)
    monkeypatch.setitem(components.collect_components(), (slot, name), newer)


def test_an_experiment_knows_packages_and_versions(on_path: Path, monkeypatch: pytest.MonkeyPatch):
    experiment = build_experiment(compose_config(OWN))
    assert experiment.config["plugins"] == [PACKAGE]
    versions, before = experiment.identity("d").component_versions, experiment.identity("d").id
    assert (versions["memory.mean"], versions["term.skate"]) == (1, 1)
    raise_version(monkeypatch, "memory", "mean")
    assert experiment.identity("d").id != before
    plain, named = (build_experiment(compose_config(words)) for words in ([], OWN[:1]))
    assert (plain.config["plugins"], named.identity("d").id) == ([], plain.identity("d").id)


def test_custom_metrics_make_another_evaluation(on_path: Path, monkeypatch: pytest.MonkeyPatch):
    config = build_experiment(compose_config(OWN)).config
    without = {**config, "evaluation": {**config["evaluation"], "metrics": []}}
    named = {"FootSkate": f"{PACKAGE}.metrics.foot_skate"}
    assert select_evaluation_settings(config, "stream")["metrics"] == named
    assert "metrics" not in select_evaluation_settings(without, "stream")
    before = compute_evaluation_id(config, "stream")
    assert before != compute_evaluation_id(without, "stream")
    raise_version(monkeypatch, "metric", "FootSkate")
    assert compute_evaluation_id(config, "stream") != before


def test_a_loss_has_the_term_with_its_weight(on_path: Path):
    for loss, weights, groups in (("manual", [0.1, 0.7], 0), ("uncertainty", [1.0, 1.0], 6)):
        words = [[*OWN, f"loss={loss}", f"term.weight={weight}"] for weight in (0.1, 0.7)]
        experiments = [build_experiment(compose_config(one)) for one in words]
        losses = [one.training.loss(frozenset({"rotation", "position"})) for one in experiments]
        assert [one.weighting.weights()["skate"] for one in losses] == weights
        assert sum(len(group["params"]) for group in losses[0].weighting.parameter_groups()) == groups
        assert len({one.identity("d").id for one in experiments}) == 2
    rotations = [*OWN, "predictor=rotation_only", "hand=off"]
    for words, line in (
        ([*rotations, "loss=agrol", "evaluation.ik=off"], r"term=skate: .*loss=agrol"),
        (rotations, r"term=skate: .*predictor=rot"),
        ([*OWN[:1], "model=agrol_mlp", "term=skate"], r"term: .*model=agrol_mlp"),
    ):
        with pytest.raises(InputError, match=line):
            build_experiment(compose_config(words))


def test_metrics_of_ones_own_are_those_of_sweeps_and_searches(on_path: Path):
    assert make_heading("FootSkate") == "FootSkate"  # nobody knows here what is better
    sweep = find_sweep(str(EXAMPLE / "feet.yaml"), ["profile=tiny"])
    assert (sweep.metrics, sweep.smallest["FootSkate"]) == (("MPJPE", "FootSkate"), 0.5)
    assert make_heading("FootSkate") == "FootSkate [cm/s] ↓"
    plugins.HIGHER.add("FootSkate")
    assert make_heading("FootSkate") == "FootSkate [cm/s] ↑"
    content = yaml.safe_load((Path(__file__).parents[2] / "conf/search/loss_weights.yaml").read_text())
    with pytest.raises(InputError, match=r"higher values of FootSkate are better"):
        parse_search({"storage": None, **content, "objectives": ["FootSkate"]})
    plugins.HIGHER.clear()
    assert parse_search({"storage": None, **content, "objectives": ["FootSkate"]}).objectives


HEAD = """
from memmlp.common.components import component
from memmlp.common.settings import MetricSettings, Settings, setting
"""


METRIC = '@component("metric", "A")\nclass ASettings'


@pytest.mark.parametrize(("text", "line"), [
    ('@component("memory", "gru")\nclass Mine: pass\n', "memory=gru exists already"),
    ('@component("metric", "MPJPE")\nclass S(MetricSettings): smallest = 1\n', "metric MPJPE: "),
    (f"{METRIC}(MetricSettings): smallest = 0\n", "metric A: "),
    (f'{METRIC}(MetricSettings): smallest, better = 1, "more"\n', "metric A: `better`"),
    (f"{METRIC}(torch.nn.Module): pass\n", "name 'torch' is not defined"),
])  # fmt: skip
def test_wrong_declarations_are_one_line(folder: Path, text: str, line: str):
    write(folder, {"mine.py": HEAD + text})
    with pytest.raises(InputError, match=f"^plugin mine: .*{line}"):
        compose_config(["plugins=[mine]"])
    assert "mine" not in plugins.list_active()
    assert compose_config(["memory=gru"]).memory.name == "gru"


def test_packages_that_cannot_be_used_are_named(folder: Path):
    write(folder, {"mine/__init__.py": "", "mine/conf/memory/gru.yaml": "name: gru"})
    write(folder, {"conf/experiment/own.yaml": "# @package _global_\nplugins: [mine]"})
    for words, line in (
        (["plugins=[nowhere_at_all]"], "not found"),
        (["plugins=[memmlp.cli]"], r"plugins=\[memmlp\.cli\]: must"),
        (["plugins=[os]"], r"plugins=\[os\]: must"),
        (["plugins=[mine]"], "gru.yaml: an option with this name"),
        (["--config-dir", str(folder / "conf"), "experiment=own"], r"plugins=\[mine\]"),
    ):
        with pytest.raises(InputError, match=line):
            compose_config(words)


WALKS = """
from dataclasses import dataclass
from memmlp.common.components import component
from memmlp.common.settings import Settings, setting
from memmlp.motion.network_coordinates import World
@component("coordinates", "floor")
class Floor(World): pass
@component("generator", "walks", version=VERSION, builds="walks")
@dataclass
class WalksSettings(Settings):
    minutes: float = setting(None, 1)
    seed: int = setting(None, 0)
def walks(folder, minutes, seed):
    (folder / f"{minutes} {seed}").touch()
"""


def test_a_custom_data_source_and_custom_coordinates(folder: Path):
    yaml = "defaults: [synth, override /generator@synth: walks, _self_]\nname: walks\nroot: made\n"
    files = {"mine/__init__.py": "", "mine/walks.py": WALKS.replace("VERSION", "1")}
    write(folder, {**files, "mine/conf/data/walks.yaml": yaml})
    words = ["data=walks", "data.synth.minutes=2", "data.synth.seed=3", "normalizer.coordinates=floor"]
    cfg = compose_config(["plugins=[mine]", *words])
    source, experiment = build_request(cfg).motion, build_experiment(cfg)
    assert source.clips.root == Path("made/walks-minutes2.0-seed3")
    source.generate(folder)
    assert (folder / "2.0 3").exists()
    assert type(experiment.architecture.coordinates).__name__ == "Floor"
    assert (experiment.config["plugins"], restore_config(experiment.config).data) == (["mine"], cfg.data)


def test_an_executor_of_ones_own(folder: Path):
    from memmlp.cli.workers import Workers

    write(folder, {"mine.py": "class Mine:\n    def __init__(self, *given):\n        self.given = given\n"})
    engine, words, rest = split_executor(["executor=mine.Mine", "executor.queue=long", "seed=1"])
    assert (engine, words, rest) == ("mine.Mine", {"queue": "long"}, ("seed=1",))
    made = Workers(engine, words).start_executor(folder, [])
    assert made.given == (folder / "workers/%j", {"queue": "long"})  # type: ignore[attr-defined]
    with pytest.raises(InputError, match=r"executor.queue: needs executor=PATH"):
        split_executor(["executor.queue=long"])


def recorded(config: dict, version: str | None = None) -> Run:
    """What a finished run tells, as far as `load_config` asks."""
    manifest = {"kind": "memmlp", "plugins": {PACKAGE: {"version": version, "digest": "d"}}}
    folder = Path("outputs/runs/abc")
    return SimpleNamespace(
        id="abc", done=True, manifest=manifest, config=config, config_path="c", folder=folder
    )  # type: ignore[return-value]


def test_reading_a_run_imports_nothing_by_itself(on_path: Path, monkeypatch: pytest.MonkeyPatch):
    with registers_kept():
        config = build_experiment(compose_config(OWN)).config
    assert PACKAGE not in sys.modules
    with pytest.raises(InputError) as error:
        load_config(recorded(config, "0.1.0"))
    assert f"{PACKAGE} 0.1.0" in str(error.value)
    assert f"--plugins {PACKAGE}, MEMMLP_PLUGINS={PACKAGE}" in str(error.value)
    assert PACKAGE not in sys.modules
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(sys, "path", [one for one in sys.path if one != str(on_path)])
        with pytest.raises(InputError, match=rf"{PACKAGE} 0.1.0, which was not found"):
            load_config(recorded(config, "0.1.0"))
    read = load_config(recorded(config), [f"plugins=[{PACKAGE}]"])
    assert build_experiment(read).identity("d").id == build_experiment(compose_config(OWN)).identity("d").id


def test_a_record_cannot_reach_beyond_the_package(on_path: Path):
    config = build_experiment(compose_config(OWN)).config
    for change, line in (
        ({"term": {**config["term"], "name": "os.system"}}, "term=os.system"),
        ({"term": {**config["term"], "_target_": "os.system"}}, "_target_"),
        ({"plugins": ["os"]}, "os"),
    ):
        with pytest.raises(InputError, match=line):
            load_config(recorded({**config, **change}))


def test_code_that_changed_since_is_told_where_nothing_imports_it(folder: Path):
    write(folder, {"mine.py": "A = 1\n"})
    plugins.activate(["mine"])
    run = Run(folder / "run")
    run.begin("memmlp", {}, data="d", prerequisite=None, plugins=describe_user_packages(["mine"]))
    write(folder, {"mine.py": "A = 22\n"})
    assert run.changed_sources == ["mine:mine.py"]
    assert "mine" not in sys.modules
    (folder / "mine.py").unlink()
    importlib.invalidate_caches()
    assert run.changed_sources == []  # nobody knows
