"""Documentation is correct: commands parse and compose, links lead somewhere."""

import re
import runpy
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import pytest
import yaml
from conftest import long_except
from omegaconf import OmegaConf
from own_package import PACKAGE, registers_kept

from memmlp.cli.main import commands
from memmlp.cli.workers import Workers, split_executor
from memmlp.config.build import build_untrained, make_readable_name
from memmlp.config.compose import compose_config, compose_jobs, compose_plain, parse_hydra_arguments
from memmlp.config.compose_plan import find_sweep
from memmlp.config.plugins import activate
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.importing.skeleton_map import SkeletonMap
from memmlp.sweep.search.search_file import parse_search
from memmlp.sweep.sweep_file import load_sweep

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "sweeps/README.md")),
    *(page for page in sorted(DOCS.rglob("*.md")) if not {"reference", "templates"} & set(page.parts)),
]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<!`)`(memmlp [^`\n]+(?:\n[^`\n]+)?)`(?!`)")
OUTSIDE_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


class Line(NamedTuple):
    """A command with its page and line number; `whole` unless a sentence mentions it without arguments."""

    page: str
    number: int
    text: str
    whole: bool

    def __str__(self) -> str:
        return f"{self.page}:{self.number}"


def blocks(path: Path, *languages: str) -> Iterator[tuple[int, str]]:
    text = path.read_text(encoding="utf-8")
    for found in BLOCK.finditer(text):
        if found[1] in languages:
            yield text.count("\n", 0, found.start()) + 2, found[2]


def commands_of(path: Path) -> Iterator[Line]:
    """The commands of a page's shell blocks, then those in its sentences."""
    page = str(path.relative_to(ROOT))
    for start, block in blocks(path, "sh", "bash", "console"):
        for offset, text in enumerate(block.replace("\\\n", " ").splitlines()):
            if words := shlex.split(text, comments=True):
                yield Line(page, start + offset, shlex.join(words), True)
    text = BLOCK.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), path.read_text(encoding="utf-8"))
    for found in INLINE.finditer(text):
        yield Line(page, text.count("\n", 0, found.start()) + 1, " ".join(found[1].split()), False)


LINES = sorted((line for page in PAGES for line in commands_of(page)), key=lambda line: not line.whole)
LINES = list({line.text: line for line in reversed(LINES)}.values())  # whole ones have priority
START = [line for line in LINES if line.page == "README.md" or line.page.startswith("docs/quickstart")]


