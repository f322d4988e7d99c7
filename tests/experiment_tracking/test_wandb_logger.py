"""W&B's own client writes offline runs that have what the run folder has; read back with its own reader."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_logger import a_run, an_outdated_evaluation
from processes import until

from memmlp.common.files import write_json
from memmlp.experiment_tracking.logged_values import SYSTEM, CurvePoint, SweepFacts, facts_of
from memmlp.experiment_tracking.run_logger import Session
from memmlp.experiment_tracking.sync import sync
from memmlp.experiment_tracking.wandb_logger import AXES, WandB
from memmlp.runs.metrics_log import MetricsLog
from memmlp.runs.notes import add_tags

pytest.importorskip("wandb")
pytestmark = pytest.mark.slow
CPU, LOSS = "system/cpu_percent", "train/loss"


@pytest.fixture(autouse=True)
def _service_ends() -> Iterator[None]:
    """The client's own process ends before the tests' end kills it."""
    yield
    import wandb

    wandb.teardown()


def records(logger: WandB, name: str) -> list[Any]:
    """The records of the one offline run of that id, once the client's own process has written the last."""
    from wandb.proto.wandb_internal_pb2 import Record

    (path,) = Path(logger.place).glob(f"offline-run-*-{name}/run-{name}.wandb")

    def read() -> list[Any] | None:
        found = [Record.FromString(data) for data in pieces(path.read_bytes())]
        return found if any(record.WhichOneof("record_type") == "exit" for record in found) else None

    return until(read, "the run's exit is written")


def pieces(content: bytes) -> Iterator[bytes]:
    """The entries of a file in LevelDB's log format: in blocks of 32 KiB, with checksum, length, type."""
    place, whole = 7, b""  # after the file's own header
    while place < len(content):
        if 32768 - place % 32768 < 7:
            place += 32768 - place % 32768
            continue
        _, length, kind = struct.unpack("<IHB", content[place : place + 7])
        whole += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # a whole entry, or the last piece of one
            yield whole
            whole = b""


def curve(found: list[Any], key: str) -> list[tuple[float, float]]:
    """A curve's values, and the numbers of their rows."""
    return rows(found, "_step", key)


def rows(found: list[Any], axis: str, key: str) -> list[tuple[float, float]]:
    """A curve's values over an axis."""
    history = [
        {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
        for record in found
        if record.WhichOneof("record_type") == "history"
    ]
    return [(row[axis], row[key]) for row in history if key in row]


def summary(found: list[Any]) -> dict[str, Any]:
    """A run's summary."""
    return {
        item.key or "/".join(item.nested_key): json.loads(item.value_json)
        for record in found
        if record.WhichOneof("record_type") == "summary"
        for item in record.summary.update
    }


def test_a_failed_run_with_its_curve_name_tags_and_machine_once(tmp_path: Path):
    logger, run = WandB("mine", tmp_path), a_run(tmp_path, steps=2)
    run.write_manifest({"name": "memory=gru · seed 1"})
    add_tags(run, ["good"])
    write_json(run.results_path, {"stream": {"rotation": {"MPJPE": 6.5}}})
    session = Session(logger, run, tmp_path / "ledgers")
    session.step()
    run.log(3, {"loss": 0.25})
    MetricsLog(run.folder / SYSTEM).append(0, {"cpu_percent": 50.0}, "system")
    session.step()
    session.leave()
    run.fail("loss is nan")
    an_outdated_evaluation(run)
    assert sync(logger, [run], tmp_path, print) == {"shown": 1}
    assert sync(logger, [run], tmp_path, print) == {"same": 1}
    found = records(logger, run.id)
    assert curve(found, "train/loss") == [(1, 1.0), (2, 0.5), (3, 0.25)]
    assert [value for _, value in curve(found, "system/cpu_percent")] == [50.0]
    (begun,) = [record.run for record in found if record.WhichOneof("record_type") == "run"]
    assert (begun.display_name, begun.project, list(begun.tags)) == ("memory=gru · seed 1", "mine", ["good"])
    (end,) = [record.exit for record in found if record.WhichOneof("record_type") == "exit"]
    assert end.exit_code == 1
    assert summary(found)["results by an earlier recipe"].startswith("stream (mode.stream 0 -> ")


def test_each_sample_of_the_machine_and_each_step_is_kept_at_its_own_place(tmp_path: Path):
    """More samples than steps lie between two batches; W&B's own count is ahead of the second one's steps."""
    logger, run = WandB("mine", tmp_path), a_run(tmp_path, steps=0)

    def batch(first: int) -> list[CurvePoint]:
        samples = [CurvePoint(CPU, 10.0 * n, n, 1000.0 + 10 * n) for n in range(5 * first, 5 * first + 5)]
        return [CurvePoint(LOSS, float(step), step, 0.0) for step in (first + 1, first + 2)] + samples

    facts = facts_of(run)
    shown = logger.begin(facts, batch(0))
    shown.log(batch(2))
    shown.end(facts, [])
    found = records(logger, run.id)
    assert rows(found, "step", LOSS) == [(1, 1.0), (2, 2.0), (3, 3.0), (4, 4.0)]
    numbers = [*range(5), *range(10, 15)]
    assert rows(found, "system/time", CPU) == [(1000 + 10 * n, 10 * n) for n in numbers]
    defined = [record.metric for record in found if record.WhichOneof("record_type") == "metric"]
    assert {metric.glob_name or metric.name: metric.step_metric for metric in defined}.items() >= AXES.items()


def test_a_sweep_is_a_run_with_its_verdicts(tmp_path: Path):
    logger = WandB("mine", tmp_path)
    facts = SweepFacts("mine", tmp_path, "done", {}, {"a/stream/MPJPE": 6.5}, {"a/stream/MPJPE": "holds"}, ())
    for _ in range(2):
        logger.sweep(facts)
    (folder,) = Path(logger.place).glob("offline-run-*")
    found = records(logger, folder.name.rsplit("-", 1)[-1])
    kept = summary(found)
    assert (kept["a/stream/MPJPE"], kept["verdict/a/stream/MPJPE"]) == (6.5, "holds")


def test_a_sweep_with_runs_to_do_is_not_finished(tmp_path: Path):
    logger = WandB("mine", tmp_path)
    logger.sweep(SweepFacts("mine", tmp_path, "running", {}, {}, {}, ()))
    (folder,) = Path(logger.place).glob("offline-run-*")
    found = records(logger, folder.name.rsplit("-", 1)[-1])
    (end,) = [record.exit for record in found if record.WhichOneof("record_type") == "exit"]
    assert end.exit_code == 1
