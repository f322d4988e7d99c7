"""What a person sees at the end of a run."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from memmlp.pipeline import Outcome
from memmlp.units import UNITS

BRANCHES = ("rotation", "position", "combined")
COLUMNS = [(mode, branch) for mode in ("stream", "window") for branch in BRANCHES]


def show(outcome: Outcome) -> None:
    """Print a run's metrics in both modes, its latency and sizes, and what to look at next."""
    console = Console(highlight=False)
    run, results = outcome.run, outcome.run.results
    if not outcome.fresh:
        console.print(f"run {run.id} is finished already; nothing was done (force=true does it again)")
    console.print(metrics_table(results))
    measured = results["latency"]
    console.print(
        f"a frame on one CPU core: {measured['median_ms']:.2f} ms median, {measured['p95_ms']:.2f} ms p95 "
        f"({measured['ratio_to_reference']:.2f} x the reference network)",
        soft_wrap=True,
    )
    console.print(
        f"{measured['parameters'] / 1e6:.2f} M parameters "
        f"({measured['parameters_with_vqvae'] / 1e6:.2f} M with the frozen VQ-VAE), "
        f"{measured['macs'] / 1e6:.0f} MMAC a frame, ONNX {measured['onnx_bytes'] / 1e6:.1f} MB",
        soft_wrap=True,
    )
    console.print(f"run      {run.folder}", soft_wrap=True)
    console.print(f"picture  {run.folder / 'poses.png'}", soft_wrap=True)


def metrics_table(results: dict[str, Any]) -> Table:
    """The test metrics by mode and branch."""
    columns = [(mode, branch) for mode, branch in COLUMNS if branch in results.get(mode, {})]
    table = Table(title="test clips", title_justify="left")
    table.add_column("metric")
    table.add_column("unit")
    for mode, branch in columns:
        table.add_column(f"{mode}\n{branch}", justify="right")
    for name, unit in UNITS.items():
        values = [results[mode][branch].get(name) for mode, branch in columns]
        table.add_row(name, unit, *("-" if value is None else f"{float(value):.2f}" for value in values))
    return table