@pytest.mark.slow
@pytest.mark.parametrize("line", long_except(START, LINES), ids=str)
def test_commands_are_valid(line: Line, on_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with registers_kept():
        if PACKAGE in line.text:
            activate([PACKAGE])
        check(line.text, line.whole)


@pytest.mark.slow
@pytest.mark.parametrize("line", [
    "memmlp trian", "memmlp train memry=none", "memmlp sweep 14 --jobs 3", "memmlp sweep 99",
    "make everything", "memmlp export RUN --opset 9", "memmlp tune search.n_trial=3",
    "node docs/examples/none.mjs", "python docs/examples/vmc/receive.py --prt 1",
])  # fmt: skip
def test_invalid_commands_are_refused(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Exception, match=r"\S"):
        check(line)


def check(text: str, whole: bool = True) -> None:
    """Refuse a command line with a wrong `memmlp` argument, `make` target or script."""
    text = re.sub(r"^(?:[A-Z_]+=\S+ )+|^torchrun .* -m ", "", text)
    if inner := re.search(r"\$\((.*)\)", text):
        text = inner[1]
    program, *words = shlex.split(text)
    if program == "memmlp":
        check_memmlp([word for word in words if word not in ("...", "OVERRIDES")], whole)
    elif program == "make":
        targets = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(words) <= set(targets[0].split())
    else:
        for at, word in enumerate(words):
            if word.startswith(("docs/", "benchmarks/")) and Path(word).suffix:
                check_script(ROOT / word, [other for other in words[at + 1 :] if other != "--"])


def check_script(script: Path, words: list[str]) -> None:
    """Refuse a missing script, or arguments that its parser does not know; output may go to a file."""
    assert script.exists(), script
    if script.suffix == ".py" and (parser := runpy.run_path(str(script)).get("parser")):
        made = parser()
        made.exit_on_error = False
        assert made.parse_known_args(words[: words.index(">")] if ">" in words else words)[1] == []


def check_memmlp(words: list[str], whole: bool) -> None:
    """Parse the arguments of `memmlp`, and compose all configs that they name. Files and folders that the
    line names in place of a reader's are created in the current folder."""
    create_placeholders(words)
    command, name = commands, ""
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        below = command.get_command(click.Context(command), words[0])
        assert below is not None, f"no command {words[0]}"
        name, command, words = f"{name} {words[0]}".strip(), below, words[1:]
    if name == "train":
        compose_once(words)
    elif not isinstance(command, click.Group):
        values = parse_arguments(command, name, words, whole)
        if name in ("sweep", "table", "results save"):
            compose_sweep(values)
        elif name == "tune":
            compose_search(values["overrides"])
        elif name in ("demo", "eval"):
            compose_once(values["overrides"])


def parse_arguments(command: click.Command, name: str, words: list[str], whole: bool) -> dict[str, Any]:
    """The converted values of a command's options and arguments; paths are not looked for."""
    context = click.Context(command, info_name=name)
    values, left, _ = command.make_parser(context).parse_args(list(words))
    assert not left, f"{name}: unknown arguments {left}"
    converted: dict[str, Any] = {}
    for one in command.params:
        value = values.get(one.name)
        if value is None or repr(value) == "Sentinel.UNSET" or value == ():
            assert not (one.required and whole), f"{name}: {one.name} is missing"
            value = () if one.nargs == -1 else None
        elif not isinstance(one.type, click.Path | click.File):
            value = one.type_cast_value(context, value)
        converted[one.name or ""] = value
    return converted


COMPOSED: set[tuple[str, ...]] = set()
"""Overrides that were composed before: many lines share theirs."""


def compose_once(overrides: Sequence[str]) -> None:
    """Compose and check the config of every job of `memmlp train OVERRIDES`."""
    if tuple(overrides) not in COMPOSED:
        args = parse_hydra_arguments(list(overrides))
        if not args.help and not args.shell_completion:
            compose_jobs(args)
            COMPOSED.add(tuple(overrides))


def compose_sweep(values: dict[str, Any]) -> None:
    """Compose the first and the last variant of a sweep with a command line's overrides."""
    executor, words, rest = split_executor(values["overrides"])
    Workers(executor, words)
    name = values["name"] or "NAME"
    if name.isupper() or name == "all" or name.endswith(".yaml"):  # a reader's, or many
        compose_once([word for word in rest if not word.startswith("seed=")])
        return
    sweep = find_sweep(name).with_overrides(rest)
    variants = sweep.list_runnable()
    for one in (variants[0], variants[-1]):
        compose_once(sweep.merge_overrides(one))


def compose_search(overrides: Sequence[str]) -> None:
    words = split_executor(overrides)[2]
    own = [word for word in words if word.lstrip("+~").startswith("search")]
    content = compose_plain("tune", own)["search"]
    best = {"optim.lr": 0.004, "optim.weight_decay": 0.01}  # in place of the earlier search of search.after
    search = parse_search(content, best if content["after"] else None)
    rest = [word for word in words if word not in own]
    compose_once([*search.base, *rest, *search.overrides(next(iter(search.list_first_trials()), {}))])


BOTH_SOURCES = (
    "mix", "scaling", "networks", "recurrent_poser", "recurrent_poser_ingredients", "data=cmu_bandai",
)  # fmt: skip
"""Sweeps and configs with data of both importers."""


EXTENSIONS = {"plugins=[mine]": 0, "plugins=[tilt]": 2, "plugins=[sway]": 4}
"""Plugins that `docs/guides/components.md` writes, and their places among its blocks of Python."""


def create_placeholders(words: list[str]) -> None:
    """Create the data folders and files that overrides name, and the files of the guides."""
    for word in words:
        key, _, value = word.partition("=")
        if key in ("data.root", "data.split.folder"):
            for folder in value.strip("[]").split(","):
                Path(folder).mkdir(parents=True, exist_ok=True)
        elif key == "data.body" and value != "builtin":
            Path(value).parent.mkdir(parents=True, exist_ok=True)
            Path(value).touch()
        elif word in BOTH_SOURCES:
            create_placeholders(["data.root=outputs/data/cmu,outputs/data/bandai"])
        elif word in EXTENSIONS:
            Path(f"{word[9:-1]}.py").write_text(examples("components", "python")[EXTENSIONS[word]])
        elif word == "myconf":
            Path("myconf/data").mkdir(parents=True, exist_ok=True)
            Path("myconf/data/sway.yaml").write_text(examples("components", "yaml")[1])
        elif word == "my_configs":
            Path("my_configs/data").mkdir(parents=True, exist_ok=True)
            (mix,) = (block for block in examples("checks", "yaml") if "sources:" in block)
            Path("my_configs/data/my_mix.yaml").write_text(mix)
            create_placeholders([f"data.root={root}" for root in re.findall(r"root: ([^\s,]+),", mix)])


def examples(guide: str, language: str) -> list[str]:
    return [block for _, block in blocks(DOCS / f"guides/{guide}.md", language)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere_and_python_compiles(page: Path):
    for link in LINK.findall(OUTSIDE_CODE.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"\w+:", link) or link.startswith("#"):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve()
        assert path.exists(), link
        assert not anchor or anchor in anchors(path), link
    for number, block in blocks(page, "python"):
        compile(block, f"{page}:{number}", "exec")


def anchors(path: Path) -> set[str]:
    """Valid `#...` of a page: headings as GitHub and the site spell them, and labels."""
    text = path.read_text(encoding="utf-8")
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
    return slugs | set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))


