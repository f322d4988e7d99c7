"""`memmlp export`: write the ONNX file of a finished run, and check it against torch."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from memmlp.cli.options import PATH, add_run_options
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, file_digest
from memmlp.common.progress import announce
from memmlp.runs.lookup import find_run
from memmlp.runs.run import Run

if TYPE_CHECKING:
    from memmlp.config.open_run import OpenedRun
    from memmlp.networks.motion_model import MotionModel, StreamingGraph

FULL_TOLERANCE = 0.1
"""Maximum deviation in metres or rotation matrix entries. Broken files exceed it, fp16 files do not."""


class ExportForm(NamedTuple):
    """The requested form of an ONNX file. `full` is the frame of reference and the format of the joints'
    rotations for a file that computes joints from tracker poses; None for the network's step."""

    graph: str
    precision: str
    opset: int
    full: tuple[str, str] | None


@click.command("export")
@click.argument("run")
@click.option("--out", required=True, type=PATH, help="ONNX file to write.")
@click.option(
    "--graph",
    default="auto",
    type=click.Choice(["auto", "streaming", "naive"]),
    help="Graph to export. streaming: computes each frame's features once and keeps them as state; naive: "
    "the network as trained; auto: streaming if available, otherwise naive.",
)
@click.option(
    "--precision",
    default="fp32",
    type=click.Choice(["fp32", "fp16", "int8"]),
    help="Precision of the inner layers' weights. The accuracy of lower precisions is measured on test "
    "clips. int8 is calibrated on training clips.",
)
@click.option(
    "--max-growth",
    type=float,
    help="Maximum increase of MPJPE by lower precision, percent; otherwise no file is written.  [default: 1]",
)
@click.option(
    "--opset",
    default=18,
    type=click.IntRange(15, 26),
    help="ONNX operator set of the file; Unity's inference engine supports up to 15.",
)
@click.option(
    "--scope",
    default="step",
    type=click.Choice(["step", "full"]),
    help="Computation in the file. step: the network's step, from its 54 inputs; full: all computations from "
    "tracker poses to joints.",
)
@click.option(
    "--space",
    type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of the poses, with --scope full.  [default: amass]",
)
@click.option(
    "--rotations",
    type=click.Choice(["matrix", "quaternion"]),
    help="Format of the joints' rotations, with --scope full; quaternions are x, y, z, w.  [default: matrix]",
)
@add_run_options
def export(
    run: str,
    out: Path,
    graph: str,
    precision: str,
    max_growth: float | None,
    opset: int,
    scope: str,
    space: str | None,
    rotations: str | None,
    outputs: Path,
) -> None:
    """Export a finished run as ONNX, and check the file on whole test clips.

    RUN is an id, the beginning of an id, a folder, or a shipped network. If the run already has a checked
    file of this form, the command copies it.
    """
    if out.suffix != ".onnx":
        raise InputError(f"--out {out}: must end in .onnx")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    if scope == "step" and (space or rotations):
        option = f"--space {space}" if space else f"--rotations {rotations}"
        raise InputError(f"{option}: needs --scope full, since the other scope has AMASS' axes (Z up)")
    if precision == "fp32" and max_growth is not None:
        raise InputError(f"--max-growth {max_growth:g}: needs --precision fp16 or int8")
    if precision == "int8" and scope == "full":
        raise InputError(f"--precision {precision}: needs --scope step")
    full = (space or "amass", rotations or "matrix") if scope == "full" else None
    form, limit = ExportForm(graph, precision, opset, full), 0.01 if max_growth is None else max_growth / 100
    line = copy_deployed(find_run(outputs, run), out, form, limit)
    if line is None:
        from memmlp.config.open_run import open_run

        opened, exact = open_run(outputs, run), precision == "fp32"
        line = write_exact(opened, out, form) if exact else write_lower(opened, out, form, limit)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {line}")


def copy_deployed(run: Run, out: Path, form: ExportForm, max_growth: float) -> str | None:
    """Copy a deployment's file of the requested form; return a line about its check, or None without one."""
    for folder in sorted(run.deployments.glob("*")):
        deployed = run.deployment(folder.name)
        record, settings, path = deployed.record, deployed.settings, deployed.onnx_path(form.precision)
        graphs = settings.get("graph", "auto"), record.get("graph")  # the requested one, and the exported one
        if form.full or form.graph not in graphs or form.opset != settings.get("opset", 18):
            continue
        if not (deployed.done and deployed.is_current):
            continue
        digest = record["artifacts"].get(path.name)
        if digest is None or digest != file_digest(path):
            continue
        if form.precision == "fp32":
            line = f"differs from torch by at most {record['onnx_parity']:.1e}"
        elif (cost := record[form.precision])["growth"] <= max_growth:
            line = f"on test clips {describe_cost(cost, form.precision)}"
        else:
            continue
        atomic_write(out, path.read_bytes())
        return f"copied from the run; {line}"
    return None


