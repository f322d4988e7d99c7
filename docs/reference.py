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
    """Write all reference pages into a folder. Unchanged pages are not written again."""
    pages = {"commands.md": make_command_page(), "keys.md": make_config_page(), "api.md": make_api_page()}
    pages |= {f"packages/{package}.md": make_package_page(package) for package in list_packages()}
    (folder / "packages").mkdir(parents=True, exist_ok=True)
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != MARK + text:
            path.write_text(MARK + text, encoding="utf-8")


# Commands


def make_command_page() -> str:
    """Return the page of all commands with their options."""
    context = click.Context(commands, info_name="memmlp", **commands.context_settings)
    parts = [
        "# Commands",
        inspect.cleandoc(commands.help or ""),
        "For bad input, a command prints one line with the key or file and the expected value. It exits with "
        "code 2 before anything runs. A failed run exits with 1, an interrupted run with 130. "
        "`MEMMLP_TRACEBACK=1` prints the traceback of an error.",
    ]
    for name in COMMANDS:
        command = commands.get_command(context, name)
        assert command is not None
        parts += describe_command(
            command, click.Context(command, parent=context, info_name=name), COMMANDS[name].help
        )
    return "\n\n".join(parts) + "\n"


def describe_command(
    command: click.Command, context: click.Context, line: str = "", depth: int = 2
) -> Iterator[str]:
    """Yield the section of a command, then the sections of its sub-commands."""
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
            yield from describe_command(
                sub, click.Context(sub, parent=context, info_name=name), depth=depth + 1
            )
    else:
        yield f"```text\n{' '.join([context.command_path, *command.collect_usage_pieces(context)])}\n```"
        records = [one.get_help_record(context) for one in command.params]
        cells = [
            f"| `{record[0]}` | {escape_cell(record[1])} |" for record in records if record and record[1]
        ]
        if cells:
            yield "\n".join(["| option | |", "|---|---|", *cells])


# Config keys


class Key(typing.NamedTuple):
    """A config key: dotted name, default, limits, and comment."""

    name: str
    value: str
    limits: str
    comment: str


def make_config_page() -> str:
    """Return the page of all config groups with their options and keys."""
    conf = find_packaged_folder("conf")
    defaults = read_default_options(conf / "train.yaml")
    parts = [
        "# Config keys",
        "`memmlp train GROUP=OPTION GROUP.KEY=VALUE` sets an option and a key. Each group begins with its "
        "default option. A default such as `16, 128, 512` has one value each for `profile.sizes=tiny`, "
        "`small` and `paper`. The readings are explained in [Readings](../readings.md).",
        "## Top level",
        make_key_table(
            list_file_keys(conf / "train.yaml", "", SCHEMAS["config"], skip=("defaults", "hydra"))
        ),
        "## profile",
        inspect.getdoc(SCHEMAS["profile"]) or "",
        make_profile_table(conf / "profile"),
    ]
    folders = {path.name for path in conf.iterdir() if path.is_dir()}
    for group in sorted({*folders, *GROUPS, *ONLY} - {"profile", "search"}):
        parts += describe_group(group, conf / group, defaults.get(group))
    parts += [
        "## search",
        "Keys of `memmlp tune`, set with `search.KEY=VALUE`; see [searches](../guides/searches.md).",
    ]
    parts += [
        make_key_table(list_file_keys(path, "search", None))
        for path in sorted((conf / "search").glob("*.yaml"))
    ]
    return "\n\n".join(parts) + "\n"


def read_default_options(train: Path) -> dict[str, str]:
    """Return the default option of each group."""
    listed = yaml.safe_load(train.read_text(encoding="utf-8"))["defaults"]
    return {key: value for one in listed if isinstance(one, dict) for key, value in one.items()}


def describe_group(group: str, folder: Path, default: str | None) -> Iterator[str]:
    """Yield the section of a group: its options with their keys."""
    yield f"## {group}"
    sections = {path.stem: partial(describe_config_file, path) for path in folder.glob("*.yaml")}
    sections |= {name: partial(describe_component, group, name) for name in list_component_names(group)}
    sections |= {"default": partial(describe_settings, ONLY[group], group)} if group in ONLY else {}
    if not sections:
        yield "This group has no options; [custom packages](../guides/components.md) can add some."
    for name in sorted(sections, key=lambda name: (name != default, name)):
        if len(sections) > 1:
            yield f"### {group}={name}"
        yield from sections[name]()


