"""Column files of groups, and what is said where they don't fit the clips."""

import pytest

from memmlp.common.errors import InputError
from memmlp.motion.preparing.groups import Grouping, read_groups


def written(folder, text):
    file = folder / "groups.csv"
    file.write_text(text, encoding="utf-8")
    return file


def test_columns_in_any_order_with_others_beside_them(tmp_path):
    file = written(tmp_path, "\ufeffsession,group,clip\n1,ann,./a/1.npz\n2, ben ,b/2\n")
    assert read_groups(file) == {"a/1": "ann", "b/2": "ben"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("clip,subject\na,b\n", "no column group"),
        ("", "no column clip"),
        ("clip,group\na,1\nb,\n", "line 3 lacks"),
        ("clip,group\na\n", "line 2 lacks"),
        ("clip,group\na,1\na.npz,2\n", "line 3 gives a"),
    ],
)
def test_bad_files_in_one_line(tmp_path, text, said):
    with pytest.raises(InputError, match=said) as error:
        read_groups(written(tmp_path, text))
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="groups_file"):
        read_groups(tmp_path / "none.csv")


def test_clips_without_a_row_and_rows_without_a_clip_are_named(tmp_path):
    grouping = Grouping.of([], written(tmp_path, "clip,group\na,1\nb,1\nc,2\n"))
    grouping.check(["a", "b"], ["a", "b", "c"])  # c has a file that can't be used
    with pytest.raises(InputError, match="d and 1 more"):
        grouping.check(["a", "d", "e"], ["a", "b", "c", "d", "e"])
    with pytest.raises(InputError, match=r"data\.root.* c$"):
        grouping.check(["a", "b"], ["a", "b"])
    Grouping.of([], None).check(["a"], [])


def test_a_group_is_named_by_the_file_else_after_its_first_clip(tmp_path):
    rows = Grouping.of(["^(x)"], written(tmp_path, "clip,group\na,ann\nb,ann\nx1,ben\nx2,cy\n"))
    seen = {name: name for name in ("b", "a", "x2", "x1")}
    assert rows.names(seen) == {"a": "ann", "b": "ann", "x1": "ben", "x2": "ben"}
    assert Grouping.of(["^(x)"], None).names(seen) == {"a": "a", "b": "b", "x1": "x1", "x2": "x1"}
