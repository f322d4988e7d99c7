"""Run folders without a training."""

from pathlib import Path

from memmlp.runs.evaluation_file import write_report
from memmlp.runs.identity import Identity
from memmlp.runs.run import Run

CONFIG = {"seed": 0, "model": {"width": 16, "layers": [2, 4]}, "optim": {"lr": 1e-3, "log_every": 5}}


def identity(config: dict = CONFIG, kind: str = "memmlp", data: str = "d", prerequisite=None) -> str:
    return Identity(kind, config, data, prerequisite).id


def begun(outputs: Path, config: dict = CONFIG, kind: str = "memmlp") -> Run:
    run = Run.from_id(outputs, identity(config, kind))
    run.begin(kind, config, data="d", prerequisite=None)
    return run


def complete(outputs: Path, config: dict = CONFIG) -> Run:
    """A run with weights, an evaluation and a deployment in int8."""
    run = begun(outputs, config)
    run.model.write_bytes(b"weights")
    run.finish(["model.safetensors"])
    report = {"mode": "stream", "run": run.id, "name": "stream-0", "mean": {}, "clips": []}
    write_report(run.evaluation("stream-0"), report)
    place = run.deployment("int8-0")
    place.folder.mkdir(parents=True)
    for path in (place.onnx, place.int8):
        path.write_bytes(b"graph")
    place.finish({"run": run.id, "int8": {"growth": 0.0, "jitter_growth": 0.0}})
    return run
