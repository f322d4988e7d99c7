"""W&B's own client writes offline runs that have what the run folder has; read back with its own reader."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_logger import a_run, an_outdated_evaluation
from processes import until

from memmlp.common.files import write_json
from memmlp.runs.loggers.logger import Session, sync_runs
from memmlp.runs.loggers.wandb import WandB
from memmlp.runs.lookup import add_tags

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _needs_wandb() -> None:
    """Not imported by each test process."""
    pytest.importorskip("wandb")


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
    history = [
        {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
        for record in found
        if record.WhichOneof("record_type") == "history"
    ]
    return [(row["_step"], row[key]) for row in history if key in row]


def summary(found: list[Any]) -> dict[str, Any]:
    return {
        item.key or "/".join(item.nested_key): json.loads(item.value_json)
        for record in found
        if record.WhichOneof("record_type") == "summary"
        for item in record.summary.update
    }


def test_a_failed_run_with_its_curve_name_and_tags_once(tmp_path: Path):
    logger, run = WandB("mine", tmp_path), a_run(tmp_path, steps=2)
    run.write_manifest({"name": "memory=gru · seed 1"})
    add_tags(run, ["good"])
    write_json(run.results_path, {"stream": {"rotation": {"MPJPE": 6.5}}})
    session = Session(logger, run)
    session.update()
    run.log(3, {"loss": 0.25})
    session.update()
    session.close()
    run.fail("loss is nan")
    an_outdated_evaluation(run)
    assert sync_runs(logger, [run], print) == {"shown": 1}
    assert sync_runs(logger, [run], print) == {"same": 1}
    found = records(logger, run.id)
    assert curve(found, "train/loss") == [(1, 1.0), (2, 0.5), (3, 0.25)]
    (begun,) = [record.run for record in found if record.WhichOneof("record_type") == "run"]
    assert (begun.display_name, begun.project, list(begun.tags)) == ("memory=gru · seed 1", "mine", ["good"])
    (end,) = [record.exit for record in found if record.WhichOneof("record_type") == "exit"]
    assert end.exit_code == 1
    assert summary(found)["outdated results"].startswith("stream (mode.stream 0 -> ")


def test_a_folder_that_looks_like_a_pattern(tmp_path: Path):
    folder = tmp_path / "run [1] *"
    run, logger = a_run(folder), WandB("memmlp", folder)
    run.finish([])
    assert sync_runs(logger, [run], print) == {"shown": 1}
    saved = Path(logger.place).glob(f"offline-run-*-{run.id}/files/config.yaml")
    assert [path.read_bytes() for path in saved] == [run.config_path.read_bytes()]
