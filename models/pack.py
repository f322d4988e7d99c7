"""Pack a finished run as a shipped network, or cut the shipped clip. A maintainer's script, not a command.

    python models/pack.py network NAME RUN... --root DATA --title TITLE --command COMMAND
    python models/pack.py export NAME --root DATA    # export the network again, with this code
    python models/pack.py latency NAME    # time the network again, on a quiet machine
    python models/pack.py clip FILE.npz --start SECONDS --seconds SECONDS

Of several runs, the one with the lowest validation MPJPE is packed; the card lists all. Test persons are
measured after this choice. The trainings to choose from, fixed before the first of them was run: 5 and 20
TFLOP, each with data.mirror=false and true.

Weight matrices are rounded to float16, so that the wheel is small. Then the rounded network is exported and
measured again: the card describes the shipped files.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from safetensors.torch import load_file, save_file

from memmlp.common.files import file_digest, write_json
from memmlp.config.open_run import OpenedRun, open_run
from memmlp.deploy.latency import measure_step_times
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import stream_onnx
from memmlp.evaluation.modes import average_clips
from memmlp.evaluation.modes import measure_clip as measure_errors
from memmlp.live.pose_latency import measure_pose_times
from memmlp.motion.body import FPS, load_rest_joints
from memmlp.motion.clip import resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.motion_source import ShippedMotion
from memmlp.report.tables.effects import estimate_mean_interval
from memmlp.report.tables.measured_run import MeasuredRun, load_measured_run
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.identity import find_evaluation_versions, select_evaluation_settings
from memmlp.runs.lookup import CARD, find_run, find_shipped_clip
from memmlp.runs.run import Run
from memmlp.training.run_stages import deploy_run, describe_machine, evaluate_run

MODELS = Path(__file__).parent
DATA = "outputs/data/persons"  # the folder of the import in docs/guides/checks.md
KEPT = (
    "id", "kind", "name", "data", "body", "prerequisite", "started", "finished", "seconds", "steps", "tflop",
    "best_step", "component_versions", "version", "git", "packages", "cpu", "device", "threads", "precision",
)  # fmt: skip
METRICS = ("MPJRE", "MPJPE", "MPJVE", "Jitter", "GT Jitter")
TERMS = (
    'The motion is from the CMU motion-capture database: "This data is free for use in research and '
    'commercial projects worldwide." "The data used in this project was obtained from mocap.cs.cmu.edu. The '
    'database was created with funding from NSF EIA-0196217." The weights have the license of the package, '
    "Apache-2.0."
)


def round_weights(source: Path, target: Path) -> None:
    """Write the tensors with matrices in float16; other tensors are unchanged."""
    with source.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    tensors = {
        name: tensor.half()
        if tensor.dtype == torch.float32 and tensor.ndim > 1 and tensor.numel() > 999
        else tensor
        for name, tensor in load_file(source).items()
    }
    save_file(tensors, target, header["__metadata__"])


def copy_run(run: Run, name: str) -> Run:
    """Copy a run's config, log and rounded weights, without evaluations and paths of this machine."""
    shipped = Run(MODELS / name)
    shutil.rmtree(shipped.folder, ignore_errors=True)
    shipped.folder.mkdir()
    config = run.config
    config["paths"]["outputs"], config["data"]["root"], config["threads"] = "outputs", DATA, 1
    config["evaluation"]["modes"], config["export"]["graph"] = ["stream"], "auto"
    shipped.config_path.write_text(yaml.safe_dump(config, sort_keys=False))
    manifest = {key: run.manifest[key] for key in KEPT if key in run.manifest}
    write_json(shipped.manifest_path, {**manifest, "shipped": name})
    shutil.copy(run.metrics_path, shipped.metrics_path)
    round_weights(run.model, shipped.model)
    artifacts = {shipped.model.name: file_digest(shipped.model)}
    write_json(
        shipped.marker,
        {"id": run.manifest["id"], "finished": run.manifest["finished"], "artifacts": artifacts},
    )
    return shipped


def measure(shipped: Run, root: Path, outputs: Path) -> OpenedRun:
    """Export the shipped network, and measure the ONNX file on the test clips of its data."""
    opened = open_run(outputs, str(shipped.folder), overrides=[f"data.root={root}"])
    experiment, data = opened.experiment, opened.data
    with shipped.lock():
        shipped.request_stages(experiment.stage_ids)
        deploy_run(experiment, shipped, data)  # type: ignore[arg-type]
        if experiment.config["model"]["name"] == "recurrent_poser":  # torch steps through 64 clips at once
            evaluate_run(experiment, shipped, data, ["stream"])  # type: ignore[arg-type]
        else:  # the streaming graph computes a frame's features once
            evaluate_file(opened, shipped.preferred_onnx)
    for path in (*shipped.folder.glob(".lease*"), shipped.picture):
        path.unlink(missing_ok=True)
    kept = {key: value for key, value in shipped.manifest.items() if key in (*KEPT, "shipped", "stages")}
    write_json(shipped.manifest_path, kept)
    return opened