@pytest.mark.slow
def test_examples_of_the_guides_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The network is a plugin with a passing test, its variant a config file; the sweep composes."""
    network, test, *_ = examples("components", "python")
    (tmp_path / "mine.py").write_text(network)
    (tmp_path / "myconf/model").mkdir(parents=True)
    (tmp_path / "myconf/model/wide_conv.yaml").write_text(examples("components", "yaml")[0])
    monkeypatch.syspath_prepend(tmp_path)
    with registers_kept():
        words = ["plugins=[mine]", "profile=tiny", "--config-dir", str(tmp_path / "myconf")]
        cfg = compose_config([*words, "model=wide_conv"])
        assert (cfg.model.name, cfg.model.width, cfg.loss.name) == ("causal_conv", 512, "terms")
        assert make_readable_name("memmlp", OmegaConf.to_container(cfg, resolve=True)).startswith(
            "profile=tiny · model=causal_conv"
        )
        assert "mine" not in sys.modules
        names: dict[str, Any] = {}
        exec(test, names)
        names["test_the_stream_is_the_network"]()
        assert build_untrained([*words, "model=causal_conv"]).count_parameters() > 0
        exec(examples("components", "python")[4], names)
        names["write_sway"](tmp_path / "sway", clips=2)
        assert read_clip(tmp_path / "sway/sway_001.npz", "sway").poses.shape[0] == 600
    (tmp_path / "mine.yaml").write_text(examples("sweeps", "yaml")[0])
    sweep = load_sweep(tmp_path / "mine.yaml")
    assert sweep.control == "2, 4, 6, 8"
    for one in sweep.list_runnable():
        compose_config(sweep.merge_overrides(one))
    skeleton = yaml.safe_load(examples("motion", "yaml")[0])
    assert set(skeleton) == set(SkeletonMap.__dataclass_fields__)
