"""Give a sweep, a variant, a tag, clips, a folder and a plugin nasty names; no command may lose or alter one.

    python benchmarks/nasty_names.py --names 200

Each round trains a network for a step in a folder of its own, and passes the names through `sweep`, `train`,
`table`, `runs`, `loggers sync` with the real clients, `report` and the printed commands. Exits with 1 after a
difference. tests/kills runs the same with a few names.
"""

import contextlib
import io
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import yaml
from markdown_it import MarkdownIt

from memmlp.cli.main import main as run_main
from memmlp.common import components
from memmlp.common.errors import escape_line_breaks
from memmlp.common.text_formats import escape_latex, make_override
from memmlp.config import plugins
from memmlp.evaluation.metric_facts import HIGHER, SMALLEST, UNITS
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.synthetic import synthesize_clip
from memmlp.report.ui.server import Answers
from memmlp.runs.evaluation_file import read_report
from memmlp.runs.identity import VERSIONS
from memmlp.runs.loggers.mlflow import MLflow
from memmlp.runs.lookup import list_runs, read_notes
from memmlp.runs.run import Run

PIECES = [
    *"abz019é漢\u202e😀\u200d'\"\\ $%{}=,[]()~:;#&|<>*?!@`^-+./_\n\t\x1b",
    "${", "off", "null", ":bug:", "&amp;",
]  # fmt: skip
TAG_PIECES = [*"abz019é漢_.+/:-", "..", "//", "off"]
MODULE_PIECES = [*"abz019éß漢_", "off", "null", "yes", "None"]
ACTIVITIES = ("walking", "squatting", "reaching", "waving")
SMALL = ["profile=tiny", "model=avatar_poser", "optim.steps=1", "loggers=none", "threads=1"]
SMALL += ["export.graph=off", "evaluation.modes=[window]", "evaluation.metrics=[zero]", "data=mocap"]
SMALL += ["data.split.test=0.5", "data.split.val=0", "data.split.seed=1"]
PLUGIN = """
from typing import ClassVar
from memmlp.common.components import component
from memmlp.common.settings import MetricSettings

@component("metric", "zero", builds="zero")
class ZeroSettings(MetricSettings):
    unit: ClassVar[str] = "%"
    smallest: ClassVar[float] = 1.0

def zero(predicted, truth):
    return predicted.sum() * 0
"""
REGISTERS = (SMALLEST, UNITS, VERSIONS, HIGHER, plugins._active, components._roots)
FORBIDDEN = r"[/\n]|^\s*$|^\.*$"  # in names of files, and in labels, which have one line


@click.command()
@click.option("--names", default=200, show_default=True, help="How many names of each sort.")
@click.option("--seed", default=0, show_default=True, help="Seed of the names.")
def main(names: int, seed: int) -> None:
    """Pass nasty names through the commands."""
    problems = find_problems(names, random.Random(seed))
    click.echo("\n".join([*problems, f"{names} names of each sort: {len(problems)} differences"]))
    raise SystemExit(bool(problems))


class Names(NamedTuple):
    """The names of one round."""

    sweep: str
    variant: str
    tag: str
    clips: Sequence[str]
    folder: str
    plugin: str


def find_problems(count: int, dice: random.Random) -> list[str]:
    """Run a round for each name, and list what was lost or altered."""
    printable = [piece for piece in PIECES if piece.isprintable()]
    in_line = [piece for piece in PIECES if escape_line_breaks(piece) == piece]
    texts = [make_names(count, pieces, dice, FORBIDDEN) for pieces in (printable, in_line, in_line, PIECES)]
    tags = make_names(count, TAG_PIECES, dice, r"^.{65,}|^-")
    modules = make_names(count, MODULE_PIECES, dice, r"^(?![^\W\d]\w*$)")
    problems = []
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as base:
        sqlite = make_database(Path(base))
        for index in range(count):
            clips = [texts[2][(index + n) % count] for n in range(4)]
            sweep, variant, _, folder = (text[index] for text in texts)
            names = Names(sweep, variant, tags[index], clips, folder, modules[index])
            home = Path(base) / folder
            try:
                with plugin_forgotten(home, names.plugin):
                    play_round(home, names, sqlite)
            except Exception as error:
                where = traceback.extract_tb(error.__traceback__)
                line = next(one.line for one in reversed(where) if one.filename == __file__)
                problems.append(f"{names}: {line}: {type(error).__name__}: {str(error)[:500]}")
            finally:
                os.chdir(before)
                shutil.rmtree(home)
    return problems


def make_database(folder: Path) -> Path:
    """Make an empty database by MLflow, which takes seconds."""
    with MLflow(None, folder).client():
        return folder / "mlflow.db"


@contextlib.contextmanager
def plugin_forgotten(home: Path, name: str) -> Iterator[None]:
    """Find plugins in a folder, and forget this one afterwards, so that the next may declare its metric."""
    before = [one.copy() for one in REGISTERS]
    sys.path.insert(0, str(home))
    try:
        yield
    finally:
        sys.path.remove(str(home))
        sys.modules.pop(name, None)
        for one, content in zip(REGISTERS, before, strict=True):
            one.clear()
            one.update(content)  # type: ignore[arg-type]
        components.collect_components.cache_clear()


