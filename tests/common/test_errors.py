"""Messages of one line."""

import pytest
import yaml

from memmlp.common.errors import InputError, describe_read_error, import_optional


def test_messages_are_one_line_and_name_a_missing_package_s_extra():
    assert str(InputError("a\nb\r\x1b[2J\u2028\udcff.npz: bad")) == r"a\nb\r\x1b[2J\u2028\udcff.npz: bad"
    assert import_optional("json.decoder", "plots", "--figure").JSONDecoder
    with pytest.raises(InputError, match=r"--figure: needs nowhere: pip install 'memmlp\[plots\]'"):
        import_optional("nowhere.at.all", "plots", "--figure")


@pytest.mark.parametrize(("text", "words"), [
    ("a: [1\nb: 2", "line 2, column 2: expected"),
    ("a: \x00", "special characters are not allowed in it, position 3"),
])  # fmt: skip
def test_what_is_no_yaml_is_told_by_line_and_column(text: str, words: str):
    with pytest.raises(yaml.YAMLError) as error:
        yaml.safe_load(text)
    assert words in describe_read_error(error.value)
    assert "<unicode string>" not in describe_read_error(error.value)
