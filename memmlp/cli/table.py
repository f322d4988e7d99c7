"""`memmlp table`: what was measured beside what the paper prints."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from memmlp.cli.options import outputs_option
from memmlp.errors import InputError

if TYPE_CHECKING:
    from memmlp.runs import Run
    from memmlp.sweep.plan import Plan
    from memmlp.sweep.spec import Arm, Sweep
    from memmlp.tables.collect import Find, Table
    from memmlp.tables.measured import Measured

    Read = Callable[[Path], Measured]
MODES = {"stream": ("stream",), "window": ("window",), "both": ("stream", "window")}


@click.command("table")
@click.argument("name")
@click.argument("overrides", nargs=-1)
@click.option(
    "--format", "form", type=click.Choice(["md", "tex", "json", "html"]), help="In place of the screen's."
)
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="File; its ending tells the format."
)
@click.option(
    "--mode", type=click.Choice(list(MODES)), default="both", show_default=True, help="Of evaluation."
)
@outputs_option
def table(
    name: str, overrides: tuple[str, ...], form: str | None, out: Path | None, mode: str, outputs: Path
) -> None:
    """The table of a sweep: NAME is a file's path, a shipped sweep, a table's number, or `all`.

    OVERRIDES are those that the sweep was run with; they find its runs again.
    """
    from memmlp.tables.measured import load

    with _uncollected():
        found = gathered([name], overrides, outputs, MODES[mode], functools.cache(load))
    tables = [one.table for one in found]
    if form is None and out is None:
        on_screen(tables)
        return
    text = _formatted(tables, form or _form_of(out), alone=name != "all")
    if out is None:
        click.echo(text, nl=False)
    else:
        write(out, text)


@contextmanager
def _uncollected() -> Iterator[None]:
    """No garbage collection: what is read of the runs is all kept, and searching it takes a second."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class Found(NamedTuple):
    """A sweep with what finds its runs, and its table."""

    sweep: Sweep
    find: Find
    table: Table


def gathered(
    names: Sequence[str], overrides: Sequence[str], outputs: Path, modes: Sequence[str], read: Read
) -> list[Found]:
    """The tables that some names stand for.

    A table of the paper whose config lacks something (where AMASS lies) shows the paper's values and says so.
    Raises InputError where none can be composed with the command line's overrides.
    """
    from memmlp.tables.collect import collect, nothing, without_runs

    found, failures = [], []
    for sweep, command in chosen(names, overrides):
        try:
            find = finder(sweep, outputs)
            found.append(Found(sweep, find, collect(sweep, find, modes, command, read)))
        except InputError as error:
            failures.append(error)
            table = without_runs(sweep, modes, f"nothing measured: {error}")
            found.append(Found(sweep, nothing, table))
    if failures and (overrides or found[0].sweep.table is None) and len(failures) == len(found):
        raise failures[0]
    return found


def chosen(names: Sequence[str], overrides: Sequence[str]) -> list[tuple[Sweep, str]]:
    """The sweeps of some names, with the command line's overrides, and the commands that run them."""
    from memmlp.cli.plan import find_sweep
    from memmlp.cli.shipped import shipped

    tables = sorted(path.stem for path in shipped("sweeps").glob("table*.yaml"))
    every = [one for name in names for one in (tables if name == "all" else [name])]
    return [
        (find_sweep(one).with_overrides(overrides), " ".join(["memmlp sweep", one, *overrides]))
        for one in every
    ]


def finder(sweep: Sweep, outputs: Path) -> Find:
    """What finds the sweep's runs. Raises InputError where its config is wrong."""
    from memmlp.cli.plan import planned

    return finder_in(planned(sweep, outputs.absolute()))


def finder_in(plan: Plan) -> Find:
    """What finds the runs of a planned sweep."""
    runs = {(entry.label, entry.seed): plan.run_of(entry) for entry in plan.entries}

    def find(arm: Arm, seed: int) -> Run | None:
        return runs.get((arm.label, seed))

    return find


def on_screen(tables: Sequence[Table]) -> None:
    """Show tables as wide as the screen."""
    from rich.console import Console

    from memmlp.tables.render import show

    console = Console(highlight=False, markup=False)
    for one in tables:
        show(one, console)


def _formatted(tables: Sequence[Table], form: str, alone: bool) -> str:
    """The tables' text; of JSON one object, or a list for `all`."""
    from memmlp.tables.render import FORMATS

    texts = [FORMATS[form](one) for one in tables]
    if form == "json" and not alone:
        return "[\n" + ",\n".join(text.rstrip() for text in texts) + "\n]\n"
    return "\n".join(texts)


def _form_of(out: Path | None) -> str:
    """The format that a file's ending tells."""
    from memmlp.tables.render import FORMATS

    ending = out.suffix.removeprefix(".") if out else ""
    if ending not in FORMATS:
        raise InputError(f"--out {out}: allowed endings are {', '.join(FORMATS)}, or any with --format")
    return ending


def write(out: Path, text: str) -> None:
    """Write a file that the command line asks for, and say where."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror or error}") from None
    click.echo(str(out))