def make_names(count: int, pieces: Sequence[str], dice: random.Random, forbidden: str) -> list[str]:
    """Make different names of 1 to 12 pieces that do not match `forbidden`."""
    names = dict[str, None]()
    while len(names) < count:
        name = "".join(dice.choices(pieces, k=dice.randint(1, 12)))
        if not re.search(forbidden, name):
            names[name] = None
    return list(names)


def call(*words: str, code: int = 0) -> str:
    """Run a command line in this process; return its output."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run_main(list(words))
            left: Any = 0
        except SystemExit as end:
            left = end.code or 0
    assert left == code, f"{words}: {left}: {err.getvalue()}"
    for line in (out.getvalue() + err.getvalue()).splitlines():
        if line.startswith("next: memmlp "):
            next_words = read_command(line.removeprefix("next: memmlp "))
            if next_words[0] != "ui":
                call(*next_words)
    return out.getvalue()


def read_command(line: str) -> list[str]:
    """Return the words that bash reads from a printed command."""
    command = f"printf '%s\\0' {line}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, check=True)
    return [os.fsdecode(word) for word in done.stdout.split(b"\0")[:-1]]


def play_round(home: Path, names: Names, sqlite: Path) -> None:
    """Pass the names through the commands. Raises AssertionError after a difference."""
    home.mkdir()
    os.chdir(home)
    for number, clip in enumerate(names.clips):
        write_clip(home / "motion" / f"{clip}.npz", synthesize_clip(ACTIVITIES[number], number, seconds=2))
    Path(f"{names.plugin}.py").write_text(PLUGIN)
    sweep = home / f"{names.sweep}.yaml"
    overrides = [make_override("data.root", str(home / "motion")), make_override("plugins", names.plugin)]
    overrides[1] = f"plugins=[{overrides[1].partition('=')[2]}]"
    content = {"base": [*SMALL, *overrides], "variants": {names.variant: []}, "seeds": [0]}
    sweep.write_text(yaml.safe_dump(content), "utf-8")
    call("sweep", str(sweep), "--workers", "1", "executor=debug")
    (run,) = [run for run in list_runs(home / "outputs") if run.manifest["kind"] == "memmlp"]
    call("train", *SMALL, *overrides)
    assert len(list_runs(home / "outputs")) == 1, "train makes another run"
    for path in run.evaluations.iterdir():
        tested = {clip["name"] for clip in read_report(path)["clips"]}
        assert tested, "no clips"
        assert tested <= set(names.clips), tested
    call("runs", "tag", run.id, names.tag)
    assert read_notes(run).tags == (names.tag,)
    assert run.id in call("runs", "list", "--where", f"tag={names.tag}")
    check_tables(sweep, names)
    check_page(home / "outputs", sweep, names)
    check_loggers(home / "outputs", run, names, sqlite)
    check_archive(home, run, names)


def check_tables(sweep: Path, names: Names) -> None:
    """Check the label in each format of the table."""
    rows = json.loads(call("table", str(sweep), "--format", "json"))["rows"]
    assert [row["label"] for row in rows] == [names.variant]
    markdown = MarkdownIt("commonmark").enable(["table", "strikethrough"])
    tokens = markdown.parse(call("table", str(sweep), "--format", "md"))
    shown = {"".join(child.content for child in token.children or ()) for token in tokens}
    assert " ".join(names.variant.split()) in {" ".join(text.split()) for text in shown}
    assert escape_latex(names.variant) in call("table", str(sweep), "--format", "tex")
    call("table", str(sweep))


def check_page(outputs: Path, sweep: Path, names: Names) -> None:
    """Check the sweep's, the run's and the clips' names on the page and in the report."""
    answers = Answers(outputs, lambda *words: {})
    (row,) = answers.answer("sweeps", {})["sweeps"]
    cells = answers.answer(f"sweeps/{row['name']}", {})["cells"]
    assert row["title"] == names.sweep
    assert [cell["variant"] for cell in cells] == [names.variant]
    (found,) = answers.answer("runs", {})["rows"]
    assert found["tags"] == [names.tag]
    assert {clip["name"] for clip in answers.answer(f"run/{found['id']}", {})["clips"]} <= set(names.clips)
    call("report", "--no-replays")


def check_loggers(outputs: Path, run: Run, names: Names, sqlite: Path) -> None:
    """Check the tag and the clips' folder in the real clients' own records."""
    shutil.copy(sqlite, outputs / "mlflow.db")
    call("loggers", "sync", "--logger", "mlflow", "--logger", "tensorboard")
    with MLflow(None, outputs).client() as (client, experiment):
        (shown,) = client.search_runs([experiment])
    tags = {value for key, value in shown.data.tags.items() if key.startswith("memmlp.label.")}
    assert (tags, shown.data.params["data.root"]) == ({names.tag}, str(outputs.parent / "motion"))
    assert list((outputs / "tensorboard").iterdir())


def check_archive(home: Path, run: Run, names: Names) -> None:
    """Check that an exported run is imported as it was."""
    call("runs", "export", run.id, "--out", str(home / f"{names.sweep}.zip"))
    there = home / "there" / names.folder
    call("runs", "import", str(home / f"{names.sweep}.zip"), "--outputs", str(there))
    (copy,) = list_runs(there)
    assert (copy.id, read_notes(copy).tags, copy.config) == (run.id, (names.tag,), run.config)


if __name__ == "__main__":
    main()