def describe_cost(cost: dict[str, Any], precision: str) -> str:
    names = ("MPJPE", "position MPJPE", "Jitter")
    changes = {name: f"{cost['fp32'][name]:.2f} -> {cost[precision][name]:.2f}" for name in names}
    if changes["position MPJPE"] == changes["MPJPE"]:  # without a position branch
        del changes["position MPJPE"]
    return ", ".join(f"{name} {change}" for name, change in changes.items())


def load(opened: OpenedRun, form: ExportForm) -> tuple[MotionModel, MotionModel | StreamingGraph]:
    from memmlp.deploy.deployment import GRAPHS
    from memmlp.networks.streaming import check_is_stream

    model = opened.network()
    check_is_stream(model)
    return model, GRAPHS[form.graph](model)


def write_graph(network: MotionModel | StreamingGraph, path: Path, run_id: str, form: ExportForm) -> None:
    """Write the ONNX file of the network's step, or of the full graph, in float32 without a check."""
    from memmlp.deploy.export import export as export_step
    from memmlp.live.trackers_to_body_graph import export_full

    if form.full:
        export_full(network, path, run_id, *form.full, form.opset)
    else:
        export_step(network, path, run_id, form.opset)


def write_exact(opened: OpenedRun, out: Path, form: ExportForm) -> str:
    """Write the float32 ONNX file if it matches the network on the longest test clip; return a line about
    that."""
    from memmlp.deploy.parity import TOLERANCE, are_rounding_errors, measure_differences, select_parity_clip
    from memmlp.live.trackers_to_body_graph import measure_full_graph_differences

    model, network = load(opened, form)
    clip = select_parity_clip(model, opened.data.open("test").read_clips())
    announce(f"export: write {out}, and compare it with torch on a test clip")
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        path = Path(folder) / "step.onnx"
        write_graph(network, path, opened.run.id, form)
        if form.full:
            apart = measure_full_graph_differences(model, path, clip, form.full[0])
        else:
            apart = measure_differences(model, path, clip)
        line = f"differs from torch by at most {float(apart.max()):.1e} on a test clip"
        if not are_rounding_errors(apart):
            raise click.ClickException(
                f"{out}: not written: {line}, more than {TOLERANCE:.0e}; please report this with the run's "
                "config.yaml"
            )
        path.replace(out)
    return line


def write_lower(opened: OpenedRun, out: Path, form: ExportForm, max_growth: float) -> str:
    """Write the ONNX file with lower precision if MPJPE increases at most by the fraction `max_growth`.
    Return a line about the loss of accuracy, measured for the network's step. A full graph has the same
    layers; it is also compared with torch on the first test clip."""
    from memmlp.deploy.lower_precision import compare_accuracy, write_lower_precision
    from memmlp.live.trackers_to_body_graph import measure_full_graph_differences
    from memmlp.networks.motion_model import StreamingGraph

    precision = form.precision
    model, network = load(opened, form)
    if not isinstance(network, StreamingGraph):
        raise InputError(f"--precision {precision}: needs a streaming graph")
    test = opened.data.open("test").read_clips()
    train = opened.data.open("train").read_clips() if precision == "int8" else []
    announce(f"export: write {out} in {precision}, and measure its accuracy on the test clips")
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        exact, other = Path(folder) / "fp32.onnx", Path(folder) / "other.onnx"
        write_graph(network, exact, opened.run.id, form._replace(full=None))
        write_lower_precision(precision, exact, other, network, train)
        cost = compare_accuracy(exact, other, precision, network.normalizer, test)
        line = f"on test clips {describe_cost(cost, precision)}"
        if not cost["growth"] <= max_growth:
            raise click.ClickException(f"{out}: not written: {line}; --max-growth is {100 * max_growth:g} %")
        if form.full:
            write_graph(network, exact, opened.run.id, form)
            write_lower_precision(precision, exact, other, network, train)
            apart = float(measure_full_graph_differences(model, other, test[0], form.full[0]).max())
            line += f"; the full graph differs from torch by at most {apart:.1e} on the first test clip"
            if not apart <= FULL_TOLERANCE:
                raise click.ClickException(f"{out}: not written: {line}, more than {FULL_TOLERANCE:g}")
        other.replace(out)
    return line
