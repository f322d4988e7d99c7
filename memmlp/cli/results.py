"""`memmlp results`: runs' results that are kept with the code, and the pages made from them."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import (
    config_dir_option,
    outputs_option,
    plugins_option,
    source_option,
    together_option,
)
from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.report.kept_results import Kept
    from memmlp.report.result_pages import KeptTable
    from memmlp.sweep.definition import Sweep
    from memmlp.tables.effects import RunsBySeed
    from memmlp.tables.measured_run import Measured
    from memmlp.tables.table import Table

FOLDER = Path("docs/results")


@click.group("results")
def results() -> None:
    """Keep the results of runs with the code, and make pages of them."""


@results.command("save")
@click.argument("name", metavar="SWEEP")
@click.argument("overrides", nargs=-1)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=FOLDER / "data",
    show_default=True,
    help="Folder into which the file of results is written.",
)
@click.option(
    "--untrained",
    is_flag=True,
    help="Measure networks without a run untrained; for tables of costs alone (16, 17).",
)
@click.option(
    "--kept",
    "also_kept",
    is_flag=True,
    help="Take runs that the outputs lack from other sweeps' files in --out that hold the same ones.",
)
@click.option("--name", "stem", help="Name of the file, without its ending.  [default: the sweep's name]")
@config_dir_option
@plugins_option
@outputs_option
def save_command(
    name: str,
    overrides: tuple[str, ...],
    out: Path,
    untrained: bool,
    also_kept: bool,
    stem: str | None,
    outputs: Path,
) -> None:
    """Keep a sweep's results in one small file.

    They are the per-clip results of its finished runs. SWEEP and OVERRIDES are those of `memmlp sweep`.
    Results that the file already has of other arms and seeds stay.
    """
    from memmlp.cli.shown_seeds import shown_sweep
    from memmlp.common.files import plain
    from memmlp.config.compose_plan import find_sweep, is_path
    from memmlp.report.kept_results import Kept, load_kept, overrides_of, save, without_paths
    from memmlp.tables.build_table import finished_runs
    from memmlp.tables.flag_words import listed
    from memmlp.tables.measured_run import load
    from memmlp.tables.runs_of_plan import run_finder
    from memmlp.tables.seed_rounds import as_json

    sweep = find_sweep(name, overrides)
    known = shown_sweep(sweep, overrides, outputs.absolute())
    found: Mapping[str, RunsBySeed] = finished_runs(
        known.sweep, run_finder(known.plan, functools.cache(load))
    )
    path = out / f"{stem or sweep.name}.json"
    files: tuple[str, ...] = ()
    its_own = 0
    if also_kept:
        from memmlp.config.runs_shared_by_sweeps import with_kept

        # What the file itself has stands before the same runs of other files, whose costs were measured then.
        before = _count(found)
        found = with_kept(found, known.plan, [path] if path.exists() else []).runs
        its_own = _count(found) - before
        found, files, flags, skipped = with_kept(found, known.plan, sorted(set(out.glob("*.json")) - {path}))
        known = known._replace(flags=(*known.flags, *flags))
        for line in skipped:
            click.echo(line, err=True)
    if untrained:
        from memmlp.config.untrained_costs import with_costs

        found, measured = with_costs(known.sweep, found)
        known = known._replace(flags=(*known.flags, *measured))
    words = tuple(word for word in overrides if not word.startswith("seed="))
    rounds = plain(as_json(known.rounds)) if known.rounds else None
    source = name if is_path(name) else sweep.name
    kept = Kept(source, without_paths(words), found, overrides_of(sweep), rounds, known.flags)
    if not kept.every:
        raise InputError(f"sweep {name}: no finished run to keep; make them with: {kept.command}")
    ids = {(entry.label, entry.seed): entry.id for entry in known.plan.entries}
    merged = _merged(path, load_kept(path), kept, ids) if path.exists() else kept
    save(path, merged)
    here = f"from here{''.join(f' and {origin}' for origin in files)}"
    click.echo(f"{path}: {merged.count} runs, {kept.count - its_own} of them {here}")
    if lacking := _lacking(known.sweep, merged):
        click.echo(f"missing of the sweep: {listed(lacking)}; make them with: {kept.command}")


folder_option = click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    default=FOLDER,
    show_default=True,
    help="Folder of the pages, with data/ and templates/ below it.",
)


@results.command("show")
@click.argument("name", metavar="NAME")
@source_option
@together_option
@folder_option
def show(name: str, source: str | None, together: tuple[str, ...], folder: Path) -> None:
    """Show the table of kept results, without any run; NAME is that of their page."""
    from memmlp.cli.table import on_screen
    from memmlp.report.kept_results import load_kept
    from memmlp.tables.build_table import titled

    path = folder / "data" / f"{name}.json"
    if not path.is_file():
        known = ", ".join(sorted(one.stem for one in path.parent.glob("*.json")))
        raise InputError(f"{path}: no such results; allowed is one of: {known or 'none is kept'}")
    found = _table(load_kept(path), source, together)
    on_screen([titled(found, source) if source else found])


@results.command("docs")
@folder_option
@click.option("--check", is_flag=True, help="Write nothing; exit with 1 where a page differs.")
def docs(folder: Path, check: bool) -> None:
    """Make all pages of results from what is kept.

    No training is needed. Every file of data/ gives a table's page, which counts seeds beside those of the
    sweep's definition. The templates give pages whose sentences
    take their numbers and verdicts from the tables.
    """
    from memmlp.report.result_pages import pages

    found = kept_tables(folder)
    made = pages(found, _templates(folder))
    differing = [name for name, text in made.items() if _text(folder / name) != text]
    stale = _stale(folder, made)
    if check:
        for name in [*differing, *stale]:
            click.echo(f"differs: {folder / name}; make it again with: memmlp results docs", err=True)
        if differing or stale:
            raise SystemExit(1)
    else:
        _write(folder, made, stale)
    count = f"{len(made)} page{'s' * (len(made) != 1)}"
    click.echo(f"{folder}: {count}, {len(differing)} {'differ' if check else 'written'}")


def kept_tables(folder: Path) -> dict[str, KeptTable]:
    """Return the tables of all results kept below a folder, by the stems of their files."""
    from memmlp.report.kept_results import load_kept
    from memmlp.report.result_pages import KeptTable
    from memmlp.tables.build_table import titled

    if not (folder / "data").is_dir():
        raise InputError(
            f"{folder}: has no folder data, into which memmlp results save --out {folder}/data writes"
        )
    found = {}
    for path in sorted((folder / "data").glob("*.json")):
        kept = load_kept(path)
        # Verdicts of rounds are those of all clips together, and of no source alone.
        names = () if kept.rounds else kept.sources
        by_source = tuple(titled(_table(kept, name), name) for name in names)
        found[path.stem] = KeptTable(kept, _table(kept), by_source, partial(_table, kept, None))
    return found


def _with_seeds(sweep: Sweep, kept: Kept) -> Sweep:
    """Return the sweep with the seeds of its definition, and further ones that any of the kept runs has.

    Those of the definition that are not kept are missing: one seed of five is no finished table.
    """
    seeds = sorted({*sweep.seeds, *(seed for runs in kept.runs.values() for seed in runs)})
    return sweep.with_overrides([f"seed={','.join(map(str, seeds))}"])


def _table(kept: Kept, source: str | None = None, patterns: Sequence[str] = ()) -> Table:
    """Compute the table of kept results, over the sweep's seeds and all further ones of their runs.

    Args:
        kept: the results.
        source: the only source whose test clips are shown; None for all.
        patterns: test clips that match one alike count as one group, beside the groups of the data.
    """
    from memmlp.cli.shown_seeds import flag_of_other_rounds
    from memmlp.config.compose_plan import find_sweep
    from memmlp.tables.build_table import make_table, on_source, together
    from memmlp.tables.seed_rounds import of_json

    words = tuple(word for word in kept.overrides if not word.startswith("seed="))
    sweep = replace(find_sweep(kept.sweep), command_line=words)  # tables say where it is on other data
    left_out: tuple[str, ...] = ()
    rounds = of_json(kept.rounds) if kept.rounds else None
    other = flag_of_other_rounds(rounds, sweep) if rounds else None
    if rounds and not other:
        if source or patterns:
            raise InputError("--source, --together: allowed for a fixed number of seeds, not for rounds")
        spent = rounds.spent(sweep)
        table = make_table(spent, kept.of(spent), command=f"{kept.command} --until-decided", rounds=rounds)
    else:
        sweep = _with_seeds(sweep, kept)
        runs = kept.of(sweep)
        if source is not None:
            sweep, runs, left_out = on_source(sweep, runs, source)
        runs, tied = together(runs, patterns)
        left_out = (*left_out, *tied)
        table = make_table(sweep, runs, command=kept.command)
    said = [*left_out, *([other] if other else []), *kept.flags, *_outdated(kept)]
    return replace(table, flags=(*table.flags, *said))


def _outdated(kept: Kept) -> list[str]:
    """Return a flag that names the components whose recipe versions have changed since, if any."""
    from memmlp.runs.recipe_versions import outdated

    every = [_recipes(kept, label, run) for label, runs in kept.runs.items() for run in runs.values()]
    found = sorted({words for recipes in every for words in outdated(recipes)})
    return [f"made by an earlier recipe: {', '.join(found)}"] if found else []


def _recipes(kept: Kept, label: str, run: Measured) -> dict[str, int]:
    """Return the recipe versions of an arm's kept run and its upstream runs; older files lack the latter."""
    from memmlp.runs.recipe_versions import first_of_vqvae

    words = dict(word.split("=", 1) for word in (*kept.arms.get(label, ()), *kept.overrides) if "=" in word)
    known = run.origin.every_recipe
    return {**known, **first_of_vqvae(known, words.get("vqvae.codebook"))}


