"""A run as one logger is shown it."""

from __future__ import annotations

from pathlib import Path

from fake_logger import FakeLogger, a_run

from memmlp.common.files import write_json
from memmlp.experiment_tracking.run_logger import Session


def test_a_result_that_is_measured_again_replaces_what_is_shown(tmp_path: Path):
    """Loggers can't take values back, so that the run is shown anew; new results need none of that."""
    logger, run = FakeLogger(), a_run(tmp_path)
    run.finish([])

    def measured(before: dict[str, float], after: dict[str, float]) -> int:
        logger.server.begun = 0
        write_json(run.results_path, before)
        session = Session(logger, run, tmp_path / "ledgers")
        session.step()
        write_json(run.results_path, after)
        session.end()
        assert session.up_to_date()
        session.leave()
        return logger.server.begun

    assert measured({"a": 6.5}, {"a": 6.5}) == 1
    assert measured({"a": 6.5}, {"a": 6.5, "b": 1.0}) == 1
    assert measured({"a": 6.5}, {"a": 7.25}) == 2
    assert measured({"a": 6.5}, {}) == 2


def test_steps_that_a_resumed_run_repeats_are_shown_once(tmp_path: Path):
    """With the values of the weights that count, which the last line of a step has."""
    logger, run = FakeLogger(), a_run(tmp_path, steps=3)
    session = Session(logger, run, tmp_path / "ledgers")
    session.step()
    for step in (2, 3, 4):
        run.log(step, {"loss": 9.0})
        session.step()
    run.finish([])
    session.end()
    values = [("train/loss", 1, 1.0), *(("train/loss", step, 9.0) for step in (2, 3, 4))]
    assert logger.server.values[run.id] == values
    assert session.up_to_date()
    session.leave()