def describe_component(group: str, name: str) -> Iterator[str]:
    """Yield a component's description, its keys, and the other keys that it sets."""
    settings = find_component(group, name).settings
    yield from describe_settings(
        settings, {"generator": "data.synth", "loggers": f"loggers.{name}"}.get(group, group)
    )
    taken = {slot: option or "null" for slot, option in collect_attribute(settings, "defaults").items()}
    others = taken | collect_attribute(settings, "recipe")
    if others:
        yield f"Sets {', '.join(f'`{key}={format_default(value)}`' for key, value in others.items())}."


def describe_settings(settings: type, group: str) -> Iterator[str]:
    """Yield the docstring and the keys of a settings class."""
    words = vars(settings).get("__doc__") or ""
    if not words.startswith(f"{settings.__name__}("):  # the default docstring of dataclasses
        yield inspect.cleandoc(words)
    yield make_key_table(list(list_settings_keys(settings, group)))


def list_settings_keys(settings: type, prefix: str) -> Iterator[Key]:
    """Yield the keys of a settings class, including the keys of nested classes."""
    comments = read_comments(settings)
    for spec in dataclasses.fields(settings):
        default = spec.default_factory() if spec.default is dataclasses.MISSING else spec.default  # type: ignore[misc]
        if dataclasses.is_dataclass(default):
            for key in list_settings_keys(type(default), f"{prefix}.{spec.name}"):
                own = getattr(default, key.name.rpartition(".")[2])
                yield key._replace(value=format_default(own))
        elif spec.name != "name":
            yield Key(
                f"{prefix}.{spec.name}",
                format_default(default),
                describe_limits(spec),
                comments.get(spec.name, ""),
            )


def format_default(value: Any) -> str:
    """Format a default value for the page."""
    if isinstance(value, str) and value.startswith(("${size:", "${reading:")):
        return ", ".join(value.partition(":")[2].rstrip("}").split(",")[:3])
    return {MISSING: "(give one)", None: "null", True: "true", False: "false"}.get(
        value if isinstance(value, str | bool | None) else "", str(value)
    )


def read_comments(settings: type) -> dict[str, str]:
    """Return the comments of a class' keys, including inherited keys, from the source code."""
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


def describe_config_file(path: Path) -> Iterator[str]:
    """Yield a config file's description, its keys, and the options on which it is based."""
    text, group = path.read_text(encoding="utf-8"), path.parent.name
    if description := read_head_comment(text):
        yield description
    defaults = yaml.safe_load(text).get("defaults", [])
    schema = next(
        (SCHEMAS.get(str(one).removeprefix("/schema/").partition("@")[0]) for one in defaults[:1]), None
    )
    whole = "@package _global_" in text
    if keys := list_file_keys(path, "" if whole else group, schema):
        yield make_key_table(keys)
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


