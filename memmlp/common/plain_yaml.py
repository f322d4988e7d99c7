"""Reads YAML files of users without the surprises of YAML 1.1."""

from __future__ import annotations

import re
from typing import Any

import yaml


class PlainYaml(yaml.SafeLoader):
    """A safe YAML loader that rejects duplicate keys and reads scalars like Hydra's command line. Numbers,
    true, false and null have types. Everything else is the text as written, such as off, 010, 12:30 and
    1_000. Keys, and values of the keys in `TEXTS`, are always text. PyYAML's own rules are YAML 1.1's."""

    TEXTS = ("control", "against")
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping. Raises ConstructorError for a duplicate key."""
        seen = set()
        for key, value in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"duplicate key '{key.value}'", key.start_mark
                )
            seen.add(key.value)
            for text in (key, value) if key.value in self.TEXTS else (key,):
                if isinstance(text, yaml.ScalarNode) and not text.tag.endswith(("null", "merge")):
                    text.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep)


for _tag, _pattern, _first in (
    ("bool", r"true|false|True|False|TRUE|FALSE", "tTfF"),
    ("int", r"[-+]?(?:0|[1-9][0-9]*)", "-+0123456789"),
    ("float", r"[-+]?(?:(?:0|[1-9][0-9]*)(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?", "-+.0123456789"),
    ("float", r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", "-+."),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("merge", r"<<", "<"),
):
    PlainYaml.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), list(_first))


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML text; see `PlainYaml`. Raises YAMLError."""
    return yaml.load(text, PlainYaml)
