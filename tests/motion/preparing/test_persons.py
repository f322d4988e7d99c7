"""Splits by person: nobody of validation or test is in training."""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Memmlp

from memmlp.common.errors import InputError
from memmlp.config.build_request import build_request
from memmlp.config.compose import compose_config
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.motion_source import MotionSource
from memmlp.motion.preparing.persons import Kind, PersonSplit
from memmlp.motion.preparing.splits import Split

DATA = Path(__file__).parents[4] / "shared" / "data"
DAZ = ("01", "02", "03", "05", "07", "08", "09", "10", "11", "13", "14")  # its subjects
PARTS = ("train", "val", "test")
KINDS = {"walking": Kind(("a1", "a2", "a3"), 1, 1), "dance": Kind(("b1", "b2"), 1, 0)}


def split(**changes: Any) -> PersonSplit:
    settings: dict[str, Any] = {"persons": {r"^old/": None, r"^(\w+)/": r"\1"}, "kinds": KINDS}
    return PersonSplit(**settings | changes)


@pytest.fixture
def shipped(tmp_path: Path) -> MotionSource:
    (tmp_path / "clips").mkdir()
    outputs = f"paths.outputs={tmp_path / 'outputs'}"
    return build_request(compose_config(["data=persons", f"data.root={tmp_path / 'clips'}", outputs])).motion


def compose_split(data: str, root: Path) -> Split:
    return build_request(compose_config([f"data={data}", f"data.root={root}"])).motion.clips.split


def members(persons: Iterable[str]) -> list[str]:
    """Names of clips in which the shipped patterns see these persons."""
    names = []
    for person in persons:
        first, _, rest = person.partition("-")
        names += [f"cmu-daz/{rest}/{rest}_02"] if first == "cmu" else [f"hdm05-asfamc/{rest}/HDM_{rest}_x"]
    return [*names, "cmu-asfamc/38/38_01", "cmu-asfamc/39/39_01", "cmu/salsa/01", "cmu/salsa/16"]


