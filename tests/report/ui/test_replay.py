"""Replays: the worst seconds, the page's axes, and predictions that fail."""

import itertools
import os
from pathlib import Path

import numpy as np
from processes import until
from report.ui.conftest import FRAMES, motion, run_of

from memmlp.common.errors import InputError
from memmlp.report.ui.replay import Replays, cut_piece, find_worst_seconds
from memmlp.runs.run import Run


def ready(replays: Replays, *words: str) -> dict:
    found: dict = {}

    def come() -> bool:
        found.update(replays.get(*words))
        return found["state"] != "computing"

    until(come, "the replay")
    return found


def test_a_piece_is_around_the_worst_second_in_the_page_s_axes():
    made = motion()
    found = cut_piece(made["true_positions"], made["predicted_positions"])
    assert found["worst"][0] == {"first": 300, "mean": 20.0}
    assert (found["frames"], found["from"], len(found["truth"])) == (FRAMES, 30, 600)
    assert found["truth"][0][:3] == [0, 1000, 0]  # up is y there
    assert (found["joints"][270][:3], found["errors"][300]) == ([200, 1000, 0], 20.0)
    assert cut_piece(made["true_positions"], made["predicted_positions"], 12.0)["from"] == 300
    made["predicted_positions"][120:] = np.nan
    found = cut_piece(made["true_positions"], made["predicted_positions"])
    said = f"{FRAMES - 120} of {FRAMES} frames are NaN or infinite, first at 2.0 s"
    assert found == {"state": "failed", "reason": said}


def test_worst_seconds_do_not_overlap():
    errors = np.ones(400)
    errors[100:160], errors[130:190] = 5.0, 6.0
    errors[300:360] = 3.0
    found = find_worst_seconds(errors)
    firsts = sorted(one["first"] for one in found)
    assert found[0] == {"first": 130, "mean": 6.0}
    assert all(later - earlier >= 60 for earlier, later in itertools.pairwise(firsts))
    assert {300} < set(firsts)


def test_a_prediction_is_computed_once_for_these_weights(outputs: Path):
    asked = []

    def predict(run: Run, clip: str, mode: str) -> dict[str, np.ndarray]:
        asked.append((clip, mode))
        return motion()

    run, replays = run_of(outputs), Replays(outputs, predict)
    for _ in range(2):
        assert ready(replays, run.id, "a clip", "stream")["worst"][0]["mean"] == 20.0
    assert asked == [("a clip", "stream")]
    ready(replays, run.id, "a clip", "window")
    os.utime(run.marker, (1, 1))  # the run was done again
    ready(replays, run.id, "a clip", "stream")
    assert len(asked) == 3


def test_what_cannot_be_computed_says_why_and_may_be_asked_again(outputs: Path):
    answers = iter([InputError("its data has changed"), MemoryError("no room"), None])

    def predict(*_: object) -> dict[str, np.ndarray]:
        if (error := next(answers)) is not None:
            raise error
        return motion()

    run, replays = run_of(outputs), Replays(outputs, predict)
    assert ready(replays, run.id, "c", "stream") == {"state": "failed", "reason": "its data has changed"}
    assert ready(replays, run.id, "c", "stream")["reason"] == "MemoryError: no room"
    assert ready(replays, run.id, "c", "stream")["state"] == "ready"