def evaluate_file(opened: OpenedRun, file: Path) -> None:
    """Write the run's evaluation in stream mode, from the ONNX file."""
    experiment, run, test = opened.experiment, opened.run, opened.test
    stream, normalizer, rows = OnnxStream(file), opened.network().normalizer, []
    for index, clip in enumerate(test.read_clips()):
        facts = {"name": test.names[index], "group": test.groups[index], "frames": len(clip)}
        rows.append(facts | measure_errors(normalizer, stream_onnx(stream, clip), clip))
    branches = [{key: row[key] for key in ("rotation", "position")} for row in rows]
    name = experiment.evaluations["stream"]
    settings = select_evaluation_settings(experiment.config, "stream", experiment.motion.groups_digest)
    report = {"mode": "stream", "run": run.manifest["id"], "name": name, "settings": settings}
    report |= {"component_versions": find_evaluation_versions(settings), **describe_machine(experiment)}
    mean = average_clips(branches, [row["frames"] for row in rows])
    write_report(run.evaluation(name), {**report, "mean": mean, "clips": rows})


def measure_clip(opened: OpenedRun) -> dict[str, Any]:
    """Return the errors on the shipped clip."""
    path = find_shipped_clip()
    test = ShippedMotion(path, load_rest_joints("builtin")).open("test")
    clip = test.read_clip(0)
    motion = stream_onnx(OnnxStream(opened.run.preferred_onnx), clip)
    means = measure_errors(opened.network().normalizer, motion, clip)
    errors = {
        branch: {k: round(v, 4) for k, v in row.items() if k in METRICS} for branch, row in means.items()
    }
    return {"name": path.stem, "seconds": round(len(clip) / FPS, 2), "errors": errors}


def summarize_errors(measured: MeasuredRun) -> dict[str, Any]:
    """Return each branch's errors in stream mode: mean, and 95 % interval over persons."""
    found: dict[str, Any] = {}
    for branch, row in measured.means["stream"].items():
        for metric in METRICS:
            if np.isfinite(float(row.get(metric, np.nan))):
                low, high = estimate_mean_interval([measured], "stream", branch, metric)
                numbers = (float(row[metric]), low, high)
                found.setdefault(branch, {})[metric] = [None if n is None else round(n, 3) for n in numbers]
    return found


