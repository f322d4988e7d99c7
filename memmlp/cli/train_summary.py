"""The summary that `memmlp train` prints at the end of a run."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Column, Table
from rich.text import Text

from memmlp.common.processes import MIN_CORE_FRACTION
from memmlp.common.text_formats import make_console
from memmlp.evaluation.metric_facts import AUTHORS, UNITS
from memmlp.report.tables.measured_run import CORE_FRACTION_KEYS, Errors, MeasuredRun, load_measured_run
from memmlp.report.tables.table_text import describe_missing_clips
from memmlp.runs.deployment_folder import (
    MAX_GROWTH,
    MAX_JITTER_GROWTH,
    find_deployed_precision,
    is_accurate_enough,
    select_deployed_measurements,
)
from memmlp.runs.lookup import count_training_frames, warn_if_hardly_trained
from memmlp.runs.run import Run
from memmlp.sweep.definition import BRANCHES
from memmlp.training.request import Outcome

STAGES = ("training", "evaluation", "deployment")
MODES_AND_BRANCHES = [(mode, branch) for mode in ("stream", "window") for branch in (*BRANCHES, AUTHORS)]


def show(outcome: Outcome) -> None:
    """Print a run's metrics in both modes, its latency and sizes if measured, and its folder."""
    run, results = outcome.run, outcome.results
    lines: list[Any] = [describe_stages(outcome), *map(format_warning, list_run_warnings(run))]
    lines += make_all_metrics_tables(run, results, outcome.stage_ids)
    if "latency" in results:
        lines += describe_latency(results["latency"])
    lines.append(f"run      {run.folder}")
    if run.picture.exists():  # it needs matplotlib
        lines.append(f"picture  {run.picture}")
    console = make_console()  # a folder's name may have brackets
    for line in lines:
        console.print(line, soft_wrap=not isinstance(line, Table))


def format_warning(line: str) -> Text:
    return Text(line, style="yellow")


def list_run_warnings(run: Run) -> Iterator[str]:
    if partial := run.manifest.get("partial"):
        yield f"incomplete data: {partial}"
    if changed := run.changed_sources:
        names = ", ".join(changed[:5]) + (f" and {len(changed) - 5} more" if len(changed) > 5 else "")
        yield (
            f"the code of {names} has changed since run {run.id}, without a new component version; "
            "force=true repeats the run"
        )
    if remark := warn_if_hardly_trained(count_training_frames(run)):
        yield remark


def describe_latency(record: Mapping[str, Any]) -> Iterator[str | Text]:
    measured, precision = select_deployed_measurements(record), find_deployed_precision(record)
    lower = precision != "fp32"
    file = f" in {precision}" if lower else ""
    yield (
        f"a frame on one CPU core{file}: {measured['median_ms']:.2f} ms median, "
        f"{measured['p95_ms']:.2f} ms p95 ({measured['ratio_to_yardstick']:.2f} x the yardstick"
        + (f", fp32 {record['median_ms']:.2f} ms)" if lower else ")")
    )
    cost = record.get(precision) or {}
    if precision == "int8" and "jitter_growth" in cost and not is_accurate_enough(cost):
        yield format_warning(
            f"{precision}: MPJPE {cost['growth']:+.1%}, Jitter {cost['jitter_growth']:+.1%}, more than "
            f"{MAX_GROWTH:.0%} and {MAX_JITTER_GROWTH:.0%}: memmlp live uses float32"
        )
    if (share := min(measured.get(key, 1.0) for key in CORE_FRACTION_KEYS.values())) < MIN_CORE_FRACTION:
        yield format_warning(
            f"the machine was busy: a core was available {share:.0%} of the time, so the times are too long"
        )
    if "pose_median_ms" in measured:
        yield (
            f"an end-to-end pose, trackers to joints: {measured['pose_median_ms']:.2f} ms median, "
            f"{measured['pose_p95_ms']:.2f} ms p95 (timed with the network in the caches)"
        )
    trained, whole = measured["parameters"], measured["parameters_with_vqvae"]
    others = f" ({whole / 1e6:.2f} M including frozen and training-only parts)" if whole != trained else ""
    yield (
        f"{trained / 1e6:.2f} M parameters{others}, {measured['macs'] / 1e6:.3g} MMAC a frame, "
        f"ONNX file {measured['onnx_bytes'] / 1e6:.1f} MB, graph included"
    )


def describe_stages(outcome: Outcome) -> str:
    if not outcome.new_stages:
        return f"run {outcome.run.id} is finished already; nothing was done (force=true repeats it)"
    stages = [stage for stage in STAGES if stage != "deployment" or "latency" in outcome.results]
    before = [stage for stage in stages if stage not in outcome.new_stages]
    ending = f"; {' and '.join(before)} done before" if before else ""
    return f"run {outcome.run.id}: {', '.join(outcome.new_stages)} done{ending}"


def make_all_metrics_tables(run: Run, results: Errors, stages: Sequence[str]) -> Iterator[Table]:
    """Yield a table of the metrics on all test clips, and one for each source if there are several."""
    measured = load_measured_run(run.folder, stages)
    yield make_metrics_table(replace(measured, means=results))
    for source, part in measured.split_by_source().items():
        yield make_metrics_table(part, f"test clips of {source} ({len(part.clips)})")


def make_metrics_table(measured: MeasuredRun, title: str = "test clips") -> Table:
    """Make a table with a column for each mode and branch. A mean over a part of the clips is marked."""
    means = measured.means
    shown = [(mode, branch) for mode, branch in MODES_AND_BRANCHES if branch in means.get(mode, {})]
    if measured.has_one_branch:  # the errors of both branches are equal
        shown = [(mode, branch) for mode, branch in shown if branch != "position"]
    columns = [Column("metric"), Column("unit")]
    columns += [Column(f"{mode}\n{branch}", justify="right") for mode, branch in shown]
    style: dict[str, Any] = {"box": SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
    table = Table(*columns, title=title, title_justify="left", **style)
    for metric, unit in UNITS.items():
        values = [means[mode][branch].get(metric) for mode, branch in shown]
        if any(value is not None for value in values):  # not every column has custom metrics
            counts = [measured.count_clips(mode, branch, metric) for mode, branch in shown]
            numbers = (
                "-" if value is None else f"{float(value):.2f}{describe_missing_clips(*count)}"
                for value, count in zip(values, counts, strict=True)
            )
            table.add_row(metric, unit, *numbers)
    return table
