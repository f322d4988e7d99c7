"""README and docs: every command line parses, every link leads somewhere, every number has its source."""

from __future__ import annotations

import importlib
import re
import runpy
import shlex
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from command_lines import ROOT, Line, blocks, inline_lines, shell_lines, takes
from omegaconf import OmegaConf
from own_package import PACKAGE, registers_kept

from memmlp.cli.main import COMMANDS
from memmlp.common.components import names as component_names
from memmlp.config.build import untrained
from memmlp.config.compose import composed
from memmlp.config.plugins import activate
from memmlp.evaluation.metric_facts import SMALLEST, UNITS
from memmlp.motion.importing.skeleton_map import SkeletonMap
from memmlp.runs.identity import flatten
from memmlp.sweep.sweep_file import load_sweep

DOCS = ROOT / "docs"
MADE = ("reference", "earlier", "templates")  # by the code, kept for the record, or not yet pages
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "sweeps/README.md")),
    *(page for page in sorted(DOCS.rglob("*.md")) if not set(MADE) & set(page.parts)),
]
LINES = list({line.text: line for page in PAGES for line in shell_lines(page)}.values())
SHOWN = {line.text for line in LINES}
MENTIONS = list(
    {line.text: line for page in PAGES for line in inline_lines(page) if line.text not in SHOWN}.values()
)
"""The commands in sentences that are no line of a block, which are looked at more closely."""
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
MEASURED = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?= ?(?:ms|cm|°|%|times)(?!\w))|(?<![\w.])\d+\.\d+(?![\w.])")
VERSIONS = re.compile(r"Python \d[\d.]*")


def ids(lines: list[Line]) -> list[str]:
    return [f"{line.page}:{line.number}" for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES, ids=ids(LINES))
