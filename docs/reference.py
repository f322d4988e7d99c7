"""The reference pages, made from the code when the site is built: commands, config keys, Python modules.

Commands come from click, keys from the declarations of components, memmlp.config.schema and conf/.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import inspect
import pkgutil
import re
import typing
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click
import yaml

import memmlp
from memmlp.cli.main import COMMANDS, commands
from memmlp.common.components import collect_attribute, find_component, list_component_names
from memmlp.common.settings import MISSING
from memmlp.config.component_source import GROUPS
from memmlp.config.plugins import find_packaged_folder
from memmlp.config.schema import ONLY, SCHEMAS

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
    """A key of the config: dotted name, default, limits, meaning."""

    name: str
    value: str
    limits: str
    comment: str


def config_page() -> str:
    """All groups, their options and keys."""
    conf = find_packaged_folder("conf")
    defaults = default_options(conf / "train.yaml")
    parts = [
        "# Config keys",
        "`memmlp train GROUP=OPTION GROUP.KEY=VALUE`; the default option stands first. A default such as "
        "`16, 128, 512` has a value for each of `profile.sizes=tiny`, `small`, `paper`. `readings` are those "
        "of [the paper](../readings.md).",
        "## Top level",
        keys_table(file_keys(conf / "train.yaml", "", SCHEMAS["config"], skip=("defaults", "hydra"))),
        "## profile",
        inspect.getdoc(SCHEMAS["profile"]) or "",
        profiles(conf / "profile"),
    ]
    folders = {path.name for path in conf.iterdir() if path.is_dir()}
    for group in sorted({*folders, *GROUPS, *ONLY} - {"profile", "search"}):
        parts += group_section(group, conf / group, defaults.get(group))
    parts += [
        "## search",
        "Of `memmlp tune`, as `search.KEY=VALUE`; [searches](../guides/searches.md) explains them.",
    ]
    parts += [
        keys_table(file_keys(path, "search", None)) for path in sorted((conf / "search").glob("*.yaml"))
    ]
    return "\n\n".join(parts) + "\n"


def default_options(train: Path) -> dict[str, str]:
    """The option that each group has without an override."""
    listed = yaml.safe_load(train.read_text(encoding="utf-8"))["defaults"]
    return {key: value for one in listed if isinstance(one, dict) for key, value in one.items()}


def group_section(group: str, folder: Path, default: str | None) -> Iterator[str]:
    """A group's section: its options with their keys."""
    yield f"## {group}"
    sections = {path.stem: partial(file_section, path) for path in folder.glob("*.yaml")}
    sections |= {name: partial(component_section, group, name) for name in list_component_names(group)}
    sections |= {"default": partial(settings_section, ONLY[group], group)} if group in ONLY else {}
    if not sections:
        yield "Empty here: [your own packages](../guides/components.md) add options."
    for name in sorted(sections, key=lambda name: (name != default, name)):
        if len(sections) > 1:
            yield f"### {group}={name}"
        yield from sections[name]()


def component_section(group: str, name: str) -> Iterator[str]:
    """A component's words, its keys, and what else it sets."""
    settings = find_component(group, name).settings
    yield from settings_section(
        settings, {"generator": "data.synth", "loggers": f"loggers.{name}"}.get(group, group)
    )
    taken = {slot: option or "null" for slot, option in collect_attribute(settings, "defaults").items()}
    others = taken | collect_attribute(settings, "recipe")
    if others:
        yield f"Sets {', '.join(f'`{key}={written(value)}`' for key, value in others.items())}."


def settings_section(settings: type, group: str) -> Iterator[str]:
    """The words and the keys of a dataclass of settings."""
    words = vars(settings).get("__doc__") or ""
    if not words.startswith(f"{settings.__name__}("):  # which dataclass writes where there is no docstring
        yield inspect.cleandoc(words)
    yield keys_table(list(settings_keys(settings, group)))


def settings_keys(settings: type, prefix: str) -> Iterator[Key]:
    """The keys of a dataclass of settings, those of its groups included."""
    comments = comments_of(settings)
    for spec in dataclasses.fields(settings):
        default = spec.default_factory() if spec.default is dataclasses.MISSING else spec.default  # type: ignore[misc]
        if dataclasses.is_dataclass(default):
            for key in settings_keys(type(default), f"{prefix}.{spec.name}"):
                own = getattr(default, key.name.rpartition(".")[2])
                yield key._replace(value=written(own))
        elif spec.name != "name":
            yield Key(f"{prefix}.{spec.name}", written(default), allowed(spec), comments.get(spec.name, ""))


def written(value: Any) -> str:
    """A default as the page shows it."""
    if isinstance(value, str) and value.startswith(("${size:", "${reading:")):
        return ", ".join(value.partition(":")[2].rstrip("}").split(",")[:3])
    return {MISSING: "(give one)", None: "null", True: "true", False: "false"}.get(
        value if isinstance(value, str | bool | None) else "", str(value)
    )


