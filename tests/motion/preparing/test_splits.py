"""Splits: seeded, by group, by published lists, by subset."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import pytest

from memmlp.common.errors import InputError
from memmlp.motion.preparing.amass_names import S2_TEST, S2_TRAIN
from memmlp.motion.preparing.splits import ListSplit, SeededSplit, SubsetSplit

NAMES = [f"salsa/{n:02}" for n in range(1, 31)] + [f"martial/{n:02}" for n in range(1, 11)]
TWINS = [rf"salsa/(?:{n:02}|{n + 15:02})$" for n in range(1, 16)]


def seeded(test: float, val: float, seed: int, groups: Sequence[str] = (), **more: Any) -> SeededSplit:
    return SeededSplit(test=test, val=val, seed=seed, groups=groups, **more)


def part(parts, name):
    return {clip for clip, found in parts.items() if found == name}


def test_seeded_is_a_partition_whatever_the_order():
    split = seeded(0.2, 0.1, 3)
    parts = split.assign(NAMES).parts
    assert set(parts) == set(NAMES)
    assert split.assign(NAMES[::-1]).parts == parts
    counts = [list(parts.values()).count(part) for part in ("train", "val", "test")]
    assert counts == [28, 4, 8]
    assert seeded(0.2, 0.1, 4).assign(NAMES).parts != parts


def test_groups_and_subjects_within_archives_stay_together():
    names = [f"CMU/{subject:02}/{subject:02}_0{take}_poses" for subject in range(20) for take in range(3)]
    split = seeded(0.2, 0.2, 1, ["^([^/]+/[^/]+)/"])
    expected = split.assign(names).parts
    for write in (in_archives, "archive-1/{}".format):
        assert split.assign([*map(write, names)]).parts == {write(a): part for a, part in expected.items()}
    for seed in range(5):
        parts = seeded(0.2, 0.2, seed, TWINS).assign(NAMES).parts
        assert all(parts[f"salsa/{n:02}"] == parts[f"salsa/{n + 15:02}"] for n in range(1, 16))
        folders = seeded(0.5, 0.0, seed, ["^([^/]+)/"]).assign(NAMES).parts
        assert len({folders[name] for name in NAMES if name.startswith("salsa")}) == 1
    assert seeded(0.2, 0.2, 0, TWINS).assign(NAMES).parts != seeded(0.2, 0.2, 0).assign(NAMES).parts


def test_a_fraction_of_the_training_groups():
    """It leaves validation and test as they are, and is part of a larger one; no group is divided."""
    whole = seeded(0.2, 0.2, 1, TWINS).assign(NAMES).parts
    before = part(whole, "train")
    for fraction in (0.75, 0.5, 0.25):
        fewer = seeded(0.2, 0.2, 1, TWINS, train_fraction=fraction).assign(NAMES).parts
        assert all(part(fewer, name) == part(whole, name) for name in ("val", "test"))
        used = part(fewer, "train")
        assert used < before
        assert part(fewer, None) == part(whole, "train") - used
        assert all((f"salsa/{n:02}" in used) == (f"salsa/{n + 15:02}" in used) for n in range(1, 16))
        before = used
    groups = {(int(name[-2:]) - 1) % 15 if "salsa" in name else name for name in used}
    assert len(groups) == round(0.25 * 15)
    assert part(seeded(0.2, 0.2, 1, train_fraction=1e-9).assign(NAMES).parts, "train")


def test_no_more_than_some_clips_of_a_group_are_held_out():
    """Nothing else changes, fewer are part of more, and clips that nothing ties are groups of one."""
    whole = seeded(0.3, 0.3, 1, TWINS).assign(NAMES)
    before = whole.parts
    for most in (2, 1):
        found = seeded(0.3, 0.3, 1, TWINS, per_group=most).assign(NAMES)
        assert found.groups == whole.groups
        assert part(found.parts, "train") == part(whole.parts, "train")
        for name in ("val", "test"):
            held_out = part(found.parts, name)
            assert held_out <= part(before, name)
            assert max(Counter(found.groups[clip] for clip in held_out).values()) == most
            groups = [{whole.groups[clip] for clip in clips} for clips in (held_out, part(whole.parts, name))]
            assert groups[0] == groups[1]
        before = found.parts
    assert "per_group" not in SeededSplit().describe()
    assert SeededSplit(per_group=2).describe()["per_group"] == 2


def test_lists_in_agrols_format(tmp_path):
    (tmp_path / "CMU").mkdir()
    lines = [f"./CMU/01/{n}_poses.npz" for n in range(8)] + ["amass/CMU/gone_poses.npz", ""]
    (tmp_path / "CMU" / "train_split.txt").write_text("\r\n".join(lines))
    test = tmp_path / "CMU" / "test_split.txt"
    test.write_text("CMU/02/1_poses.npz\n")
    names = [*(f"CMU/01/{n}_poses" for n in range(8)), "CMU/02/1_poses", "CMU/03/unlisted_poses"]
    found = ListSplit(tmp_path, val=0.25).assign(names).parts
    assert (found["CMU/02/1_poses"], found["CMU/03/unlisted_poses"]) == ("test", None)
    assert [len(part(found, name)) for name in ("val", "train")] == [2, 6]
    test.write_text("CMU/01/1_poses.npz\n")
    with pytest.raises(InputError, match="CMU/01/1_poses"):
        ListSplit(tmp_path)
    test.unlink()  # half of a subset's lists would pass for the protocol; an empty one says that it is meant
    with pytest.raises(InputError, match=r"CMU lacks test_split.txt"):
        ListSplit(tmp_path)
    test.write_text("")
    assert ListSplit(tmp_path).entry_counts == {"CMU": 9}
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "CMU").symlink_to(tmp_path / "CMU")
    assert ListSplit(tmp_path / "linked").entry_counts == {"CMU": 9}


def test_subsets_by_folder_under_every_name_but_once():
    names = [f"{subset}/{n}" for subset in (*S2_TRAIN, *S2_TEST, "DanceDB") for n in range(4)]
    parts = SubsetSplit(S2_TRAIN, S2_TEST, val=0.1).assign(names).parts
    assert {name.split("/")[0] for name in part(parts, "test")} == set(S2_TEST)
    assert all(parts[f"DanceDB/{n}"] is None for n in range(4))
    assert "val" in parts.values()
    lower = SubsetSplit(S2_TRAIN, S2_TEST).assign(["cmu/1", "cmu/2", "cmu/3", "humaneva/1"]).parts
    assert lower["humaneva/1"] == "test"
    split = SubsetSplit(["BioMotionLab_NTroje", "CMU"], ["MPI_HDM05"], groups=["^([^/]+/[^/]+)/"])
    for write in (renamed, stage_two, in_archives, str.lower):
        found = split.assign([write(name) for name in OLD])
        assert None not in found.parts.values()
        assert len(set(found.groups.values())) == 6
    assert split.find_missing_entries(OLD[:8]) == ("CMU", "MPI_HDM05")
    with pytest.raises(InputError, match=r"data\.root"):
        split.assign([*OLD, stage_two(OLD[0])])


def test_bad_fractions_patterns_lists_and_subsets(tmp_path):
    for bad in ({"val": 1.0}, {"test": 0.6, "val": 0.5}, {"train_fraction": 0.0}):
        with pytest.raises(InputError, match=r"data\.split"):
            SeededSplit(**bad)
    with pytest.raises(InputError, match=r"data\.split\.groups"):
        SeededSplit(groups=["("]).assign(NAMES)
    with pytest.raises(InputError, match="none"):
        ListSplit(tmp_path / "none")
    with pytest.raises(InputError, match=r"data\.split"):
        SubsetSplit(["CMU"], ["cmu"])


OLD = [
    *(f"BioMotionLab_NTroje/rub00{n}/000{m}_treadmill norm_poses" for n in range(4) for m in range(2)),
    *(f"CMU/18_19_Justin/{n}_0{m}_poses" for n in (18, 19) for m in range(2)),
    *(f"MPI_HDM05/dg/HDM_dg_01-01_0{m}_120_poses" for m in range(3)),
]


def renamed(name: str) -> str:
    return name.replace("BioMotionLab_NTroje", "BMLrub").replace("MPI_HDM05", "HDM05")


def stage_two(name: str) -> str:
    return renamed(name).replace("_poses", "_stageii").replace(" ", "_")


def in_archives(name: str) -> str:
    return f"{renamed(name).split('/')[0]}/{name}"


def write_lists(folder, names=OLD):
    for number, name in enumerate(names):
        lists = folder / name.split("/")[0]
        lists.mkdir(parents=True, exist_ok=True)
        for phase in ("train", "test"):
            (lists / f"{phase}_split.txt").touch()
        with open(lists / f"{'test' if number % 4 == 3 else 'train'}_split.txt", "a") as file:
            file.write(f"{name}.npz\n")
    return folder


@pytest.mark.parametrize("write", [stage_two, in_archives, str.upper])
def test_lists_divide_every_release_of_amass_alike(tmp_path, write):
    split = ListSplit(write_lists(tmp_path), val=0.3, groups=["^([^/]+/[^/]+)/"])
    other = "BMLrub/rub009/other_stageii"
    expected, found = split.assign(OLD), split.assign([*map(write, OLD), other])
    assert set(expected.parts.values()) == {"train", "val", "test"}
    assert found.parts == {write(name): part for name, part in expected.parts.items()} | {other: None}
    same = {write(name): write(group) for name, group in expected.groups.items()}
    assert {name: found.groups[name] for name in same} == same


def test_a_column_file_ties_clips_beside_patterns(tmp_path):
    file = tmp_path / "groups.csv"
    rows = {name: name.split("/")[0] for name in NAMES if name.startswith("martial")}
    file.write_text("clip,group\n" + "".join(f"{n}.npz,{rows.get(n, n)}\n" for n in NAMES))
    split, bare = seeded(0.3, 0.1, 0, TWINS, groups_file=file), seeded(0.3, 0.1, 0, TWINS)
    found = split.assign(NAMES)
    assert {found.groups[name] for name in rows} == {"martial"}
    assert len({found.parts[name] for name in rows}) == 1
    assert all(found.parts[f"salsa/{n:02}"] == found.parts[f"salsa/{n + 15:02}"] for n in range(1, 16))
    assert found.parts != bare.assign(NAMES).parts
    file.write_text(file.read_text().replace("martial\n", "other\n"))
    changed = seeded(0.3, 0.1, 0, TWINS, groups_file=file)
    assert len({str(one.describe()) for one in (split, bare, changed)}) == 3