def test_a_command_line_is_taken(line: Line, on_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with registers_kept():
        if PACKAGE in line.text:
            activate([PACKAGE])
        checks(line.text)


def checks(text: str) -> None:
    """Refuse a line whose program, target, extra or arguments there are not."""
    if inner := re.search(r"\$\((.*)\)", text):
        return checks(inner[1])
    words = shlex.split(text)
    while re.match(r"[A-Z_]+=", words[0]):
        words = words[1:]
    program, rest = words[0], words[1:]
    if program == "memmlp":
        takes(shlex.join(words))
    elif program == "torchrun":
        at = rest.index("-m")
        takes(shlex.join(rest[at + 1 :]))
    elif program == "make":
        targets = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert targets
        assert {word for word in rest if "=" not in word} <= set(targets[1].split())
    elif any(word.startswith("docs/") for word in rest) and program in ("python", "node", "blender", "cmake"):
        runs_example(rest)
    elif program == "dask":
        command = importlib.import_module(f"distributed.cli.dask_{rest[0]}").main
        command.make_context("dask", rest[1:])  # raises for an option that there is not
    elif program == "docker":
        known = re.findall(r"^ARG (\w+)", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
        given = [words[at + 1].partition("=")[0] for at, word in enumerate(words) if word == "--build-arg"]
        assert set(given) <= set(known)
    else:
        known = words[:2] in INSTALLS or words[:3] in MODULES or (ROOT / words[1]).is_file()
        assert known or program in ("git", "cd", "source", "build/full_body"), text


INSTALLS = (["pip", "install"], ["npm", "install"], ["cmake", "--build"])
MODULES = (["python", "-m", "http.server"], ["python", "-m", "venv"])


def runs_example(words: list[str]) -> None:
    """Refuse words of a script of docs/ that is not there, or does not take them; output may go to a file."""
    words = words[: words.index(">")] if ">" in words else words
    at = next(at for at, word in enumerate(words) if word.startswith("docs/"))
    script = ROOT / words[at]
    assert script.exists(), script
    if parser := script.suffix == ".py" and runpy.run_path(str(script)).get("parser"):
        made = parser()
        made.exit_on_error = False
        assert made.parse_known_args([word for word in words[at + 1 :] if word != "--"])[1] == []


@pytest.mark.slow
@pytest.mark.parametrize("line", MENTIONS, ids=ids(MENTIONS))
def test_a_command_in_a_sentence_is_one(line: Line, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    takes(line.text, whole=False)


@pytest.mark.slow
def test_what_is_wrong_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The checks above can fail: an option, a key, a value, a command, an arm, a target that are none."""
    monkeypatch.chdir(tmp_path)
    for wrong in (
        "memmlp trian", "memmlp train memry=none", "memmlp train -m seed=0,x", "memmlp sweep 14 --jobs 3",
        "memmlp sweep 14 memory.shift=day", "memmlp sweep 99", "memmlp export RUN --opset 9",
        "memmlp runs lost", "memmlp table 14 --format doc", "memmlp tune search.n_trial=3",
        "memmlp live RUN --udp many", "memmlp sweep 14 executor=slurm slurm.nodes=3", "make everything",
        "docker build --build-arg GPU=1 .",
        "python docs/examples/none.py", "python docs/examples/trackers.py a.npz --out b --space mars",
        "python docs/examples/vmc/receive.py --prt 1", "node docs/examples/none.mjs",
    ):  # fmt: skip
        with pytest.raises(Exception, match=r"\S"):
            checks(wrong)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path):
    for link in LINK.findall(OUTSIDE_CODE.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"\w+:", link) or link.startswith("#"):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve()
        assert path.exists(), link
        assert not anchor or anchor in anchors(path), link


OUTSIDE_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def anchors(path: Path) -> set[str]:
    """What `#...` of a page may name: headings as GitHub and the site spell them, and labels."""
    text = path.read_text(encoding="utf-8")
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
    return slugs | set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))


def test_extras_are_those_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for page in PAGES:
        for extra in re.findall(r"(?:memmlp|'\.)\[(\w+)\]", page.read_text(encoding="utf-8")):
            assert extra in extras, f"{page}: {extra}"


def test_readme_is_short_and_says_nothing_of_commits_first():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    assert not re.search(r"\b[0-9a-f]{7}\b", "\n".join(lines[:40]))
    assert (ROOT / "docs/images/film.gif").stat().st_size < 600_000


def test_numbers_of_readme_stand_in_the_results_that_they_name():
    """A measured number's paragraph, item or row links to a file of docs/results that has it."""
    text = OUTSIDE_CODE.sub("", (ROOT / "README.md").read_text(encoding="utf-8"))
    found = 0
    for part in re.split(r"\n\s*\n|\n(?=[|-] ?)", text):
        sources = [ROOT / link for link in LINK.findall(part) if link.startswith("docs/results/")]
        kept = "".join(source.read_text(encoding="utf-8") for source in sources if source.suffix == ".md")
        for number in MEASURED.findall(VERSIONS.sub("", LINK.sub("", part))):
            found += 1
            assert re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.])", kept), f"{number}: {part}"
    assert found >= 2


@pytest.fixture
def reference(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The generator of the reference pages."""
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("reference")


@pytest.mark.slow
def test_the_reference_has_every_key(reference: ModuleType):
    page = reference.config_page()
    memories = [f"memory={name}" for name in component_names("memory")]
    for word in (*memories, "model=agrol_diffusion", "model=avatar_poser", "loss=manual", "rollout=streams"):
        config = OmegaConf.to_container(composed([word]), resolve=False)
        values = flatten(config).items()
        keys = {key for key, value in values if f"## {key}\n" not in page or value not in (None, {})}
        for key in keys:
            last = key.rsplit(".", 1)[-1]
            assert last == "name" or f"| `{key}` |" in page, f"{word}: {key}"


def test_the_reference_has_every_option(reference: ModuleType):
    page = reference.command_page()
    for name in COMMANDS:
        assert f"## memmlp {name}\n" in page
    for option in ("--until-decided", "--max-growth FLOAT", "--udp PORT", "--save-predictions PATH"):
        assert f"| `{option}` |" in page, option


def examples(name: str, language: str) -> list[str]:
    return [block for _, block in blocks((DOCS / f"guides/{name}.md").read_text(encoding="utf-8"), language)]


def test_the_network_of_the_guide_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its file is a plugin, its test passes, and its variant is a config file."""
    network, test, *_ = examples("components", "python")
    (tmp_path / "mine.py").write_text(network)
    (tmp_path / "myconf/model").mkdir(parents=True)
    (tmp_path / "myconf/model/wide_conv.yaml").write_text(examples("components", "yaml")[0])
    monkeypatch.syspath_prepend(tmp_path)
    with registers_kept():  # other tests have modules of that name
        words = ["plugins=[mine]", "profile=tiny", "--config-dir", str(tmp_path / "myconf")]
        cfg = composed([*words, "model=wide_conv"])
        assert (cfg.model.name, cfg.model.width, cfg.loss.name) == ("causal_conv", 512, "terms")
        assert "mine" not in sys.modules
        names: dict[str, Any] = {}
        exec(test, names)
        names["test_the_stream_is_the_network"]()
        model = untrained([*words, "model=causal_conv"])
        assert model.count_parameters() > 0


@pytest.mark.slow
def test_the_sweep_of_the_guide_loads(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text(examples("sweeps", "yaml")[0])
    sweep = load_sweep(path)
    assert sweep.control == "2, 4, 6, 8"
    for one in sweep.variant_seeds():
        composed(one.overrides)


def test_the_skeleton_of_the_guide_has_the_keys_of_one():
    given = yaml.safe_load(examples("motion", "yaml")[0])
    assert set(given) == set(SkeletonMap.__dataclass_fields__)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_of_pages_is_python(page: Path):
    for number, block in blocks(page.read_text(encoding="utf-8"), "python"):
        compile(block, f"{page}:{number}", "exec")


def test_the_metrics_of_the_guide_are_the_field_s():
    rows = re.findall(
        r"^\| `(.+?)` \| (.+?) \| (.+?) \|", (DOCS / "guides/runs.md").read_text(), re.MULTILINE
    )
    listed = {name: (unit, float(smallest)) for name, unit, smallest in rows if name in UNITS}
    assert listed == {name: (UNITS[name], SMALLEST[name]) for name in UNITS if name != "GT Jitter"}


def test_the_first_quickstart_names_every_option_and_no_other():
    text = (DOCS / "quickstart" / "train.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE))
    groups = {name for name in rows if (ROOT / "conf" / name).is_dir() or component_names(name)}
    assert {"model", "memory", "loss", "rollout"} <= groups
    keys = {"null", "batch", "lr", "drops", "drop"}  # what is said of options beside their names
    for group in sorted(groups):
        files = (path.stem for path in (ROOT / "conf" / group).glob("*.yaml"))
        options = {*files, *component_names(group)}
        named = set(re.findall(r"`([a-z_0-9]+)`", rows[group]))
        assert options <= named, group
        assert named - options <= keys, group