def summarize_latency(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the times of a deployment for a card."""
    keys = ("median_ms", "p95_ms", "pose_median_ms", "ratio_to_yardstick", "core_share")
    return {key: round(record[key], 4) for key in keys} | {"cpu": record["made_by"]["cpu"]}


def list_files(run: Run) -> dict[str, Any]:
    """Return the sizes and digests of a shipped network's files."""
    files = [path for path in sorted(run.folder.rglob("*")) if path.suffix in (".onnx", ".safetensors")]
    return {path.name: {"bytes": path.stat().st_size, "sha256": file_digest(path)} for path in files}


def export_again(name: str, root: Path, outputs: Path) -> None:
    """Export a shipped network again, time it, and update its card."""
    run, path = Run(MODELS / name), MODELS / name / CARD
    opened = open_run(outputs, str(run.folder), overrides=[f"data.root={root}"])
    manifest = run.manifest_path.read_bytes()
    shutil.rmtree(run.deployments)
    with run.lock():
        deploy_run(opened.experiment, run, opened.data)  # type: ignore[arg-type]
    for lease in run.folder.glob(".lease*"):
        lease.unlink()
    run.manifest_path.write_bytes(manifest)
    changes = {"clip": measure_clip(opened), "files": list_files(run)}
    changes["latency"] = summarize_latency(run.preferred_deployment.record)
    path.write_text(json.dumps(json.loads(path.read_text()) | changes, indent=1) + "\n")
    print(changes)


def measure_latency(name: str) -> None:
    """Time a shipped network again on a quiet machine, and update its card."""
    run, path = Run(MODELS / name), MODELS / name / CARD
    deployed = run.preferred_deployment
    times = measure_step_times(deployed.onnx, 500) | measure_pose_times(deployed.onnx, 500)
    deployed.finish({**deployed.record, **times})
    card = json.loads(path.read_text()) | {"latency": summarize_latency(deployed.record)}
    path.write_text(json.dumps(card, indent=1) + "\n")
    print(card["latency"])


def make_card(opened: OpenedRun, title: str, command: str) -> dict[str, Any]:
    """Return the card of a shipped network."""
    run, clips = opened.run, opened.data.manifest.clips  # type: ignore[union-attr]
    measured, record = load_measured_run(run.folder), run.preferred_deployment.record
    parts = {p: [c for c in clips if c.split == p] for p in ("train", "val", "test")}
    config, manifest = run.config, run.manifest
    recipe = {key: config["optim"][key] for key in ("name", "batch", "lr", "warmup", "best_by")}
    recipe |= {
        "frames": config["model"]["frames"],
        **{key: manifest.get(key) for key in ("steps", "best_step", "tflop")},
    }
    return {
        "name": run.id,
        "title": title,
        "model": config["model"]["name"],
        "command": command,
        "commit": manifest["git"]["commit"],
        "version": manifest["version"],
        "recipe": recipe,
        "parameters": record["parameters"],
        "persons": {part: sorted({clip.group for clip in own}) for part, own in parts.items()},
        "clips": {part: len(own) for part, own in parts.items()},
        "minutes": {part: round(sum(c.length for c in own) / FPS / 60, 1) for part, own in parts.items()},
        "errors": summarize_errors(measured),
        "clip": measure_clip(opened),
        "latency": summarize_latency(record),
        "files": list_files(run),
        "weights": "matrices rounded to float16",
        "terms": TERMS,
    }  # fmt: skip


def find_validation_error(run: Run) -> float:
    """Return the lowest validation MPJPE (cm) of the branch that decides which weights are kept."""
    branch = run.config["optim"]["best_by"]
    rows = [json.loads(line) for line in run.metrics_path.read_text().splitlines()]
    return min(row["values"][f"{branch} MPJPE"] for row in rows if row["phase"] == "val")


def pack_network(names: list[str], name: str, root: Path, outputs: Path, title: str, command: str) -> None:
    """Pack the run with the lowest validation error; print its card."""
    runs = sorted((find_run(outputs, each) for each in names), key=find_validation_error)
    candidates = [
        {
            "tflop": round(run.manifest["tflop"], 2),
            "mirror": run.config["data"]["mirror"],
            "validation MPJPE": round(find_validation_error(run), 3),
        }
        for run in runs
    ]
    opened = measure(copy_run(runs[0], name), root, outputs)
    card = {**make_card(opened, title, command), "candidates": candidates}
    (MODELS / name / CARD).write_text(json.dumps(card, indent=1) + "\n")
    print(json.dumps(card, indent=1))


def cut_clip(source: Path, start: float, seconds: float) -> None:
    """Write a piece of an imported clip at 60 Hz to models/clip."""
    clip, _ = resample(read_clip(source, source.stem))
    piece = slice(round(start * FPS), round((start + seconds) * FPS))
    arrays = {"poses": clip.poses[piece].reshape(-1, 66), "trans": clip.trans[piece]}
    (MODELS / "clip").mkdir(exist_ok=True)
    out = MODELS / "clip" / f"cmu_{source.stem}.npz"
    np.savez_compressed(out, mocap_framerate=60.0, **{k: v.astype(np.float32) for k, v in arrays.items()})
    print(out, out.stat().st_size)


def main() -> None:
    """Parse the arguments, and pack."""
    parser = argparse.ArgumentParser()
    kinds = parser.add_subparsers(dest="kind", required=True)
    network, clip, latency, export = map(kinds.add_parser, ("network", "clip", "latency", "export"))
    for kind in (latency, export):
        kind.add_argument("name")
    for kind in (network, export):
        kind.add_argument("--root", type=Path, required=True)
        kind.add_argument("--outputs", type=Path, default=Path("outputs"))
    network.add_argument("name")
    network.add_argument("runs", nargs="+")
    network.add_argument("--title", required=True)
    network.add_argument("--command", required=True, help="the command of the training")
    clip.add_argument("source", type=Path)
    clip.add_argument("--start", type=float, default=0.0)
    clip.add_argument("--seconds", type=float, default=15.0)
    given = parser.parse_args()
    if given.kind == "clip":
        cut_clip(given.source, given.start, given.seconds)
    elif given.kind == "latency":
        measure_latency(given.name)
    elif given.kind == "export":
        export_again(given.name, given.root.resolve(), given.outputs)
    else:
        pack_network(given.runs, given.name, given.root.resolve(), given.outputs, given.title, given.command)


if __name__ == "__main__":
    main()
