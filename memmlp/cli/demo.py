"""`memmlp demo`: a shipped network on a real clip, then a small ablation, in about a minute."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option, overrides_argument
from memmlp.cli.sweep import run_workers
from memmlp.cli.table import SHOWN_MODES, ShownSweep, make_plan_table, print_tables
from memmlp.cli.workers import Workers, split_executor
from memmlp.common.errors import InputError
from memmlp.common.text_formats import join_command
from memmlp.config.compose_plan import find_sweep, make_plan
from memmlp.runs.lookup import DEFAULT, find_shipped, find_shipped_clip, read_card
from memmlp.runs.run import Run

if TYPE_CHECKING:
    from memmlp.report.pictures.clip_pictures import ClipPiece

ABLATION = "demo"
"""The sweep that the demo runs."""


@click.command("demo")
@overrides_argument
@outputs_option
def demo(overrides: tuple[str, ...], outputs: Path) -> None:
    """See a trained network on a real clip, then train and compare two small ones, in about a minute.

    The ablation trains Mem-MLP with and without memory on synthetic motion, two seeds each. OVERRIDES are
    those of `memmlp train`, for the ablation. A repeated demo continues an interrupted one.
    """
    began = time.monotonic()
    folder = outputs.absolute() / "demo"
    folder.mkdir(parents=True, exist_ok=True)
    show_clip(folder, began)
    run = run_ablation(overrides, outputs.absolute())
    export_network(run, outputs.absolute(), folder)
    click.echo(f"\nthe demo took {time.monotonic() - began:.0f} s")
    sweep = join_command(["memmlp", "sweep", ABLATION, *overrides, "seed=0,1,2,3,4"])
    click.echo("next:")
    click.echo("  memmlp live  # the network of part 1, moving in the browser")
    click.echo(f"  {sweep}  # more seeds, for narrower intervals")
    click.echo("  memmlp data import BVH_FOLDER --out outputs/data/mine  # your own recordings")


def show_clip(folder: Path, began: float) -> None:
    from memmlp.report.pictures.clip_pictures import write_picture

    card, path = read_card(DEFAULT), folder / "clip.svg"
    piece = predict_shipped_clip(card["title"])
    write_picture(path, piece, 5)
    click.echo(f"1. {card['title']} on {piece.title}: a real recording of a person not in the training data")
    click.echo(f"   mean error of the 22 joints: {piece.errors[card['title']].mean():.1f} cm")
    click.echo(f"   picture, after {time.monotonic() - began:.0f} s: {path}")
    click.echo("   see it move: memmlp live")


def predict_shipped_clip(label: str) -> ClipPiece:
    """Return the shipped clip with the prediction of the network DEFAULT's ONNX file, frame by frame."""
    from memmlp.deploy.onnx_stream import OnnxStream
    from memmlp.deploy.parity import stream_onnx
    from memmlp.evaluation.modes import extract_positions
    from memmlp.motion.body import SPARSE_DIM, load_rest_joints
    from memmlp.motion.motion_source import ShippedMotion
    from memmlp.report.pictures.clip_pictures import ClipPiece

    run, path = find_shipped(DEFAULT), find_shipped_clip()
    assert run is not None
    clip = ShippedMotion(path, load_rest_joints("builtin")).open("test").read_clip(0)
    truth, motion = clip[:, SPARSE_DIM:], stream_onnx(OnnxStream(run.preferred_onnx), clip)
    return ClipPiece(path.stem, extract_positions(truth).numpy(), {label: extract_positions(motion).numpy()})


def run_ablation(overrides: Sequence[str], outputs: Path) -> Run:
    """Finish the demo's sweep, print its table, and return the first run of its control."""
    executor, settings, overrides = split_executor(overrides)
    chosen = find_sweep(ABLATION, overrides)
    click.echo("\n2. an ablation on synthetic motion: Mem-MLP with and without its memory, two seeds each")
    plan = make_plan(chosen, outputs, prepare=True)
    if plan.list_remaining():
        run_workers(chosen, plan, Workers(executor, settings))
    command = join_command(["memmlp", "sweep", ABLATION, *overrides])
    shown = ShownSweep(chosen, plan, None)
    print_tables([make_plan_table(shown, SHOWN_MODES["stream"], command).table])
    run = next(plan.get_run(entry) for entry in plan.entries if entry.label == chosen.control)
    if not run.done:
        raise InputError(f"run {run.id}: {run.fault or 'is not finished'}; memmlp sweep {ABLATION} --retry")
    return run


def export_network(run: Run, outputs: Path, folder: Path) -> None:
    from memmlp.cli.export import ExportForm, write_exact
    from memmlp.config.open_run import open_run
    from memmlp.deploy.latency import measure_step_times

    file = folder / "mem_mlp.onnx"
    line = write_exact(open_run(outputs, run.id), file, ExportForm("auto", "fp32", 18, None))
    times = measure_step_times(file)
    click.echo(f"\n3. Mem-MLP as ONNX: {file} ({file.stat().st_size / 1e6:.1f} MB, {line})")
    click.echo(f"   a frame on one core: {times['median_ms']:.2f} ms median, {times['p95_ms']:.2f} ms p95")
