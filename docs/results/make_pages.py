"""Make the pages of results, from the results in data/ and the templates in templates/, without training.

`python -m docs.results.make_pages` writes a short page, a CSV file and remarks for each table, and a page for
each template. With --check it writes nothing, and exits with 1 if a page differs.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import jinja2

from docs.results.all_numbers import to_csv
from docs.results.frontiers import draw_frontiers, list_costs
from docs.results.placeholders import TRIALS, Placeholders, Trial
from docs.results.table_page import FILES, KeptTable, list_all_remarks, make_page
from memmlp.cli.results import make_kept_table
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.report.kept_results import load_kept_results
from memmlp.report.tables.table import Table

HERE = Path(__file__).parent
MARK = "<!-- made by: docs/results/make_pages.py -->"


def make_pages(
    sources: Mapping[str, KeptTable], templates: Mapping[str, str], trials: Sequence[Trial] = ()
) -> dict[str, str]:
    """Return the texts of all pages and of the files beside them, by path below the folder of the pages.

    Args:
        sources: the tables by page name, without the suffix.
        templates: the templates' texts by file name.
        trials: the trials of a search at equal compute.

    Raises:
        InputError: if a template and a table have the same page name, or a placeholder has an unknown name.
    """
    for name in sorted({f"{one}.md" for one in sources} & templates.keys()):
        raise InputError(f"{name}: a template and a table's page have the same name; rename one of them")
    made, frontiers = {}, join_budgets(sources)
    for name, source in sorted(sources.items()):
        made[f"{name}.md"] = f"{MARK}\n\n{make_page(name, source, name in frontiers)}"
        made[f"{FILES}/{name}.csv"] = to_csv(source.by_clips)
    if sources:
        remarks = {name: list_all_remarks(source) for name, source in sorted(sources.items())}
        made[f"{FILES}/remarks.json"] = json.dumps(remarks, indent=1, ensure_ascii=False) + "\n"
    placeholders = Placeholders(sources, trials).collect_functions()
    return made | {name: _fill_template(name, text, placeholders) for name, text in sorted(templates.items())}


def draw_pictures(sources: Mapping[str, KeptTable]) -> dict[str, bytes]:
    """Return the pictures of all pages by file name: the frontiers."""
    return {f"{name}_frontier.svg": draw_frontiers(table) for name, table in join_budgets(sources).items()}


def join_budgets(sources: Mapping[str, KeptTable]) -> dict[str, Table]:
    """Return the tables of frontiers by page name.

    Pages that differ only in the training compute have one, on the first page, with the variants of all.
    Tables with clips of equal weight and with groups of equal weight are never in one picture.
    """
    first: dict[tuple[str, ...], str] = {}
    joined: dict[str, Table] = {}
    for name, source in sorted(sources.items()):
        others = [text for text in source.kept.overrides if not text.startswith("optim.tflop=")]
        key = source.kept.sweep, *others, *source.kept.splits, *["weighed"] * source.kept.weigh_groups
        page = first.setdefault(key, name)
        rows = joined[page].rows if page in joined else ()
        joined[page] = replace(source.table, rows=(*rows, *source.table.rows))
    return {name: table for name, table in joined.items() if list_costs(table)}


def _fill_template(name: str, text: str, placeholders: Mapping[str, object]) -> str:
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    environment.globals = dict(placeholders)
    try:
        return f"{MARK}\n\n{environment.from_string(text).render()}"
    except (jinja2.TemplateError, InputError) as error:
        raise InputError(f"{name}: {' '.join(str(error).split())}") from None


def make_tables(folder: Path) -> dict[str, KeptTable]:
    """Return the tables of all kept results in a folder, by file stem."""
    if not (folder / "data").is_dir():
        raise InputError(f"{folder}/data: no such folder; memmlp results save --out {folder}/data makes it")
    tables = {}
    for path in sorted((folder / "data").glob("*.json")):
        kept = load_kept_results(path)
        sources = () if kept.rounds else kept.sources  # verdicts by seed rounds need all clips
        by_source = tuple(make_kept_table(kept, source) for source in sources)
        regroup = partial(make_kept_table, kept, None)
        tables[path.stem] = KeptTable(kept, make_kept_table(kept), regroup, by_source)
    return tables


def update(folder: Path, check: bool) -> int:
    """Write the pages that differ, and remove old ones; with `check` only list them. Return the exit code."""
    templates = {path.name: path.read_text(encoding="utf-8") for path in (folder / "templates").glob("*.md")}
    tables, trials = make_tables(folder), folder / TRIALS
    made = make_pages(
        tables, templates, list(csv.DictReader(trials.open(newline=""))) if trials.exists() else ()
    )
    paths = [*folder.glob("*.md"), *(folder / FILES).glob("*")]
    present = {str(path.relative_to(folder)): path.read_bytes().decode("utf-8", "replace") for path in paths}
    differing = [name for name, text in made.items() if present.get(name) != text]
    old = present.keys() - made.keys()
    stale = sorted(name for name in old if present[name].startswith(MARK) or name.startswith(f"{FILES}/"))
    print(f"{folder}: {len(made)} files, {len(differing)} {'differ' if check else 'written'}")
    if check:
        for name in [*differing, *stale]:
            print(f"{folder / name}: differs from the kept results; make it again", file=sys.stderr)
        return int(bool(differing or stale))
    (folder / FILES).mkdir(exist_ok=True)
    for name in differing:
        atomic_write(folder / name, made[name])
    for name, picture in draw_pictures(tables).items():  # its bytes differ between matplotlib's versions
        if name.replace("_frontier.svg", ".md") in differing or not (folder / name).exists():
            atomic_write(folder / name, picture)
    for name in stale:
        (folder / name).unlink()
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    parser.add_argument("--folder", type=Path, default=HERE, help="folder of the pages, data and templates")
    return parser


if __name__ == "__main__":
    arguments = parser().parse_args()
    sys.exit(update(arguments.folder, arguments.check))