def read_head_comment(text: str) -> str:
    """Return the comment at the beginning of a config file."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            lines.append(line.lstrip("# "))
    return " ".join(lines)


def make_profile_table(folder: Path) -> str:
    """Return a table with the keys of all profiles."""
    order, comments = ["small", "paper", "tiny"], read_comments(SCHEMAS["profile"])
    values = {
        name: {key.name: key.value for key in list_file_keys(folder / f"{name}.yaml", "", None)}
        for name in order
    }
    rows = [f"| | {' | '.join(f'`{name}`' for name in order)} | must be | |", "|---|---|---|---|---|---|"]
    for spec in dataclasses.fields(SCHEMAS["profile"]):
        cells = [f"`{values[name].get(spec.name, format_default(spec.default))}`" for name in order]
        words = escape_cell(comments.get(spec.name, ""))
        rows.append(f"| `profile.{spec.name}` | {' | '.join(cells)} | {describe_limits(spec)} | {words} |")
    return "\n".join(rows)


def list_file_keys(
    path: Path, prefix: str, schema: type | None, skip: tuple[str, ...] = ("defaults",)
) -> list[Key]:
    """Return the keys of a config file with their comments."""
    text = path.read_text(encoding="utf-8")
    lines, node = text.splitlines(), yaml.compose(text)
    found = list_leaves(node, lines, "") if node else []
    return [
        Key(
            f"{prefix}.{name}" if prefix else name,
            value,
            describe_limits_of_key(schema, name.split(".")),
            comment,
        )
        for name, value, comment in found
        if name.split(".")[0] not in skip
    ]


def list_leaves(node: yaml.MappingNode, lines: list[str], prefix: str) -> Iterator[tuple[str, str, str]]:
    """Yield dotted name, value and comment of each key below a YAML node."""
    for name, value in node.value:
        dotted = f"{prefix}{name.value}"
        if isinstance(value, yaml.MappingNode) and not value.flow_style:
            yield from list_leaves(value, lines, f"{dotted}.")
            continue
        line, column = value.start_mark.line, value.start_mark.column
        if isinstance(value, yaml.SequenceNode) and not value.flow_style:  # a list over several lines
            yield dotted, f"{len(value.value)} items", ""
            continue
        own, _, comment = lines[line][column:].partition(" #")
        yield dotted, own.strip(), comment.strip()


def make_key_table(keys: list[Key]) -> str:
    """Return a table of keys with defaults, limits and comments."""
    rows = ["| key | default | must be | |", "|---|---|---|---|"] if keys else []
    for key in keys:
        value = key.value if key.value == "(give one)" else f"`{key.value}`"
        name = key.name.replace("|", "\\|")  # a pattern as a key
        rows.append(f"| `{name}` | {value} | {key.limits} | {escape_cell(key.comment)} |")
    return "\n".join(rows)


def describe_limits_of_key(schema: type | None, path: list[str]) -> str:
    """Return the limits of a dotted key in a schema; empty if the schema does not have the key."""
    spec = next((one for one in dataclasses.fields(schema) if one.name == path[0]), None) if schema else None
    if spec is None or len(path) == 1:
        return describe_limits(spec) if spec else ""
    hint = typing.get_type_hints(schema)[path[0]]
    return describe_limits_of_key(hint, path[1:]) if dataclasses.is_dataclass(hint) else ""


def describe_limits(spec: dataclasses.Field[Any]) -> str:
    """Return the limits of a key, or its type if it has no rule."""
    rule, own = spec.metadata.get("rule"), str(spec.type).removesuffix(" | None")
    words = escape_cell(rule.words) if rule else {"bool": "true or false", "str": "text"}.get(own, "")
    whole = "whole number, " if rule and own == "int" else ""
    return " or ".join(filter(None, [whole + words, "null" if own != str(spec.type) else ""]))


def escape_cell(words: str) -> str:
    """Escape text for a cell of a Markdown table."""
    return " ".join(words.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


# Python


def list_packages() -> list[str]:
    """Return the names of memmlp's packages, without the command line, in alphabetical order."""
    return [one.name for one in pkgutil.iter_modules(memmlp.__path__) if one.ispkg and one.name != "cli"]


def make_api_page() -> str:
    """Return the page of the public functions, with links to the packages."""
    names = getattr(memmlp, "__all__", ["Stream"])
    public = [f"```{{eval-rst}}\n{make_directive(f'memmlp.{name}')}\n```" for name in names]
    below = "\n".join(f"packages/{package}" for package in list_packages())
    return "\n\n".join(
        [
            "# Python",
            "## `import memmlp`",
            *public,
            "## Packages",
            "The commands use these packages. They may change with each version. "
            "[Architecture](../architecture.md) explains them.",
            f"```{{toctree}}\n:maxdepth: 1\n\n{below}\n```\n",
        ]
    )


def make_directive(name: str) -> str:
    """Return the autodoc directive of a public name."""
    module, _, own = name.rpartition(".")
    thing = getattr(importlib.import_module(module), own)
    if inspect.isclass(thing):
        return f".. autoclass:: {name}\n   :no-index:\n   :members:"
    return f".. auto{'function' if callable(thing) else 'data'}:: {name}\n   :no-index:"


def make_package_page(package: str) -> str:
    """Return the page of a package: its modules with the docstrings of their members."""
    parts = [f"# memmlp.{package}"]
    for module in list_modules(package):
        title = [f"## {module}"] if module != f"memmlp.{package}" else []
        parts += [
            *title,
            f"```{{eval-rst}}\n.. automodule:: {module}\n   :members:\n   :show-inheritance:\n```",
        ]
    return "\n\n".join(parts) + "\n"


def list_modules(package: str) -> list[str]:
    """Return the module names of a package; the package comes first."""
    name = f"memmlp.{package}"
    paths = importlib.import_module(name).__path__
    return [name, *(one.name for one in pkgutil.walk_packages(paths, f"{name}."))]
