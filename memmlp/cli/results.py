"""`memmlp results`: keep the results of runs in small files, and show their tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import (
    HomePath,
    add_clip_options,
    add_run_options,
    config_dir_option,
    overrides_argument,
    untrained_option,
    weigh_groups_option,
)
from memmlp.cli.table import find_shown_runs, flag_changed_rounds, load_shown_sweep, print_tables
from memmlp.common.errors import InputError
from memmlp.common.files import make_json_safe
from memmlp.common.text_formats import join_command
from memmlp.config.compose_plan import find_sweep, is_path
from memmlp.runs.identity import list_outdated

if TYPE_CHECKING:
    from memmlp.report.kept_results import KeptResults
    from memmlp.report.tables.table import Table

FOLDER = Path("docs/results")


@click.group("results")
def results() -> None:
    """Keep the results of runs in small files, and show their tables."""


@results.command("save")
@click.argument("name", metavar="SWEEP")
@overrides_argument
@click.option("--out", type=HomePath(file_okay=False), default=FOLDER / "data", help="Folder to write to.")
@untrained_option
@click.option("--name", "stem", help="File name without suffix.  [default: the sweep's name]")
@config_dir_option
@add_run_options
def save_command(
    name: str, overrides: tuple[str, ...], out: Path, untrained: bool, stem: str | None, outputs: Path
) -> None:
    """Save the per-clip results of a sweep's finished runs in one small file.

    SWEEP and OVERRIDES are those of `memmlp sweep`. The command does not replace a file that has results of
    additional runs.
    """
    from memmlp.report.kept_results import KeptResults, list_overrides, shorten_paths
    from memmlp.report.tables.flags import flag_missing_runs

    sweep = find_sweep(name, overrides)
    shown = load_shown_sweep(sweep, overrides, outputs.absolute())
    runs, flags = find_shown_runs(shown, untrained)
    kept = KeptResults(
        name if is_path(name) else sweep.name,
        shorten_paths(word for word in overrides if not word.startswith("seed=")),
        runs,
        list_overrides(sweep),
        make_json_safe(asdict(shown.rounds)) if shown.rounds else None,
        flags,
    )
    command = join_command(["memmlp", "sweep", name, *overrides])
    if not kept.all_runs:
        raise InputError(f"sweep {name}: has no finished runs; run the sweep with: {command}")
    _save_over_fewer(out / f"{stem or sweep.name}.json", kept)
    for line in flag_missing_runs(shown.sweep, runs, command, lambda variant, seed: ""):
        click.echo(line)


def _save_over_fewer(path: Path, kept: KeptResults) -> None:
    from memmlp.report.kept_results import load_kept_results, save_results

    if path.exists():
        try:
            kept.check_can_replace(load_kept_results(path))
        except InputError as error:
            raise InputError(f"{path}: {error}; give another --name or --out, or remove the file") from None
    save_results(path, kept)
    click.echo(f"{path}: {kept.run_count} runs")


@results.command("join")
@click.argument("names", nargs=-1, required=True, metavar="NAME...")
@click.option("--name", "stem", required=True, help="File name without suffix.")
@weigh_groups_option
@click.option("--folder", type=HomePath(file_okay=False), default=FOLDER, help="Its data/ has the results.")
def join(names: tuple[str, ...], stem: str, weigh_groups: bool, folder: Path) -> None:
    """Join kept results of one sweep: of other seeds, or of other splits.

    NAMEs are the names of their files. Test clips of splits with other persons (data.split.seed) are pooled,
    so that differences are tested on the persons of all splits.
    """
    from memmlp.report.joined_results import join_results

    parts = [_load_named(folder, name) for name in names]
    joined = replace(join_results(parts), weigh_groups=weigh_groups)
    _save_over_fewer(folder / "data" / f"{stem}.json", joined)


def _load_named(folder: Path, name: str) -> KeptResults:
    from memmlp.report.kept_results import load_kept_results

    path = folder / "data" / f"{name}.json"
    if not path.is_file():
        found = ", ".join(sorted(one.stem for one in path.parent.glob("*.json")))
        raise InputError(f"{path}: no such results; must be one of: {found or '(nothing is kept)'}")
    return load_kept_results(path)


@results.command("show")
@click.argument("name", metavar="NAME")
@add_clip_options
@click.option("--folder", type=HomePath(file_okay=False), default=FOLDER, help="Its data/ has the results.")
def show(name: str, source: str | None, together: tuple[str, ...], weigh_groups: bool, folder: Path) -> None:
    """Print the table of kept results. NAME is the name of their file; no run is needed."""
    kept = _load_named(folder, name)
    table = make_kept_table(kept, source, together, weigh_groups)
    splits = ", ".join(split or "the default split" for split in kept.splits)
    pooled = (f"test clips of several splits are pooled: {splits}",) if splits else ()
    print_tables([replace(table, flags=(*pooled, *table.flags))])


def make_kept_table(
    kept: KeptResults,
    source: str | None = None,
    patterns: Sequence[str] = (),
    weigh_groups: bool = False,
) -> Table:
    """Compute the table of kept results for the sweep's seeds and all additional seeds with runs."""
    from memmlp.report.tables.build_table import make_table, restrict_and_group_clips
    from memmlp.report.tables.seed_rounds import Rounds

    # With the command line's overrides, the table warns about changed data.
    sweep = replace(find_sweep(kept.sweep), command_line=kept.overrides)
    if kept.splits:  # variants without runs in all splits are left out
        variants = tuple(one for one in sweep.variants if one.label in kept.variants)
        control = sweep.control if sweep.control in kept.variants else variants[0].label
        sweep = replace(sweep, variants=variants, control=control)
    flags: list[str] = []
    rounds = Rounds.from_json(kept.rounds) if kept.rounds else None
    other = flag_changed_rounds(rounds, sweep) if rounds else None
    if rounds and not other:
        if source or patterns or weigh_groups:
            options = "--source, --together, --weigh-groups"
            raise InputError(f"{options}: need a fixed number of seeds, without --until-decided")
        spent = rounds.restrict_sweep(sweep)
        table = make_table(
            spent, kept.select_runs(spent), command=f"{kept.command} --until-decided", rounds=rounds
        )
    else:
        # Seeds without a kept run count as missing, because a table with one of five seeds is not finished.
        seeds = sorted({*sweep.seeds, *(seed for by_seed in kept.runs.values() for seed in by_seed)})
        sweep = sweep.with_overrides([f"seed={','.join(map(str, seeds))}"])
        sweep, runs, restricted = restrict_and_group_clips(
            sweep, kept.select_runs(sweep), source, patterns, weigh_groups or kept.weigh_groups
        )
        flags = [*restricted, *([other] if other else [])]
        table = make_table(sweep, runs, command=kept.command_for_all_splits)
    changed = sorted({change for run in kept.all_runs for change in list_outdated(run.origin.every_version)})
    if changed:
        flags.append(f"made with earlier component versions: {', '.join(changed)}")
    return replace(table, flags=(*table.flags, *kept.flags, *flags))