def comments_of(settings: type) -> dict[str, str]:
    """The comments of the keys, behind them or above them in the code, those of the bases included."""
    found: dict[str, str] = {}
    for kind in reversed(settings.__mro__[:-1]):
        spec = importlib.util.find_spec(kind.__module__.partition(":")[0])
        text = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
        above: list[str] = []
        for line in re.split(r"\n(?=\S)", text.partition(f"\nclass {kind.__name__}")[2])[0].splitlines():
            own, _, comment = line.partition("  # ")
            if line.strip().startswith("# "):
                above.append(line.strip()[2:])
            else:
                if key := re.match(r"    (\w+): ", own):
                    found[key[1]] = comment or " ".join(above)
                above = []
    return found


def file_section(path: Path) -> Iterator[str]:
    """A config file's words, its keys, and which options it takes."""
    text, group = path.read_text(encoding="utf-8"), path.parent.name
    if said := head_comment(text):
        yield said
    defaults = yaml.safe_load(text).get("defaults", [])
    schema = next(
        (SCHEMAS.get(str(one).removeprefix("/schema/").partition("@")[0]) for one in defaults[:1]), None
    )
    whole = "@package _global_" in text
    if keys := file_keys(path, "" if whole else group, schema):
        yield keys_table(keys)
    parents = [
        f"`{group}={one}`" for one in defaults if isinstance(one, str) and not one.startswith(("/", "_"))
    ]
    taken = [
        f"`{name.removeprefix('override /')}={option or 'null'}`"
        for one in defaults
        if isinstance(one, dict)
        for name, option in one.items()
        if "override" in name
    ]
    if parents or taken:
        yield f"Starts from {', '.join([*parents, *taken])}."


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
    order, comments = ["small", "paper", "tiny"], comments_of(SCHEMAS["profile"])
    values = {
        name: {key.name: key.value for key in file_keys(folder / f"{name}.yaml", "", None)} for name in order
    }
    rows = [f"| | {' | '.join(f'`{name}`' for name in order)} | allowed | |", "|---|---|---|---|---|---|"]
    for spec in dataclasses.fields(SCHEMAS["profile"]):
        cells = [f"`{values[name].get(spec.name, written(spec.default))}`" for name in order]
        words = cell(comments.get(spec.name, ""))
        rows.append(f"| `profile.{spec.name}` | {' | '.join(cells)} | {allowed(spec)} | {words} |")
    return "\n".join(rows)


def file_keys(
    path: Path, prefix: str, schema: type | None, skip: tuple[str, ...] = ("defaults",)
) -> list[Key]:
    """The leaves of a config file with their comments."""
    text = path.read_text(encoding="utf-8")
    lines, node = text.splitlines(), yaml.compose(text)
    found = leaves(node, lines, "") if node else []
    return [
        Key(f"{prefix}.{name}" if prefix else name, value, allowed_at(schema, name.split(".")), comment)
        for name, value, comment in found
        if name.split(".")[0] not in skip
    ]


def leaves(node: yaml.MappingNode, lines: list[str], prefix: str) -> Iterator[tuple[str, str, str]]:
    """The dotted name, the value and the comment of the keys below a node of a file."""
    for name, value in node.value:
        dotted = f"{prefix}{name.value}"
        if isinstance(value, yaml.MappingNode) and not value.flow_style:
            yield from leaves(value, lines, f"{dotted}.")
            continue
        line, column = value.start_mark.line, value.start_mark.column
        if isinstance(value, yaml.SequenceNode) and not value.flow_style:  # a list over several lines
            yield dotted, f"{len(value.value)} items", ""
            continue
        own, _, comment = lines[line][column:].partition(" #")
        yield dotted, own.strip(), comment.strip()


def keys_table(keys: list[Key]) -> str:
    """The keys, dotted, with defaults, limits and comments."""
    rows = ["| key | default | allowed | |", "|---|---|---|---|"] if keys else []
    for key in keys:
        value = key.value if key.value == "(give one)" else f"`{key.value}`"
        name = key.name.replace("|", "\\|")  # a pattern as a key
        rows.append(f"| `{name}` | {value} | {key.limits} | {cell(key.comment)} |")
    return "\n".join(rows)


def allowed_at(schema: type | None, path: list[str]) -> str:
    """The limits of a dotted key in a schema; nothing for a key that it does not have."""
    spec = next((one for one in dataclasses.fields(schema) if one.name == path[0]), None) if schema else None
    if spec is None or len(path) == 1:
        return allowed(spec) if spec else ""
    hint = typing.get_type_hints(schema)[path[0]]
    return allowed_at(hint, path[1:]) if dataclasses.is_dataclass(hint) else ""


def allowed(spec: dataclasses.Field[Any]) -> str:
    """A key's limits; its type where no rule says more."""
    rule, own = spec.metadata.get("rule"), str(spec.type).removesuffix(" | None")
    words = cell(rule.words) if rule else {"bool": "true or false", "str": "text"}.get(own, "")
    whole = "whole number, " if rule and own == "int" else ""
    return " or ".join(filter(None, [whole + words, "null" if own != str(spec.type) else ""]))


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
            "[the architecture](../architecture.md) says what each package is for.",
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
