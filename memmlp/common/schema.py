"""Parses JSON and YAML of unknown origin, and checks values against types. Such a file may be hostile, so its
size, depth and aliases are bounded before its content is expanded."""

import functools
import json
import math
import re
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

import yaml

try:
    from yaml import CSafeLoader as SafeLoader  # six times as fast
except ImportError:
    from yaml import SafeLoader  # type: ignore[assignment]

MAX_DEPTH = 32  # nested lists and mappings
MAX_ITEMS = 100_000  # of a list or mapping
MAX_INT = 2**63
SURROGATE = re.compile("[\ud800-\udfff]")
NAMES = {
    str: "text", float: "a number", int: "a whole number", bool: "true or false", NoneType: "null",
    dict: "a mapping", list: "a list",
}  # fmt: skip


def parse_json(content: str | bytes) -> Any:
    """Parse JSON. Raises ValueError for other content and for values that `check_plain` refuses."""
    try:
        value = json.loads(content)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    check_plain(value)
    return value


def load_yaml(text: str, loader: Any, aliases: bool = True) -> Any:
    """Return the content of a YAML text. Raises YAMLError, also if it is nested too deeply."""
    if SURROGATE.search(text):
        raise yaml.YAMLError("has text with a lone surrogate")
    depth = 0
    for event in yaml.parse(text, SafeLoader):  # before `load`: C code crashes on deep nesting
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH or (isinstance(event, yaml.AliasEvent) and not aliases):
            raise yaml.YAMLError("has an alias, or is nested too deeply")
    return yaml.load(text, loader)


def parse_yaml(text: str) -> Any:
    """Parse YAML without aliases. Raises ValueError like `parse_json`."""
    try:
        value = load_yaml(text, SafeLoader, aliases=False)
    except (yaml.YAMLError, OverflowError) as error:
        raise ValueError(str(error).splitlines()[0]) from None
    check_plain(value)
    return value


def check_plain(value: Any, depth: int = MAX_DEPTH) -> None:
    """Raise ValueError unless a list or mapping is a tree of JSON values with finite 64-bit numbers."""
    if not isinstance(value, dict | list) or not depth:
        raise ValueError(f"has a {type(value).__name__}" if depth else "nested too deeply")
    if len(value) > MAX_ITEMS:
        raise ValueError(f"has a list or mapping with more than {MAX_ITEMS} items")
    if isinstance(value, dict) and not all(isinstance(key, str) for key in value):
        raise ValueError("has a key that is not text")
    for item in (*value, *value.values()) if isinstance(value, dict) else value:
        kind = type(item)
        if kind is str:
            if not item.isascii() and SURROGATE.search(item):
                raise ValueError("has text with a lone surrogate")
        elif kind is int or kind is float:
            if not (abs(item) < MAX_INT if kind is int else math.isfinite(item)):
                raise ValueError("has a number that is not finite or too large")
        elif item is not None and kind is not bool:
            check_plain(item, depth - 1)


@functools.cache
def _get_fields(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


@functools.cache
def _get_parts(kind: Any) -> tuple[Any, tuple[Any, ...], tuple[Any, ...]]:
    """Return a type's origin and arguments, and the classes whose values need no further check."""
    origin, args = get_origin(kind), get_args(kind)
    return origin, args, args if origin in (Union, UnionType) else (kind,)


def check_type(value: Any, kind: Any, key: str = "") -> None:
    """Raise ValueError if the value of a dotted key does not have a type: a scalar, list[X], dict[str, X], X
    | Y, Literal, TypedDict, Any, or Annotated[X, PREDICATE]."""
    origin, args, plain = _get_parts(kind)
    if type(value) in plain:
        return
    if origin in (Union, UnionType):
        others = [one for one in args if one is not NoneType]
        for one in others[:-1]:
            try:
                return check_type(value, one, key)
            except ValueError:
                continue
        check_type(value, others[-1], key)
    elif origin is Annotated:
        check_type(value, args[0], key)
        if not args[1](value):
            raise ValueError(f"{key} must be valid, but is {str(value)[:40]!r}")
    elif origin is Literal:
        if value not in args:
            raise ValueError(f"{key} must be {' or '.join(map(str, args))}")
    elif is_typeddict(kind):
        _check_class(value, dict, key)
        if missing := sorted(kind.__required_keys__ - value.keys()):
            raise ValueError(f"{key or 'the file'} must have the key {missing[0]}")
        for name, one in _get_fields(kind).items():
            if name in value:
                check_type(value[name], one, f"{key}.{name}".lstrip("."))
    elif origin in (dict, list):
        _check_class(value, origin, key)
        items: Any = value.items() if origin is dict else enumerate(value)
        plain = _get_parts(args[-1])[2]
        for name, item in items:
            if type(item) not in plain:
                check_type(item, args[-1], f"{key}.{name}".lstrip("."))
        for name in value if origin is dict and args[0] is not str else ():
            check_type(name, args[0], key)
    elif kind is not Any:
        _check_class(value, kind, key)


def _check_class(value: Any, kind: type, key: str) -> None:
    classes = (int, float) if kind is float else (kind,)
    if not isinstance(value, classes) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{key or 'the file'} must be {NAMES[kind]}")


class PlainYaml(SafeLoader):
    """A safe YAML loader that rejects duplicate keys and reads scalars like Hydra's command line. Numbers,
    true, false and null have types. Everything else is the text as written, such as off, 010, 12:30 and
    1_000. Keys, and values of the keys in `TEXTS`, are always text. PyYAML's own rules are YAML 1.1's."""

    TEXTS = ("control", "against")
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping. Raises ConstructorError for a duplicate key, or one that is not a scalar."""
        seen = set()
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue  # the base class raises an error
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


def parse_config_yaml(text: str) -> Any:
    """Return the content of a YAML text; see `PlainYaml`. Raises YAMLError."""
    return load_yaml(text, PlainYaml)
