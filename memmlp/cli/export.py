"""`memmlp export`: the ONNX file of a finished run, checked against torch and against runtimes' operators."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from memmlp.cli.options import check_runs, outputs_option, plugins_option

if TYPE_CHECKING:
    from collections.abc import Sized

    from torch import Tensor

    from memmlp.networks.motion_model import MotionModel, StreamingGraph

TARGETS = ("onnxruntime", "web", "wasm", "webgpu", "webnn", "unity", "tensorrt", "coreml", "qnn")
"""The names in memmlp.deploy.operator_support, repeated so that the help need not import ONNX Runtime."""

FULL_TOLERANCE = 0.1
"""Limit in metres and entries of rotation matrices: fp16 changes far less, a broken file far more."""


class Form(NamedTuple):
    """The kind of file that is wanted from a run.

    Attributes:
        graph: "auto", "streaming" or "naive".
        precision: "fp32", "fp16", "int8" or "int8_blocks".
        opset: the file's ONNX opset.
        full: the frame of reference and the format of the joints' rotations, for a file that covers
            everything from trackers to joints; None for the network's step alone.
    """

    graph: str
    precision: str
    opset: int
    full: tuple[str, str] | None


EXPORTING = ("out", "graph", "precision", "max_growth", "opset", "scope", "space", "rotations", "clips")
"""The options that say how a file is written."""


@click.command("export")
@click.argument("run", metavar="RUN|FILE.onnx")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="ONNX file to write; not needed with --operators-for.",
)
@click.option(
    "--graph",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "streaming", "naive"]),
    help="Graph to export: streaming computes each frame's own share once and keeps it as state, naive is "
    "the network as it was trained; auto is the first that there is.",
)
@click.option(
    "--precision",
    default="fp32",
    show_default=True,
    type=click.Choice(["fp32", "fp16", "int8", "int8_blocks"]),
    help="Precision of the inner layers' weights; all but fp32 are measured on test clips, and int8 is "
    "calibrated on training clips.",
)
@click.option(
    "--max-growth",
    default=1.0,
    show_default=True,
    help="How much MPJPE may grow in less precision, percent; no file is written where it grows more.",
)
@click.option(
    "--opset",
    default=18,
    show_default=True,
    type=click.IntRange(15, 26),
    help="ONNX operator set of the file; Unity's engine reads up to 15.",
)
@click.option(
    "--scope",
    default="step",
    show_default=True,
    type=click.Choice(["step", "full"]),
    help="What the file computes: the network's step, from its 54 inputs, or all of the way from the "
    "trackers' poses to the joints.",
)
@click.option(
    "--space",
    type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of poses, with --scope full.  [default: amass]",
)
@click.option(
    "--rotations",
    type=click.Choice(["matrix", "quaternion"]),
    help="Format of the joints' rotations, with --scope full; quaternions are x, y, z, w.  [default: matrix]",
)
@click.option(
    "--parity-clips",
    "clips",
    default=1,
    show_default=True,
    type=click.IntRange(0),
    help="How many test clips a float32 file is compared with the network on, the longest first; 0 for all.",
)
@click.option(
    "--operators-for",
    "targets",
    multiple=True,
    type=click.Choice(TARGETS),
    help="List the operators of the file that lie outside of what this target publishes; may be repeated. "
    "With FILE.onnx nothing is exported.",
)
@plugins_option
@outputs_option
def export(
    run: str,
    out: Path | None,
    graph: str,
    precision: str,
    max_growth: float,
    opset: int,
    scope: str,
    space: str | None,
    rotations: str | None,
    clips: int,
    targets: tuple[str, ...],
    outputs: Path,
) -> None:
    """Export a finished run (id, its beginning, or folder) as ONNX and check it on whole test clips.

    With --operators-for the exit code is 1 where a target does not have all operators; the file is written
    anyway.
    """
    import tempfile

    from memmlp.common.errors import InputError

    if run.endswith(".onnx"):
        if given(*EXPORTING) or not targets:
            raise InputError(f"{run}: is an ONNX file already; allowed with it is --operators-for alone")
        check(Path(run), targets)
        return
    if out is None and not targets:
        raise InputError("--out: is missing; it may be left out with --operators-for alone")
    if out is not None and out.suffix != ".onnx":
        raise InputError(f"--out {out}: the only allowed ending is .onnx")
    if out is not None and not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    named = f"--space {space}" if space else f"--rotations {rotations}" if rotations else None
    if scope == "step" and named:
        raise InputError(f"{named}: the network itself knows AMASS' world alone; allowed with --scope full")
    if precision == "fp32" and given("max_growth"):
        raise InputError(
            f"--max-growth {max_growth:g}: is of less precision; "
            "allowed with --precision fp16, int8 or int8_blocks"
        )
    if precision != "fp32" and given("clips"):
        raise InputError(
            f"--parity-clips {clips}: allowed with fp32 alone; {precision} is measured on all test clips"
        )
    full = (space or "amass", rotations or "matrix") if scope == "full" else None
    check_runs(outputs, run)
    with tempfile.TemporaryDirectory(prefix="memmlp-export-") as folder:
        path = out or Path(folder) / f"{run.strip('/').rpartition('/')[2]}.onnx"
        write(run, path, outputs, Form(graph, precision, opset, full), clips, max_growth / 100)
        if targets:
            check(path, targets)


def write(run: str, out: Path, outputs: Path, form: Form, clips: int, max_growth: float) -> None:
    """Write the file of a run, provided that it passes the checks.

    Args:
        run: the run's id, its beginning, or its folder.
        out: the file to write.
        outputs: the folder in which runs are kept.
        form: the kind of file that is wanted.
        clips: the number of test clips on which a float32 file is checked; 0 for all.
        max_growth: the fraction by which MPJPE may grow with lower precision (0.01 is 1 %).
    """
    from memmlp.common.errors import InputError
    from memmlp.common.progress import tell
    from memmlp.config.open_run import open_run
    from memmlp.deploy.deployment import GRAPHS
    from memmlp.deploy.parity import clips_to_check
    from memmlp.networks.motion_model import StreamingGraph
    from memmlp.networks.streaming import check_streams
    from memmlp.runs.lookup import find_run

    found = find_run(outputs, run)
    _, experiment, data = open_run(outputs, run)
    model = experiment.architecture.load(found.weights())
    check_streams(model)
    network = GRAPHS[form.graph](model)
    test = data.open("test").clips()
    if form.precision == "fp32":
        checked = clips_to_check(model, test, clips)
        tell(f"export: write {out}, and compare it with torch on {test_clips(checked)}")
        write_exact(model, network, out, found.id, checked, form)
    elif isinstance(network, StreamingGraph) and not (form.precision.startswith("int8") and form.full):
        tell(f"export: write {out} in {form.precision}, and measure what that costs on {test_clips(test)}")
        train = data.open("train").clips() if form.precision == "int8" else []
        write_less_precise(model, network, out, found.id, train, test, form, max_growth)
    else:
        allowed = (
            "--scope step and a streaming graph" if form.precision.startswith("int8") else "a streaming graph"
        )
        raise InputError(f"--precision {form.precision}: allowed with {allowed}")


def write_exact(
    model: MotionModel,
    network: MotionModel | StreamingGraph,
    out: Path,
    run_id: str,
    clips: list[Tensor],
    form: Form,
) -> None:
    """Write the float32 ONNX file, provided that it matches the trained model on all clips.

    Args:
        model: the network as it was trained.
        network: the graph to export, the model itself or its streaming graph.
        out: the file to write.
        run_id: the run's id, for the file's metadata.
        clips: frames (N, 252) of each clip on which they are compared.
        form: the kind of file that is wanted.

    Raises:
        ClickException: if file and model differ by more than rounding explains; nothing is written then.
    """
    import tempfile

    import numpy as np

    from memmlp.deploy.parity import TOLERANCE, parity, tolerated
    from memmlp.live.trackers_to_body_graph import full_parity, full_tolerated

    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        path = Path(folder) / "step.onnx"
        write_graph(network, path, run_id, form)
        if form.full:
            space = form.full[0]
            apart = [full_parity(model, path, clip, space) for clip in clips]
            checked = [full_tolerated(model, path, *one, space) for one in zip(clips, apart, strict=True)]
        else:
            apart = [parity(model, path, clip) for clip in clips]
            checked = [tolerated(model, path, *one) for one in zip(clips, apart, strict=True)]
        worst = float(np.max(apart))  # NaN as soon as one is NaN, unlike max()
        said = f"differs from torch by {worst:.1e} at most on {test_clips(clips)}"
        if not all(checked):
            wrong = f"{out}: {said}, more than {TOLERANCE:.0e}: not written"
            raise click.ClickException(f"{wrong}; please report it with the run's config.yaml")
        path.replace(out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {said}")


def write_graph(network: MotionModel | StreamingGraph, path: Path, run_id: str, form: Form) -> None:
    """Write the ONNX file of the network's step, or of the full graph, in float32 and unchecked."""
    from memmlp.deploy.export import export as export_network
    from memmlp.live.trackers_to_body_graph import export_full

    if form.full:
        export_full(network, path, run_id, *form.full, form.opset)
    else:
        export_network(network, path, run_id, form.opset)