def assert_nobody_in_two_parts(clips: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """Check the persons and parts of clips; return the persons of each part."""
    parts: dict[str, set[str]] = defaultdict(set)
    for person, part in clips:
        parts[part].add(person)
    assert sum(map(len, parts.values())) == len(set().union(*parts.values()))
    assert len(parts["test"]) >= 8
    assert len(parts["val"]) >= 5
    return parts


def test_persons_of_a_kind_are_held_out_in_a_seeded_order():
    names = [f"{person}/{take}" for person in ("a1", "a2", "a3", "b1", "b2", "c1") for take in "xy"]
    drawn = set()
    for seed in range(6):
        found = split(seed=seed).assign([*names, "old/a1"])
        assert found.parts["old/a1"] is None
        assert {found.groups[name] for name in names} == {name.split("/")[0] for name in names}
        persons = {part: {found.groups[n] for n in names if found.parts[n] == part} for part in PARTS}
        assert "c1" in persons["train"] - persons["test"] - persons["val"]
        assert [len(persons["test"] & set(kind.persons)) for kind in KINDS.values()] == [1, 1]
        assert [len(persons["val"] & set(kind.persons)) for kind in KINDS.values()] == [1, 0]
        assert split(seed=seed).assign(names[::-1]).parts == split(seed=seed).assign(names).parts
        drawn.add(frozenset(persons["test"]))
    assert len(drawn) > 1


def test_absent_persons_are_missing_and_clips_of_nobody_refused():
    assert split().entry_counts == {"walking": 3, "dance": 2}
    assert split().find_missing_entries(["a1/x", "a3/y", "b1/x", "b2/x", "c/x"]) == ("walking/a2",)
    with pytest.raises(InputError, match=r"data\.split\.persons: no pattern matches \?\?\?/x"):
        split().assign(["a1/x", "???/x"])


def test_the_shipped_persons_are_in_one_part_of_the_manifest(shipped: MotionSource, memmlp: Memmlp):
    """Clips of all persons of the config are prepared; one take is left out, a conversion."""
    by_rule = shipped.clips.split
    assert isinstance(by_rule, PersonSplit)
    names = [*members(by_rule.parts.keys() - {"cmu-05", "cmu-60-61", "cmu-indian", "cmu-135"})]
    names += ["cmu-asfamc/05/05_01", "cmu-daz/05/05_01", "cmu/indian/04", "cmu/martial/03"]
    names += ["bandai-1/dataset-1_walk_sad_001", "cmu-daz/03/03_01"]
    random = np.random.default_rng(0)
    for name in names:
        poses = 0.1 * np.cumsum(random.normal(size=(60, 22, 3)), 0)
        clip = Clip(name, poses, 0.01 * np.cumsum(random.normal(size=(60, 3)), 0), 60.0)
        write_clip(Path(str(shipped.clips.root)) / f"{name}.npz", clip)
    manifest = shipped.prepare().manifest
    parts = assert_nobody_in_two_parts((clip.group, clip.split) for clip in manifest.clips)
    assert {clip.name for clip in manifest.clips} == set(names) - {"cmu-daz/05/05_01"}
    assert manifest.groups["cmu-asfamc/38/38_01"] == manifest.groups["cmu-daz/07/07_02"] == "cmu-07"
    assert manifest.groups["cmu/salsa/01"] == manifest.groups["cmu/salsa/16"]
    assert {"bandai", "cmu-03"} <= parts["train"]
    for kind in by_rule.kinds.values():
        assert {by_rule.parts[person] for person in kind.persons} == set(PARTS)
    shown = memmlp("data", "inspect", str(shipped.cache)).out
    for person in set(manifest.groups.values()):
        assert re.search(rf"(train|val|test) .* {person} ", shown), shown
    (Path(str(shipped.clips.root)) / "hdm05-asfamc" / "bk" / "HDM_bk_x.npz").unlink()
    with pytest.raises(InputError, match=r"1 of 22 entries .* \(hdm05 1 of 4\); data\.partial=true"):
        shipped.prepare()


def test_the_cmu_persons_are_in_the_same_parts_alone(tmp_path: Path):
    """Networks that ship are trained on CMU's sets, whose terms allow it."""
    alone, mixed = compose_split("cmu_persons", tmp_path), compose_split("persons", tmp_path)
    assert isinstance(alone, PersonSplit)
    assert isinstance(mixed, PersonSplit)
    assert alone.parts == {person: part for person, part in mixed.parts.items() if person.startswith("cmu-")}
    names = [*members(mixed.parts.keys() - {"cmu-60-61", "cmu-indian"}), "cmu-motionbuilder/05/05_01"]
    names += ["cmu-asfamc/05/05_01", "cmu/indian/04", "bandai-1/dataset-1_walk_sad_001"]
    expected = {name: part if name[:3] == "cmu" else None for name, part in mixed.assign(names).parts.items()}
    assert alone.assign(names).parts == expected


def test_the_takes_of_s1_are_in_their_lists_part(tmp_path: Path):
    split = compose_split("cmu_s1", tmp_path)
    parts = {
        "test": ["cmu-asfamc/05/05_04", "cmu-daz/07/07_08", "cmu-asfamc/16/16_34", "cmu-asfamc/35/35_29"],
        "train": ["cmu-asfamc/05/05_05", "cmu-daz/08/08_02", "cmu-asfamc/16/16_35", "cmu-3dsmax/131/131_01"],
        None: ["cmu-daz/05/05_04", "cmu-asfamc/16/16_01", "cmu-daz/14/14_31", "cmu/salsa/01", "x/HDM_bd_1"],
    }
    found = split.assign([name for names in parts.values() for name in names])
    assert found.parts == {name: part for part, names in parts.items() for name in names}
    assert split.entry_counts == {"test": 17}


@pytest.mark.slow
def test_the_takes_of_s1_are_as_many_as_in_the_lists(tmp_path: Path, database: Callable[[str], Path]):
    names = [f"cmu-asfamc/05/{take.stem}" for take in database("cmu-asfamc").rglob("*.amc")]
    parts = compose_split("cmu_s1", tmp_path).assign(names).parts
    assert Counter(parts.values()) == {"train": 77, "test": 9, None: 56}


@pytest.mark.slow
def test_the_real_sets_persons_are_in_one_part(shipped: MotionSource, database: Callable[[str], Path]):
    """Takes by the archives and READMEs: unpacking the DAZ conversion takes half a minute."""
    folders = [database(name) for name in ("cmu-asfamc", "hdm05-asfamc")]
    takes = [take.relative_to(folder) for folder in (*folders, DATA) for take in folder.rglob("*.*")]
    names = [take.with_suffix("").as_posix() for take in takes if take.suffix in (".amc", ".bvh")]
    assert len(names) == 37 + 142 + 233
    names += [f"cmu-daz/{person}/{person}_{take:02}" for person in DAZ for take in range(1, 41)]
    names += [f"cmu-3dsmax/131/131_{take}" for take in ("01", "02", "03")]
    found = shipped.clips.split.assign(names)
    used = [name for name in names if found.parts[name]]
    # Heads upside down, takes in another conversion, elbows about a wrong axis, floors.
    assert len(names) - len(used) == 2 + 40 + 3 + 2
    assert shipped.clips.split.find_missing_entries(used) == ()
    assert_nobody_in_two_parts((found.groups[name], str(found.parts[name])) for name in used)
