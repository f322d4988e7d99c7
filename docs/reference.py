"""The reference pages, made from the code when the site is built: commands, config keys, Python modules.

Commands come from click, keys from conf/ (values and comments) and memmlp.config.schema (types and limits).
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import yaml
from omegaconf import MISSING

import memmlp
from memmlp.cli.main import COMMANDS, commands
from memmlp.config.package_data import packaged
from memmlp.config.schema import SCHEMAS

ROOT = Path(__file__).parent.parent
MARK = "<!-- made from the code by docs/reference.py -->\n\n"


def write(folder: Path) -> None:
    """Write all reference pages into a folder; pages that are as they should be are left alone."""
    pages = {"commands.md": command_page(), "keys.md": config_page(), "api.md": api()}
    pages |= {f"rooms/{room}.md": room_page(room) for room in rooms()}
    (folder / "rooms").mkdir(parents=True, exist_ok=True)
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != MARK + text:
            path.write_text(MARK + text, encoding="utf-8")


# Commands


def command_page() -> str:
    """All commands with their options."""
    context = click.Context(commands, info_name="memmlp")
    parts = [
        "# Commands",
        inspect.cleandoc(commands.help or ""),
        "Bad input ends in one line that names the key or file and what is allowed, with exit code 2, before "
        "anything runs. A failed run exits with 1, an interrupted one with 130. `MEMMLP_TRACEBACK=1` shows "
        "where an error came from.",
    ]
    for name in COMMANDS:
        command = commands.get_command(context, name)
        assert command is not None
        parts += described(
            command, click.Context(command, parent=context, info_name=name), COMMANDS[name].help
        )
    return "\n\n".join(parts) + "\n"


def described(
    command: click.Command, context: click.Context, line: str = "", depth: int = 2
) -> Iterator[str]:
    """A command's section, then those of its sub-commands."""
    yield f"{'#' * depth} {context.command_path}"
    yield inspect.cleandoc(command.help or line).replace("\b\n", "")
    if context.command_path == "memmlp train":
        yield (
            "A [Hydra](https://hydra.cc) application: arguments are overrides of [config keys](keys.md), "
            "`GROUP=OPTION` or `GROUP.KEY=VALUE`. `--help` lists the groups, `--cfg job` prints every key, "
            "`-m` runs several (`-m seed=0,1,2`)."
        )
    elif isinstance(command, click.Group):
        for name in command.list_commands(context):
            sub = command.get_command(context, name)
            assert sub is not None
            yield from described(sub, click.Context(sub, parent=context, info_name=name), depth=depth + 1)
    else:
        yield f"```text\n{' '.join([context.command_path, *command.collect_usage_pieces(context)])}\n```"
        records = [one.get_help_record(context) for one in command.params]
        cells = [f"| `{record[0]}` | {cell(record[1])} |" for record in records if record and record[1]]
        if cells:
            yield "\n".join(["| option | |", "|---|---|", *cells])


# Config keys


class Key(typing.NamedTuple):
    """A line of a config file: dotted key, value as written, comment."""

    name: str
    value: str
    comment: str


def config_page() -> str:
    """All groups, their options and keys."""
    conf = packaged("conf")
    parts = [
        "# Config keys",
        "`memmlp train GROUP=OPTION GROUP.KEY=VALUE`; the default option stands first. Values such as "
        "`${profile.width}` come from another key. `readings` are those of [the paper](../readings.md).",
        "## Top level",
        keys_table(file_keys(conf / "train.yaml", skip=("defaults", "hydra")), SCHEMAS["config"]),
        "## profile",
        inspect.getdoc(SCHEMAS["profile"]) or "",
        profiles(conf / "profile"),
    ]
    defaults = default_options(conf / "train.yaml")
    for group in sorted(path.name for path in conf.iterdir() if path.is_dir()):
        if group not in ("profile", "search"):
            parts += group_section(conf / group, defaults.get(group))
    empty = (name for name in defaults if "/" not in name and name != "_self_" and not (conf / name).is_dir())
    for group in sorted(empty):
        parts += [f"## {group}", "Empty here: [packages of your own](../guides/components.md) add options."]
    parts += [
        "## search",
        "Of `memmlp tune`, as `search.KEY=VALUE`; [searches](../guides/searches.md) explains them.",
    ]
    for path in sorted((conf / "search").glob("*.yaml")):
        keys = [key._replace(name=f"search.{key.name}") for key in file_keys(path)]
        parts.append(keys_table(keys, None))
    return "\n\n".join(parts) + "\n"


