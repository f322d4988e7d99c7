"""Frontiers are of the measured compute, latency and errors, and their pictures show every network."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import fake_run, table_of

from docs.results.frontiers import draw_frontiers, list_costs, list_points
from docs.results.make_pages import draw_pictures, make_pages
from docs.results.table_page import KeptTable
from memmlp.common.text_formats import parse_csv
from memmlp.report.kept_results import KeptResults
from memmlp.report.tables.table import Cell, Table
from memmlp.sweep.sweep_file import parse_sweep

CONTENT = {
    "seeds": [0, 1],
    "metrics": ["MPJRE", "MPJPE"],
    "variants": {"Mem-MLP": [], "RPM": ["model=rpm"], "VAE-HMD": ["model=vae_hmd"]},
    "axes": {"optim.tflop": [5, 20]},
}


@pytest.fixture
def table(tmp_path: Path) -> Table:
    sweep = parse_sweep("budgets", CONTENT)
    runs = {}
    for number, variant in enumerate(sweep.variants):
        budget = 5.0 if variant.cell == ("optim.tflop=5",) else 20.0
        for seed in sweep.seeds:
            origin = {"tflop": budget + 0.1 * seed}
            runs[variant.label, seed] = fake_run(
                tmp_path, variant.label, seed, 1 + 0.1 * number, origin=origin
            )
    return table_of(sweep, lambda variant, seed: runs[variant.label, seed])


def test_points_are_the_cells_of_a_network_by_budget(table: Table):
    assert list_costs(table) == ["tflop"]
    points = list(list_points(table, "tflop"))
    assert [point.series for point in points] == ["Mem-MLP"] * 2 + ["RPM"] * 2 + ["VAE-HMD"] * 2
    assert [point.cost for point in points] == pytest.approx([5.05, 20.05] * 3)
    rows = {row.label: row for row in table.rows}
    for point in points:
        cell = rows[point.label].cells["stream"]["MPJPE"]
        assert (point.mean, point.low, point.high) == (cell.mean, cell.low, cell.high)
        assert point.low < point.mean < point.high
    assert rows["RPM, optim.tflop=5"].costs["seconds"] == 300
    fewer = replace(table, rows=table.rows[:-1])  # one network with one budget
    assert {point.series for point in list_points(fewer, "tflop")} < {point.series for point in points}


def test_one_budget_needs_latencies_for_a_frontier(table: Table):
    def with_costs(**costs: float) -> Table:
        rows = [
            replace(row, costs={key: x * 2**i for key, x in costs.items()})
            for i, row in enumerate(table.rows)
        ]
        rows = [replace(row, costs=row.costs | {"tflop": 5.0} if costs else {}) for row in rows]
        return replace(table, metrics=("MPJPE", "ratio"), rows=tuple(rows))

    assert list_costs(with_costs(ratio=0.1)) == ["ratio"]
    assert list_costs(with_costs(parameters=1)) == list_costs(with_costs()) == []
    assert list_costs(replace(with_costs(ratio=0.1), metrics=("MPJPE",))) == []
    timed = with_costs(parameters=1)  # some seeds were not timed, so the cells have times, and the costs none
    cells = [
        row.cells | {"stream": {**row.cells["stream"], "ratio": Cell({0: 0.1 * 2**i})}}
        for i, row in enumerate(timed.rows)
    ]
    rows = [replace(row, cells=one) for row, one in zip(timed.rows, cells, strict=True)]
    assert list_costs(replace(timed, rows=tuple(rows))) == ["ratio"]


def test_the_page_has_a_picture_and_its_file_the_costs(table: Table):
    """The picture is the same each time, with a line for each network. It joins pages by their budgets."""
    halves = [replace(table, rows=tuple(row for row in table.rows if f"={n}" in row.label)) for n in (20, 5)]
    both = [KeptResults("budgets", ("seed=1", f"optim.tflop={number}"), {}, {}) for number in (20, 5)]
    pages = zip(("budgets", "few"), both, halves, strict=True)
    sources = {name: KeptTable(kept, half, lambda *_: table) for name, kept, half in pages}
    made = make_pages(sources, {})
    assert "(budgets_frontier.svg)" in made["budgets.md"]
    costs = {(one["variant"], one["metric"]): one["mean"] for one in parse_csv(made["tables/budgets.csv"])}
    assert float(costs["RPM, optim.tflop=20", "tflop"]) == pytest.approx(20.05)
    assert costs["RPM, optim.tflop=20", "seconds"] == "300"
    (picture,) = draw_pictures(sources).values()
    assert "_frontier.svg" not in made["few.md"]
    assert picture == draw_frontiers(table)
    weighed = KeptTable(replace(both[1], weigh_groups=True), halves[1], lambda *_: table)
    assert draw_pictures(sources | {"few": weighed}).get("budgets_frontier.svg") != picture
    assert len(set(re.findall(rb"<!-- (Mem-MLP|RPM|VAE-HMD) -->", picture))) == 3
