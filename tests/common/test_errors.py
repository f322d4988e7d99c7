"""Messages of one line."""

from memmlp.common.errors import InputError, one_line


def test_a_message_is_one_line_whatever_is_in_it():
    assert str(InputError("a\nb\r\x1b[2J\u2028\udcff.npz: bad")) == r"a\nb\r\x1b[2J\u2028\udcff.npz: bad"


def test_words_stay_as_they_are():
    assert one_line("Läufer/走る\u3000\xa0.npz \\n") == "Läufer/走る\u3000\xa0.npz \\n"
