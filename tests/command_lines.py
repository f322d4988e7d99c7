"""The command lines of Markdown pages, and whether the parser takes them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click

from memmlp.cli.main import commands
from memmlp.cli.workers import Workers, split_executor
from memmlp.config.compose import composed_plain, parse, preflight
from memmlp.config.compose_plan import find_sweep
from memmlp.sweep.search.search_file import parse_search

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<!`)`([^`\n]+(?:\n[^`\n]+)?)`(?!`)")
OF_BOTH_SOURCES = (
    "mix", "scaling", "networks", "recurrent_poser", "recurrent_poser_ingredients", "smooth_motion",
    "data=cmu_bandai",
)  # fmt: skip
OWN = re.compile(r"[\w./-]*\.yaml")  # a sweep file that a page invents


class Line(NamedTuple):
    """A command line with its page and line number."""

    page: str
    number: int
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.number}: {self.text}"


def blocks(text: str, *languages: str) -> Iterator[tuple[int, str]]:
    """The blocks of code in some languages, with the line number of their first line."""
    for found in BLOCK.finditer(text):
        if found[1] in languages:
            yield text.count("\n", 0, found.start()) + 2, found[2]


def shell_lines(path: Path) -> list[Line]:
    """The lines of a page's shell blocks, comments taken out, continued ones joined."""
    page, made = str(path.relative_to(ROOT)), []
    for start, block in blocks(path.read_text(encoding="utf-8"), "sh", "bash", "console"):
        joined = block.replace("\\\n", " ")
        for offset, text in enumerate(joined.splitlines()):
            if words := shlex.split(text, comments=True):
                made.append(Line(page, start + offset, shlex.join(words)))
    return made


def inline_lines(path: Path) -> list[Line]:
    """The `memmlp ...` within a page's sentences that are more than a command's name."""
    text = BLOCK.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), path.read_text(encoding="utf-8"))
    page = str(path.relative_to(ROOT))
    found = [(one.start(), " ".join(one[1].split())) for one in INLINE.finditer(text)]
    return [
        Line(page, text.count("\n", 0, at) + 1, words) for at, words in found if words.startswith("memmlp ")
    ]


def takes(line: str, whole: bool = True) -> None:
    """Parse `memmlp ...` as far as can be without running it. Raises where the command would refuse it.

    whole: nothing that the command needs may be missing, as it may in a sentence. Files and folders that the
    line names in place of a reader's are made in the current folder.
    """
    words = [word for word in shlex.split(line)[1:] if word not in ("...", "OVERRIDES")]
    make_placeholders(words)
    command, name, rest = resolved(words)
    if isinstance(command, click.Group):
        assert not rest or rest[0].startswith("-"), f"{name} has no {rest[0]}"
    elif name == "train":
        composes(rest)
    else:
        parsed = arguments(command, name, rest, whole)
        CHECKS.get(name, lambda parsed: None)(parsed)


def resolved(words: list[str]) -> tuple[click.Command, str, list[str]]:
    """The command that words name, its name, and the words behind it."""
    command: click.Command = commands
    names: list[str] = []
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        below = command.get_command(click.Context(command), words[0])
        assert below is not None, f"no command {words[0]}"
        names.append(words[0])
        command, words = below, words[1:]
    return command, " ".join(names), words


def arguments(command: click.Command, name: str, words: list[str], whole: bool) -> dict[str, Any]:
    """The values of a command's options and arguments, converted; paths are taken as they are."""
    context = click.Context(command, info_name=name)
    values, left, _ = command.make_parser(context).parse_args(list(words))
    assert not left, f"{name}: nothing takes {left}"
    made: dict[str, Any] = {}
    for one in command.params:
        value = values.get(one.name)
        if value is None or repr(value) == "Sentinel.UNSET" or value == ():
            assert not (one.required and whole), f"{name}: no {one.name}"
            made[one.name or ""] = () if one.nargs == -1 else None
        elif isinstance(one.type, click.Path | click.File):
            made[one.name or ""] = value
        else:
            made[one.name or ""] = one.type_cast_value(context, value)
    return made


TAKEN: set[tuple[str, ...]] = set()
"""The overrides that were composed; many lines have the same, and their placeholders are the same, too."""


def composes(overrides: Sequence[str]) -> None:
    """Compose and check the config of every job of `memmlp train OVERRIDES`."""
    if tuple(overrides) in TAKEN:
        return
    args = parse(list(overrides))
    if args.help or args.shell_completion:
        return
    preflight(args)
    TAKEN.add(tuple(overrides))


def _sweeps(parsed: dict[str, Any]) -> None:
    """Compose the first and the last arm of a sweep with a command line's overrides."""
    engine, words, rest = split_executor(parsed["overrides"])
    Workers(engine, words)
    name = parsed["name"] or "NAME"
    if name.isupper() or name == "all" or OWN.fullmatch(name):  # a reader's, or many
        composes([word for word in rest if not word.startswith("seed=")])
        return
    found = find_sweep(name).with_overrides(rest).variant_seeds()
    for one in (found[0], found[-1]):
        composes(one.overrides)


def _search(parsed: dict[str, Any]) -> None:
    """Compose a search, and the config of its first trial."""
    words = split_executor(parsed["overrides"])[2]
    own = [word for word in words if word.lstrip("+~").startswith("search")]
    search = parse_search(composed_plain("tune", own)["search"])
    rest = [word for word in words if word not in own]
    composes([*search.base, *rest, *search.overrides(next(iter(search.first_trials()), {}))])


def _overrides(parsed: dict[str, Any]) -> None:
    composes(parsed["overrides"])


CHECKS: dict[str, Callable[[dict[str, Any]], None]] = {
    "demo": _overrides, "eval": _overrides, "tune": _search,
    "sweep": _sweeps, "table": _sweeps, "results save": _sweeps,
}  # fmt: skip


def make_placeholders(words: list[str]) -> None:
    """Make the data folders and files that overrides name, and the configs of the guides."""
    for word in words:
        key, _, value = word.partition("=")
        if key in ("data.root", "data.split.folder"):
            for folder in value.strip("[]").split(","):
                Path(folder).mkdir(parents=True, exist_ok=True)
        elif key == "data.body" and value != "builtin":
            Path(value).parent.mkdir(parents=True, exist_ok=True)
            Path(value).touch()
        elif word in OF_BOTH_SOURCES:
            make_placeholders(["data.root=outputs/data/cmu,outputs/data/bandai"])
        elif word == "plugins=[mine]":
            guide = (ROOT / "docs/guides/components.md").read_text(encoding="utf-8")
            Path("mine.py").write_text(next(block for _, block in blocks(guide, "python")))
        elif word == "my_configs":
            Path("my_configs/data").mkdir(parents=True, exist_ok=True)
            guide = (ROOT / "docs/guides/motion.md").read_text(encoding="utf-8")
            (mix,) = (block for _, block in blocks(guide, "yaml") if "sources:" in block)
            Path("my_configs/data/my_mix.yaml").write_text(mix)
            make_placeholders([f"data.root={root}" for root in re.findall(r"root: ([^\s,]+),", mix)])
