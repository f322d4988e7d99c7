"""Messages of one line."""

import pytest
import yaml

from memmlp.common.errors import InputError, describe_read_error, import_optional


def test_a_message_is_one_line_whatever_is_in_it():
    assert str(InputError("a\nb\r\x1b[2J\u2028\udcff.npz: bad")) == r"a\nb\r\x1b[2J\u2028\udcff.npz: bad"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: [1\nb: 2", "line 2, column 2: expected"),
        ("a: \x00", "special characters are not allowed in it, position 3"),
    ],
)
def test_what_is_no_yaml_is_told_by_line_and_column(text: str, words: str):
    with pytest.raises(yaml.YAMLError) as error:
        yaml.safe_load(text)
    assert words in describe_read_error(error.value)
    assert "<unicode string>" not in describe_read_error(error.value)


def test_a_missing_package_is_named_with_its_extra():
    assert import_optional("json.decoder", "plots", "--figure").JSONDecoder
    with pytest.raises(InputError, match=r"--figure: needs nowhere: pip install 'memmlp\[plots\]'"):
        import_optional("nowhere.at.all", "plots", "--figure")