def default_options(train: Path) -> dict[str, str]:
    """The option that each group has without an override."""
    listed = yaml.safe_load(train.read_text(encoding="utf-8"))["defaults"]
    return {key: value for one in listed if isinstance(one, dict) for key, value in one.items()}


def group_section(folder: Path, default: str | None) -> Iterator[str]:
    """A group's section: its options with their keys."""
    yield f"## {folder.name}"
    paths = sorted(folder.glob("*.yaml"), key=lambda path: (path.stem != default, path.stem))
    for path in paths:
        if len(paths) > 1:
            yield f"### {folder.name}={path.stem}"
        yield from option_section(path)


def option_section(path: Path) -> Iterator[str]:
    """An option's words, its keys, and what else it sets."""
    text, group = path.read_text(encoding="utf-8"), path.parent.name
    if said := head_comment(text):
        yield said
    keys = [key for key in file_keys(path) if not key.name.split(".")[-1].startswith("_")]
    if "@package _global_" not in text:
        keys = [key._replace(name=f"{package(text) or group}.{key.name}") for key in keys]
    if own := [key for key in keys if key.name.startswith(f"{group}.")]:
        yield keys_table(own, SCHEMAS.get(schema_name(text)), group)
    taken = [f"`{name}={option or 'null'}`" for name, option in overridden(text)]
    others = [f"`{key.name}={key.value}`" for key in keys if key not in own]
    if taken or others:
        yield f"Sets {', '.join([*taken, *others])}."


def package(text: str) -> str | None:
    """Where a file says that its keys stand; None where it leaves that to its folder."""
    first = text.partition("\n")[0]
    return first.removeprefix("# @package ").strip() if first.startswith("# @package ") else None


def overridden(text: str) -> Iterator[tuple[str, str | None]]:
    """The other groups' options that a config file takes."""
    for one in yaml.safe_load(text).get("defaults", []):
        for name, option in one.items() if isinstance(one, dict) else ():
            if name.startswith("override "):
                yield name.removeprefix("override /"), option


def schema_name(text: str) -> str:
    """The schema that a config file starts from."""
    first = (yaml.safe_load(text).get("defaults") or [""])[0]
    return str(first).removeprefix("/schema/").partition("@")[0]


def head_comment(text: str) -> str:
    """The words at a file's head."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            lines.append(line.lstrip("# "))
    return " ".join(lines)


def profiles(folder: Path) -> str:
    """The profiles' keys side by side."""
    names = ["small", "paper", "tiny"]
    values = {name: {key.name: key.value for key in file_keys(folder / f"{name}.yaml")} for name in names}
    rows = [f"| | {' | '.join(f'`{name}`' for name in names)} | allowed |", "|---|---|---|---|---|"]
    for spec in dataclasses.fields(SCHEMAS["profile"]):
        cells = [f"`{values[name].get(spec.name, '')}`" for name in names]
        rows.append(f"| `profile.{spec.name}` | {' | '.join(cells)} | {allowed(spec)} |")
    return "\n".join(rows)


def file_keys(path: Path, skip: tuple[str, ...] = ("defaults",)) -> list[Key]:
    """The leaves of a config file with their comments."""
    text = path.read_text(encoding="utf-8")
    lines, node = text.splitlines(), yaml.compose(text)
    return [key for key in leaves(node, lines, "") if key.name.split(".")[0] not in skip] if node else []


