import pytest
import yaml

from memmlp.common.schema import parse_config_yaml


def test_values_are_those_of_the_command_line():
    content = parse_config_yaml(
        "{a: [off, on, 010, 12:30, 1_000, 2024-01-01, 0x10, 'true'], b: [1e-3, 5, -.5, true, null, ~]}"
    )
    assert content["a"] == ["off", "on", "010", "12:30", "1_000", "2024-01-01", "0x10", "true"]
    assert content["b"] == [0.001, 5, -0.5, True, None, None]
    with pytest.raises(yaml.YAMLError, match="nested too deeply"):
        parse_config_yaml("[" * 5000)
    for text in ("{[a]: 1}", "{{}: 1}"):
        with pytest.raises(yaml.YAMLError, match="unhashable key"):
            parse_config_yaml(text)


def test_labels_are_text_as_written():
    content = parse_config_yaml("{off: 1, 010: 2, 12:30: 3, 1.50: 4, true: 5, control: 1.50, against: null}")
    assert [*content] == ["off", "010", "12:30", "1.50", "true", "control", "against"]
    assert (content["control"], content["against"]) == ("1.50", None)
