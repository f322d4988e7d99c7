"""TensorBoard's event files have what the run folder has, read back as TensorBoard reads them."""

import struct
from pathlib import Path

import pytest
from fake_logger import a_run, an_outdated_evaluation
from processes import until

from memmlp.runs.loggers.logger import Session, sync_runs
from memmlp.runs.loggers.tensorboard import TensorBoard
from memmlp.runs.lookup import edit_notes

pytest.importorskip("tensorboardX")


def events(folder: Path) -> list[tuple[str, int, float | str]]:
    """The values and texts of the event files in a folder: records of length, checksum, event, checksum."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted(folder.glob("events*")):
        content = path.read_bytes()
        while content:
            (length,) = struct.unpack("<Q", content[:8])
            event = Event.FromString(content[12 : 12 + length])
            content = content[16 + length :]
            for value in event.summary.value:
                text = value.tensor.string_val
                found.append((value.tag, event.step, text[0].decode() if text else value.simple_value))
    return found


def curve(logger: TensorBoard) -> list[tuple[int, float]]:
    (folder,) = Path(logger.place).iterdir()
    return [(step, value) for tag, step, value in events(folder) if tag == "train/loss"]


def test_a_curve_grows_and_is_written_once(tmp_path: Path):
    logger, run = TensorBoard(tmp_path), a_run(tmp_path, steps=2)
    run.write_manifest({"name": "memory=gru · seed 1"})
    session = Session(logger, run)
    session.update()
    until(lambda: curve(logger) == [(1, 1.0), (2, 0.5)], "the curve so far is written")
    run.log(3, {"loss": 0.25})
    session.update()
    session.close()
    sync_runs(logger, [run], print)
    assert curve(logger) == [(1, 1.0), (2, 0.5), (3, 0.25)]
    assert sync_runs(logger, [run], print) == {"same": 1}
    assert [path.name for path in Path(logger.place).iterdir()] == ["memory=gru · seed 1 · 00000000"]


def test_runs_with_long_names_have_a_folder_each(tmp_path: Path):
    """Names of seeds differ at their end alone, which is behind what there is room for."""
    logger = TensorBoard(tmp_path)
    runs = [a_run(tmp_path, 16 * digit) for digit in "12"]
    for seed, run in enumerate(runs):
        run.write_manifest({"name": f"{'../optim.weight_decay=0.05 · ' * 5}seed {seed}"})
    for _ in range(2):
        sync_runs(logger, runs, print)
        folders = [path.name for path in Path(logger.place).iterdir()]
        assert sorted(name[-11:] for name in folders) == [f" · {run.id[:8]}" for run in runs]
        assert {len(name) for name in folders} == {120}
    assert sync_runs(logger, runs, print) == {"same": 2}


def test_it_tells_how_a_run_ended_and_what_people_said(tmp_path: Path):
    logger, run = TensorBoard(tmp_path), a_run(tmp_path)
    run.fail("loss is nan")
    edit_notes(run, note="a note")
    an_outdated_evaluation(run)
    sync_runs(logger, [run], print)
    (folder,) = Path(logger.place).iterdir()
    texts = {tag.split("/")[0]: text for tag, _, text in events(folder) if isinstance(text, str)}
    assert (texts["status"], texts["reason"], texts["note"]) == ("failed", "loss is nan", "a note")
    assert "| seed | 0 |" in texts["config"]
    assert texts["outdated results"].startswith("stream (mode.stream 0 -> ")