def write_less_precise(
    model: MotionModel,
    network: StreamingGraph,
    out: Path,
    run_id: str,
    train: list[Tensor],
    test: list[Tensor],
    form: Form,
    max_growth: float,
) -> None:
    """Write the ONNX file with lower precision, provided that it is accurate enough, and report its cost.

    The cost in accuracy is measured on the network's step, even for a file with the full graph, whose layers
    are the same. Such a file is also compared with torch on the first test clip.

    Args:
        model: the network as it was trained.
        network: the streaming graph.
        out: the file to write.
        run_id: the run's id, for the file's metadata.
        train: frames (N, 252) of the clips that calibrate int8.
        test: frames (N, 252) of the clips on which the cost is measured.
        form: the kind of file that is wanted.
        max_growth: the fraction by which MPJPE may grow (0.01 is 1 %).

    Raises:
        ClickException: if MPJPE grows by more, or a full graph does not match the network; nothing is written
            then.
    """
    import tempfile

    from memmlp.deploy.deployment import lower
    from memmlp.deploy.precision_cost import compared
    from memmlp.live.trackers_to_body_graph import full_parity

    precision = form.precision
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as folder:
        exact, other = Path(folder) / "fp32.onnx", Path(folder) / "other.onnx"
        write_graph(network, exact, run_id, form._replace(full=None))
        lower(precision, exact, other, network, train)
        cost = compared(exact, other, precision, network.normalizer, test)
        said = ", ".join(
            f"{name} {cost['fp32'][name]:.2f} -> {cost[precision][name]:.2f}"
            for name in ("MPJPE", "position MPJPE", "Jitter")
            if name != "position MPJPE" or "position" in model.branches
        )
        if not cost["growth"] <= max_growth:
            raise click.ClickException(f"{said}: more than --max-growth {100 * max_growth:g} %, not written")
        if form.full:
            write_graph(network, exact, run_id, form)
            lower(precision, exact, other, network, train)
            apart = full_parity(model, other, test[0], form.full[0])
            said += f"; the whole way differs from torch by {apart:.1e} at most on the first"
            if not apart <= FULL_TOLERANCE:
                raise click.ClickException(f"{said}, more than {FULL_TOLERANCE:g}: not written")
        other.replace(out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, on test clips {said}")


def test_clips(clips: Sized) -> str:
    """Return how many test clips there are, in words."""
    return f"{len(clips)} test clip{'s' * (len(clips) != 1)}"


def given(*names: str) -> list[str]:
    """Return those of the running command's parameters with these names that were typed."""
    context, typed = click.get_current_context(), click.core.ParameterSource.COMMANDLINE
    return [name for name in names if context.get_parameter_source(name) is typed]


def check(path: Path, targets: tuple[str, ...]) -> None:
    """Print which operators of a file the targets do not support, and where that is published.

    Raises:
        ClickException: if there are any.
    """
    from memmlp.deploy import operator_support as published

    model = published.load_graph(path)
    kinds = len({node.op_type for node in model.graph.node})
    click.echo(f"{path.name}: {len(model.graph.node)} nodes of {kinds} operators")
    lacking = []
    for name in dict.fromkeys(name for target in targets for name in published.TARGETS[target]):
        listed = published.published(name)
        outside = published.findings(model, listed)
        click.echo(f"{name}: {listed.source}")
        for what, count, why in outside:
            click.echo(f"  {what}{f', {count} nodes' if count else ''}: {why}")
        for remark in published.remarks(model, listed):
            click.echo(f"  note: {remark}")
        click.echo(f"  so {listed.outside}" if outside else "  all operators are published")
        lacking += [name] if outside else []
    if lacking:
        raise click.ClickException(f"{path.name}: outside of what {', '.join(lacking)} publishes")
