"""Splits: seeded, by group, by published lists, by subset."""

import pytest

from memmlp.common.errors import InputError
from memmlp.motion.preparing.splits import S2_TEST, S2_TRAIN, ListSplit, SeededSplit, SubsetSplit

NAMES = [f"salsa/{n:02}" for n in range(1, 31)] + [f"martial/{n:02}" for n in range(1, 11)]
TWINS = [rf"salsa/(?:{n:02}|{n + 15:02})$" for n in range(1, 16)]


def test_seeded_is_a_partition_whatever_the_order():
    split = SeededSplit(test=0.2, val=0.1, seed=3)
    parts = split.assign(NAMES).parts
    assert set(parts) == set(NAMES)
    assert split.assign(NAMES[::-1]).parts == parts
    counts = [list(parts.values()).count(part) for part in ("train", "val", "test")]
    assert counts == [28, 4, 8]
    assert SeededSplit(0.2, 0.1, 4).assign(NAMES).parts != parts


def test_groups_stay_on_one_side():
    for seed in range(5):
        parts = SeededSplit(0.2, 0.2, seed, TWINS).assign(NAMES).parts
        assert all(parts[f"salsa/{n:02}"] == parts[f"salsa/{n + 15:02}"] for n in range(1, 16))
        folders = SeededSplit(0.5, 0.0, seed, ["^([^/]+)/"]).assign(NAMES).parts
        assert len({folders[name] for name in NAMES if name.startswith("salsa")}) == 1
    assert SeededSplit(0.2, 0.2, 0, TWINS).assign(NAMES).parts != SeededSplit(0.2, 0.2, 0).assign(NAMES).parts


def test_lists_in_agrols_format(tmp_path):
    (tmp_path / "CMU").mkdir()
    lines = [f"./CMU/01/{n}_poses.npz" for n in range(8)] + ["amass/CMU/gone_poses.npz", ""]
    (tmp_path / "CMU" / "train_split.txt").write_text("\r\n".join(lines))
    (tmp_path / "CMU" / "test_split.txt").write_text("CMU/02/1_poses.npz\n")
    names = [*(f"CMU/01/{n}_poses" for n in range(8)), "CMU/02/1_poses", "CMU/03/unlisted_poses"]
    found = ListSplit(tmp_path, val=0.25).assign(names)
    assert found.parts["CMU/02/1_poses"] == "test"
    assert found.parts["CMU/03/unlisted_poses"] is None
    assert list(found.parts.values()).count("val") == 2
    assert list(found.parts.values()).count("train") == 6
    assert len(found.missing) == 1
    (tmp_path / "CMU" / "test_split.txt").write_text("CMU/01/1_poses.npz\n")
    with pytest.raises(InputError, match="CMU/01/1_poses"):
        ListSplit(tmp_path)


def test_subsets_by_folder():
    names = [f"{subset}/{n}" for subset in (*S2_TRAIN, *S2_TEST, "DanceDB") for n in range(4)]
    parts = SubsetSplit(S2_TRAIN, S2_TEST, val=0.1).assign(names).parts
    assert {name.split("/")[0] for name, part in parts.items() if part == "test"} == set(S2_TEST)
    assert all(parts[f"DanceDB/{n}"] is None for n in range(4))
    assert "val" in parts.values()
    lower = SubsetSplit(S2_TRAIN, S2_TEST).assign(["cmu/1", "cmu/2", "cmu/3", "humaneva/1"]).parts
    assert lower["humaneva/1"] == "test"


@pytest.mark.parametrize(
    "bad", [{"test": -0.1}, {"val": 1.0}, {"test": 0.6, "val": 0.5}, {"test": float("nan")}]
)
def test_bad_fractions(bad):
    with pytest.raises(InputError, match="data"):
        SeededSplit(**bad)


def test_bad_patterns_lists_and_subsets(tmp_path):
    with pytest.raises(InputError):
        SeededSplit(groups=["("]).assign(NAMES)
    with pytest.raises(InputError):
        ListSplit(tmp_path / "none")
    with pytest.raises(InputError, match="both"):
        SubsetSplit(["CMU"], ["cmu"])