def _count(runs: Mapping[str, RunsBySeed]) -> int:
    """Return the number of runs; arms that differ in their evaluation alone have the same ones."""
    return len({run.id for by_seed in runs.values() for run in by_seed.values()})


def _lacking(sweep: Sweep, kept: Kept) -> list[str]:
    """Return what kept results lack of a sweep: the arms without all seeds, with those that are missing."""
    from memmlp.tables.flags_of_runs import gaps

    runs = {arm.label: kept.runs.get(arm.label, {}) for arm in sweep.runnable()}
    lacking = {arm.label: gaps(sweep, arm, runs) for arm in sweep.runnable()}
    return [f"'{label}' seed {', '.join(map(str, seeds))}" for label, seeds in lacking.items() if seeds]


def _merged(path: Path, before: Kept, kept: Kept, ids: Mapping[tuple[str, int], str]) -> Kept:
    """Return a file's results merged with those kept now; its runs may differ from the planned ones."""
    planned = {one: run for one, run in ids.items() if one[1] not in kept.runs.get(one[0], {})}
    try:
        merged = before.merged(kept)
        merged.check_runs(planned)
        return merged
    except InputError as error:
        raise InputError(
            f"{path}: {error}; allowed is another --name or --out, or a file without them"
        ) from None


def _templates(folder: Path) -> dict[str, str]:
    paths = sorted((folder / "templates").glob("*.md"))
    return {path.name: path.read_text(encoding="utf-8") for path in paths}


def _text(path: Path) -> str | None:
    """Return a file's text; None if there is no file."""
    return path.read_bytes().decode("utf-8", "replace") if path.exists() else None


def _stale(folder: Path, made: Mapping[str, str]) -> list[str]:
    """Return the generated pages whose data or template no longer exists."""
    from memmlp.report.result_pages import MARK

    every = {path.name for path in folder.glob("*.md") if (_text(path) or "").startswith(MARK)}
    return sorted(every - made.keys())


def _write(folder: Path, made: Mapping[str, str], stale: list[str]) -> None:
    """Write the pages, and remove those whose data or template no longer exists."""
    from memmlp.common.files import atomic_write

    folder.mkdir(parents=True, exist_ok=True)
    for name, text in made.items():
        atomic_write(folder / name, text)
    for name in stale:
        (folder / name).unlink()
