"""The data of a config: one folder, a list of them, named sources."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

from memmlp.common.components import collect_components, find_component
from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment
from memmlp.config.build_request import build_request
from memmlp.config.compose import compose_config
from memmlp.config.schema import restore_config
from memmlp.motion.preparing.find_clips import NamedFolders
from memmlp.motion.preparing.splits import MixedSplit, SeededSplit

MIX = {
    "defaults": ["mocap", {"grouping@sources.bandai": "bandai_namco"}, "_self_"], "name": "my_mix",
    "root": None, "sources": {"cmu": {"root": "a", "weight": 2}, "bandai": {"root": "b", "weight": 1}},
}  # fmt: skip


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for folder in ("a", "b", "x/a", "conf/data"):
        (tmp_path / folder).mkdir(parents=True)
    return tmp_path


def mix(changes: dict | None = None, *words: str):
    Path("conf/data/my_mix.yaml").write_text(yaml.safe_dump(MIX | (changes or {})))
    return compose_config(["--config-dir", "conf", "data=my_mix", *words])


def motion_of(cfg: DictConfig):
    return build_request(cfg).motion


def with_source(**keys) -> dict:
    return {"sources": {**MIX["sources"], "cmu": {**MIX["sources"]["cmu"], **keys}}}


def test_a_list_of_folders_names_sources_after_them():
    one, listed = (motion_of(compose_config(["data=mocap", f"data.root={root}"])) for root in ("a", "[a]"))
    assert one == listed
    assert isinstance(one.clips.split, SeededSplit)
    source = motion_of(compose_config(["data=mocap", "data.root=[b,a]", "data.split.test=0.2"])).clips
    assert source.root == NamedFolders({"b": Path("b"), "a": Path("a")})
    assert isinstance(source.split, MixedSplit)
    assert {split.test for split in source.split.splits.values()} == {0.2}
    with pytest.raises(InputError, match=r"data\.root"):
        motion_of(compose_config(["data=mocap", "data.root=[a,x/a]"]))
    with pytest.raises(InputError, match=r"nowhere: no such folder"):
        compose_config(["data=mocap", "data.root=[a,nowhere]"])


def test_named_sources_have_fractions_of_their_own():
    split = motion_of(mix(with_source(test=0.35), "data.split.val=0.05")).clips.split
    assert isinstance(split, MixedSplit)
    held_out = {name: (own.test, own.val) for name, own in split.splits.items()}
    assert held_out == {"cmu": (0.35, 0.05), "bandai": (0.1, 0.05)}
    with pytest.raises(InputError, match=r"data\.sources\.cmu: .*data\.split\.val"):
        motion_of(mix(with_source(val=0.95)))


def test_named_sources_have_groups_of_their_own():
    split = motion_of(mix(None, "data.split.val=0.2")).clips.split
    assert split.splits["cmu"].groups[0] == "salsa/(?:01|16)$"
    (last,) = set(split.splits["bandai"].groups) - set(split.splits["cmu"].groups)
    kinds = [(d, style, n) for d in (1, 2) for style in ("sad", "old") for n in (1, 2)]
    names = [f"dataset-{d}_walk-left_{style}_00{n}" for d, style, n in kinds]
    groups = SeededSplit(groups=[last]).assign([*names, "other"]).groups
    assert {name: groups[name] for name in names} == {
        name: f"dataset-1_walk-left_{name.split('_')[2]}_001" for name in names
    }
    Path("groups.csv").write_text("clip,group\nsalsa/01,ann\n")
    own = motion_of(mix(with_source(groups_file="groups.csv")))
    assert own.clips.split.splits["cmu"].grouping.rows == {"salsa/01": "ann"}
    assert own.groups_digest != motion_of(mix()).groups_digest


@pytest.mark.parametrize(("changes", "words", "said"), [
    ({"sources": {}}, [], "data.sources.bandai.root: has no value"),
    ({"root": "a"}, [], "data.root=a"),
    ({"sources": {**MIX["sources"], "c/d": {"root": "a"}}}, [], "data.sources.c/d"),
    ({"sources": {**MIX["sources"], "other": {"root": "a"}}}, [], "data.sources: expected a weight"),
    (with_source(root="nowhere"), [], "data.sources.cmu.root=nowhere"),
    (with_source(weigt=3), [], "data.sources.cmu.weigt: no such key; did you mean weight"),
    ({}, ["data.split.groups_file=conf/data/my_mix.yaml"], "data.sources.NAME.groups_file"),
])  # fmt: skip
def test_what_does_not_go_together_is_one_line(changes, words, said):
    with pytest.raises(InputError, match="data") as error:
        mix(changes, *words)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"data.root=None: must be a folder or a list"):
        compose_config(["data=mocap", "data.root=null"])


def test_weights_are_drawn_by_and_enter_the_identity_where_there_are_any():
    def identity(cfg):
        return build_experiment(cfg).identity("0" * 64).id

    weighted = mix()
    assert build_experiment(weighted).training.shares == {"cmu": 2, "bandai": 1}
    plain = {name: {"root": source["root"]} for name, source in MIX["sources"].items()}
    bare = mix({"sources": plain})
    assert build_experiment(bare).training.shares is None
    one = compose_config(["data=mocap", "data.root=a"])
    assert identity(bare) == identity(one)  # on the same data, whose digest knows the clips
    assert len({identity(cfg) for cfg in (weighted, bare, mix(None, "data.sources.cmu.weight=3"))}) == 3


def test_groups_count_for_a_training_that_draws_them():
    def identify(*words: str) -> str:
        cfg = compose_config(["data=mocap", "data.root=a", *words])
        return build_experiment(cfg).identity("0" * 64).id

    groups, drawn = "data.split.groups=['(a)']", "data.drawn_by=groups"
    assert identify() == identify(groups)
    assert len({identify(), identify(drawn), identify(drawn, groups)}) == 3
    persons = ["data=persons", "++data.split.persons.x=one"]
    assert identify("data=persons") == identify(*persons)
    assert identify("data=persons", drawn) != identify(*persons, drawn)
    own = mix(with_source(groups=["x"]), drawn), mix(None, drawn)
    assert len({build_experiment(cfg).identity("0" * 64).id for cfg in own}) == 2
    Path("groups.csv").write_text("clip,group\nsalsa/01,ann\n")
    with pytest.raises(InputError, match=r"data\.drawn_by=groups: .* groups_file"):
        identify(drawn, "data.split.groups_file=groups.csv")


def test_own_groups_and_column_files_enter_the_evaluation_alone():
    Path("groups.csv").write_text("clip,group\nsalsa/01,ann\n")
    every = [mix(), mix(with_source(groups=["x"])), mix(with_source(groups_file="groups.csv"))]
    experiments = [build_experiment(cfg) for cfg in every]
    assert len({experiment.evaluations["stream"] for experiment in experiments}) == 3
    assert len({experiment.identity("0" * 64).id for experiment in experiments}) == 1


def test_a_run_on_a_mix_is_restored():
    cfg = mix()
    record = OmegaConf.to_container(cfg, resolve=True)
    assert motion_of(restore_config(record)) == motion_of(cfg)


def test_another_version_of_a_generator_makes_other_motion(monkeypatch: pytest.MonkeyPatch):
    before = motion_of(compose_config(["profile=tiny"])).clips.root
    newer = replace(find_component("generator", "puppet"), version=7)
    monkeypatch.setitem(collect_components(), ("generator", "puppet"), newer)
    assert motion_of(compose_config(["profile=tiny"])).clips.root == before.with_name(f"{before.name}-v7")