def leaves(node: yaml.MappingNode, lines: list[str], prefix: str) -> Iterator[Key]:
    """The keys below a node of a file."""
    for name, value in node.value:
        dotted = f"{prefix}{name.value}"
        if isinstance(value, yaml.MappingNode) and not value.flow_style:
            yield from leaves(value, lines, f"{dotted}.")
            continue
        line, column = value.start_mark.line, value.start_mark.column
        if isinstance(value, yaml.SequenceNode) and not value.flow_style:  # a list over several lines
            yield Key(dotted, f"{len(value.value)} items", "")
            continue
        written, _, comment = lines[line][column:].partition(" #")
        yield Key(dotted, written.strip(), comment.strip())


def keys_table(keys: list[Key], schema: type | None, group: str = "") -> str:
    """The keys, dotted, with values, limits and comments; the schema is that of the group."""
    rows = ["| key | default | allowed | |", "|---|---|---|---|"]
    for key in keys:
        below = key.name.removeprefix(f"{group}.").split(".")
        spec = field_of(schema, below) if schema else None
        value = "(give one)" if key.value == MISSING else f"`{key.value}`"
        rows.append(f"| `{key.name}` | {value} | {allowed(spec) if spec else ''} | {cell(key.comment)} |")
    return "\n".join(rows)


def field_of(schema: type, path: list[str]) -> dataclasses.Field[Any] | None:
    """The field of a dotted key in a schema."""
    spec = next((one for one in dataclasses.fields(schema) if one.name == path[0]), None)
    if spec is None or len(path) == 1:
        return spec
    hint = typing.get_type_hints(schema)[path[0]]
    inner = next((one for one in typing.get_args(hint) if dataclasses.is_dataclass(one)), hint)
    return field_of(inner, path[1:]) if dataclasses.is_dataclass(inner) else None


def allowed(spec: dataclasses.Field[Any]) -> str:
    """A key's limits; its type where no rule says more."""
    rule, kind = spec.metadata.get("rule"), str(spec.type)
    own = kind.removeprefix("Optional[").removesuffix("]") if kind.startswith("Optional[") else kind
    words = cell(str(rule)) if rule else {"bool": "true or false", "str": "text"}.get(own, "")
    whole = "whole number, " if rule and own == "int" else ""
    return " or ".join(filter(None, [whole + words, "null" if own != kind else ""]))


def cell(words: str) -> str:
    """Words as a cell of a table."""
    return " ".join(words.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


# Python


def rooms() -> list[str]:
    """The packages of memmlp that a program may use, in alphabetical order."""
    return [one.name for one in pkgutil.iter_modules(memmlp.__path__) if one.ispkg and one.name != "cli"]


def api() -> str:
    """What `import memmlp` gives, and the rooms below it."""
    names = getattr(memmlp, "__all__", ["Stream"])
    public = [f"```{{eval-rst}}\n{directive(f'memmlp.{name}')}\n```" for name in names]
    below = "\n".join(f"rooms/{room}" for room in rooms())
    return "\n\n".join(
        [
            "# Python",
            "## `import memmlp`",
            *public,
            "## The rooms",
            "What lies below is used by the commands and may change from version to version; "
            "[the architecture](../architecture.md) says what each room is for.",
            f"```{{toctree}}\n:maxdepth: 1\n\n{below}\n```\n",
        ]
    )


def directive(name: str) -> str:
    """The autodoc directive of a public name."""
    module, _, own = name.rpartition(".")
    thing = getattr(importlib.import_module(module), own)
    if inspect.isclass(thing):
        return f".. autoclass:: {name}\n   :no-index:\n   :members:"
    return f".. auto{'function' if callable(thing) else 'data'}:: {name}\n   :no-index:"


def room_page(room: str) -> str:
    """A room's modules with the docstrings of what they have."""
    parts = [f"# memmlp.{room}"]
    for module in modules(room):
        title = [f"## {module}"] if module != f"memmlp.{room}" else []
        parts += [
            *title,
            f"```{{eval-rst}}\n.. automodule:: {module}\n   :members:\n   :show-inheritance:\n```",
        ]
    return "\n\n".join(parts) + "\n"


def modules(room: str) -> list[str]:
    """The modules of a room, itself first."""
    package = importlib.import_module(f"memmlp.{room}")
    below = pkgutil.walk_packages(package.__path__, f"memmlp.{room}.")
    return [f"memmlp.{room}", *(one.name for one in below)]
