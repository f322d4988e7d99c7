"""An override is split once, and everything else reads its parts."""

import pytest

from memmlp.common.overrides import Override, flatten, notify_repeats, select_last_by_key
from memmlp.common.progress import print_announcements


@pytest.mark.parametrize(("text", "parts"), [
    ("optim.lr=1e-3", ("", "optim.lr", "1e-3", "optim")), ("++term=a=b", ("++", "term", "a=b", "term")),
    ("~loss.hand", ("~", "loss.hand", None, "loss")), ("seed=", ("", "seed", "", "seed")),
])  # fmt: skip
def test_the_parts_of_an_override(text: str, parts: tuple[str, str, str | None, str]):
    override = Override.parse(text)
    assert (override.signs, override.key, override.value, override.group) == parts
    assert str(override) == text


@pytest.mark.parametrize(
    ("text", "options"),
    [("a=x", ["x"]), ("a=[x, 'y']", ["x", "y"]), ("a=null", []), ("a=", []), ("~a", []), ("a=[]", [])],
)
def test_the_options_that_an_override_names(text: str, options: list[str]):
    assert Override.parse(text).options == options


def test_the_last_override_of_a_key_wins_at_the_first_ones_place():
    assert [str(one) for one in select_last_by_key(["a=1", "b=2", "+a=3"]).values()] == ["+a=3", "b=2"]


def test_only_mappings_are_flattened():
    assert flatten({"a": {"b": [{"c": 1}], "d": {}}, "e": None}) == {"a.b": [{"c": 1}], "a.d": {}, "e": None}


def test_an_override_that_replaces_another_one_is_announced(capsys: pytest.CaptureFixture[str]):
    with print_announcements():
        notify_repeats(["a=1", "b=1", "a=1", "a.b=2", "~c", "+a=2", "a=3"])
    assert capsys.readouterr().err.splitlines() == ["+a=2 replaces a=1", "a=3 replaces +a=2"]
