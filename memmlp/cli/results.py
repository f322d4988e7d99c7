"""`memmlp results`: keep results of runs with the code, and make pages from these results."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import (
    HomePath,
    config_dir_option,
    outputs_option,
    plugins_option,
    source_option,
    together_option,
)
from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.report.kept_results import KeptResults
    from memmlp.report.result_pages import KeptTable
    from memmlp.report.tables.table import Table

FOLDER = Path("docs/results")


@click.group("results")
def results() -> None:
    """Keep the results of runs with the code, and make pages from these results."""


@results.command("save")
@click.argument("name", metavar="SWEEP")
@click.argument("overrides", nargs=-1)
@click.option("--out", type=HomePath(file_okay=False), default=FOLDER / "data", help="Folder of the file.")
@click.option(
    "--untrained",
    is_flag=True,
    help="Measure the costs of networks without a run, with random weights; only for Tables 16 and 17.",
)
@click.option("--name", "stem", help="File name without suffix.  [default: the sweep's name]")
@config_dir_option
@plugins_option
@outputs_option
def save_command(
    name: str, overrides: tuple[str, ...], out: Path, untrained: bool, stem: str | None, outputs: Path
) -> None:
    """Save the per-clip results of a sweep's finished runs in one small file.

    SWEEP and OVERRIDES are those of `memmlp sweep`. The command does not replace a file that has results of
    additional runs.
    """
    from memmlp.cli.table import load_shown_sweep
    from memmlp.common.files import make_json_safe
    from memmlp.config.compose_plan import find_sweep, is_path
    from memmlp.report.kept_results import (
        KeptResults,
        list_overrides,
        load_kept_results,
        save_results,
        shorten_paths,
    )
    from memmlp.report.tables.build_table import find_finished_runs, make_run_finder
    from memmlp.report.tables.measured_run import load_measured_run

    sweep = find_sweep(name, overrides)
    shown = load_shown_sweep(sweep, overrides, outputs.absolute())
    finder, flags = make_run_finder(shown.plan, functools.cache(load_measured_run)), shown.flags
    runs = find_finished_runs(shown.sweep, finder)
    if untrained:
        from memmlp.config.untrained_costs import measure_untrained_variants

        runs, more_flags = measure_untrained_variants(shown.sweep, runs)
        flags = (*flags, *more_flags)
    kept = KeptResults(
        name if is_path(name) else sweep.name,
        shorten_paths(word for word in overrides if not word.startswith("seed=")),
        runs,
        list_overrides(sweep),
        make_json_safe(asdict(shown.rounds)) if shown.rounds else None,
        flags,
    )
    if not kept.all_runs:
        raise InputError(f"sweep {name}: has no finished runs; run the sweep with: {kept.command}")
    path = out / f"{stem or sweep.name}.json"
    if path.exists():
        try:
            kept.check_can_replace(load_kept_results(path))
        except InputError as error:
            raise InputError(f"{path}: {error}; give another --name or --out, or remove the file") from None
    save_results(path, kept)
    click.echo(f"{path}: {kept.run_count} runs")


folder_option = click.option(
    "--folder",
    type=HomePath(file_okay=False),
    default=FOLDER,
    help="Folder of the pages, with the subfolders data and templates.",
)


@results.command("show")
@click.argument("name", metavar="NAME")
@source_option
@together_option
@folder_option
def show(name: str, source: str | None, together: tuple[str, ...], folder: Path) -> None:
    """Print the table of kept results. NAME is the name of their page; no run is needed."""
    from memmlp.cli.table import print_tables
    from memmlp.report.kept_results import load_kept_results

    path = folder / "data" / f"{name}.json"
    if not path.is_file():
        names = ", ".join(sorted(one.stem for one in path.parent.glob("*.json")))
        raise InputError(f"{path}: no such results; must be one of: {names or '(nothing is kept)'}")
    print_tables([_make_table(load_kept_results(path), source, together)])


@results.command("docs")
@folder_option
@click.option("--check", is_flag=True, help="Write nothing; exit with 1 if a page differs.")
def docs(folder: Path, check: bool) -> None:
    """Make all pages and CSV files of results from the kept results, without training.

    Each file in data/ becomes a short page with a table, and a CSV file in tables/ with all numbers. Each
    template becomes a page with numbers and verdicts from these tables.
    """
    from memmlp.common.files import atomic_write
    from memmlp.report.result_pages import FILES, MARK, draw_pictures, make_pages

    templates = {path.name: path.read_text(encoding="utf-8") for path in (folder / "templates").glob("*.md")}
    tables = make_tables(folder)
    made = make_pages(tables, templates)
    paths = [*folder.glob("*.md"), *(folder / FILES).glob("*")]
    present = {str(path.relative_to(folder)): path.read_bytes().decode("utf-8", "replace") for path in paths}
    differing = [name for name, text in made.items() if present.get(name) != text]
    old = present.keys() - made.keys()
    stale = sorted(name for name in old if present[name].startswith(MARK) or name.startswith(f"{FILES}/"))
    if check:
        for name in [*differing, *stale]:
            update = "differs from the kept results; update it with: memmlp results docs"
            click.echo(f"{folder / name}: {update}", err=True)
        if differing or stale:
            raise SystemExit(1)
    else:
        (folder / FILES).mkdir(exist_ok=True)
        for name in differing:
            atomic_write(folder / name, made[name])
        for name, picture in draw_pictures(tables).items():  # its bytes differ between matplotlib's versions
            if name.replace("_frontier.svg", ".md") in differing or not (folder / name).exists():
                atomic_write(folder / name, picture)
        for name in stale:
            (folder / name).unlink()
    click.echo(f"{folder}: {len(made)} files, {len(differing)} {'differ' if check else 'written'}")


def make_tables(folder: Path) -> dict[str, KeptTable]:
    """Return the tables of all kept results in a folder, by file stem."""
    from memmlp.report.kept_results import load_kept_results
    from memmlp.report.result_pages import KeptTable

    if not (folder / "data").is_dir():
        raise InputError(f"{folder}/data: no such folder; memmlp results save --out {folder}/data makes it")
    tables = {}
    for path in sorted((folder / "data").glob("*.json")):
        kept = load_kept_results(path)
        sources = () if kept.rounds else kept.sources  # verdicts by seed rounds need all clips
        by_source = tuple(_make_table(kept, source) for source in sources)
        tables[path.stem] = KeptTable(kept, _make_table(kept), by_source, partial(_make_table, kept, None))
    return tables


def _make_table(kept: KeptResults, source: str | None = None, patterns: Sequence[str] = ()) -> Table:
    """Compute the table of kept results for the sweep's seeds and all additional seeds with runs. With
    `source`, only its test clips count. Test clips form one group if a pattern matches the same text in their
    names."""
    from memmlp.cli.table import flag_changed_rounds
    from memmlp.config.compose_plan import find_sweep
    from memmlp.report.tables.build_table import make_table, restrict_and_group_clips
    from memmlp.report.tables.seed_rounds import Rounds
    from memmlp.runs.identity import list_outdated

    # With the command line's overrides, the table warns about changed data.
    sweep = replace(find_sweep(kept.sweep), command_line=kept.overrides)
    flags: list[str] = []
    rounds = Rounds.from_json(kept.rounds) if kept.rounds else None
    other = flag_changed_rounds(rounds, sweep) if rounds else None
    if rounds and not other:
        if source or patterns:
            raise InputError("--source, --together: need a fixed number of seeds, without --until-decided")
        spent = rounds.restrict_sweep(sweep)
        table = make_table(
            spent, kept.select_runs(spent), command=f"{kept.command} --until-decided", rounds=rounds
        )
    else:
        # Seeds without a kept run count as missing, because a table with one of five seeds is not finished.
        seeds = sorted({*sweep.seeds, *(seed for by_seed in kept.runs.values() for seed in by_seed)})
        sweep = sweep.with_overrides([f"seed={','.join(map(str, seeds))}"])
        sweep, runs, restricted = restrict_and_group_clips(sweep, kept.select_runs(sweep), source, patterns)
        flags = [*restricted, *([other] if other else [])]
        table = make_table(sweep, runs, command=kept.command)
    changed = sorted({change for run in kept.all_runs for change in list_outdated(run.origin.every_version)})
    if changed:
        flags.append(f"made with earlier component versions: {', '.join(changed)}")
    return replace(table, flags=(*table.flags, *kept.flags, *flags))


@results.command("searches")
@click.argument("folders", nargs=-1, type=HomePath(exists=True, file_okay=False))
@click.option(
    "--out",
    type=HomePath(file_okay=False),
    default=Path("searches"),
    help="Folder for trials.csv and summary.md.",
)
@outputs_option
def searches(folders: tuple[Path, ...], out: Path, outputs: Path) -> None:
    """Write the trials and the best trials of finished searches.

    FOLDERS are those of searches; by default, all finished searches below the outputs folder. trials.csv has
    a row for each trial, summary.md a row for each search.
    """
    from memmlp.common.files import atomic_write
    from memmlp.sweep.search.earlier_searches import FinishedSearch, format_summary, format_trials

    chosen = folders or sorted(path.parent for path in (outputs / "tune").glob("*/trials.csv"))
    if not chosen:
        raise InputError(f"{outputs / 'tune'}: has no finished searches; run memmlp tune")
    found = [FinishedSearch(folder.absolute()) for folder in chosen]
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / "trials.csv", format_trials(found))
    summary = "\n".join(format_summary(found))
    atomic_write(out / "summary.md", f"{summary}\n")
    click.echo(summary)
