"""The benchmark of latency times every graph; AvatarPoser is the published network."""

import json

import numpy as np
import pytest

from benchmarks.latency import (
    GRAPHS,
    RoundTimes,
    export_all,
    latency,
    summarize,
    time_in_rounds,
    time_steps_in_rounds,
)
from memmlp.common import processes
from memmlp.common.errors import InputError

BENCHED = ["profile=tiny", "model.depth=2", "model.heads=4"]


def test_a_summary_by_hand():
    seconds = np.array([[1, 2, 3], [4, 4, 4], [6, 6, 6]]) * 1e-3
    base = RoundTimes(np.full((3, 2), 2e-3), np.ones(3))
    found = summarize("pose_", RoundTimes(seconds, np.array([0.98, 0.7, 1.0])), base)
    assert found["pose_median_ms"] == pytest.approx(4)
    assert [found[f"pose_ratio_{key}"] for key in ("least", "most")] == [1, 3]
    assert found["pose_ratio_to_avatar_poser"] == pytest.approx(2)
    assert found["pose_core_share"] == 0.7


@pytest.mark.long
def test_every_graph_is_timed_and_compared(tmp_path, capsys: pytest.CaptureFixture):
    file = tmp_path / "rows.json"
    words = [*BENCHED, "--models", "avatar_poser", "--steps", "2", "--json", str(file)]
    latency.main(words, standalone_mode=False)
    written = json.loads(file.read_text())
    rows = {row["variant"]: row for row in written["rows"]}
    assert written["overrides"] == BENCHED
    assert [written[key] for key in ("rounds", "steps", "threads")] == [5, 2, 1]
    assert all(0 < row["core_share"] < 1.01 and row["median_ms"] > 0 for row in written["rows"])
    assert (list(rows), rows["network"]["ratio_to_avatar_poser"]) == (list(GRAPHS), 1)
    assert rows["naive"]["pose_ratio_to_avatar_poser"] == 1
    assert [graph for graph, row in rows.items() if "pose_median_ms" in row] == list(GRAPHS[1:])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100


@pytest.mark.long
def test_a_step_is_slower_if_its_weights_are_not_in_the_caches(tmp_path):
    key = ("recurrent_poser", "streaming")
    path = dict(export_all([key[0]], ("profile=small",), tmp_path))[key]
    warm, cold = (time_steps_in_rounds({key: path}, 1, 20, cold)[key].seconds for cold in (False, True))
    assert np.median(cold) > 1.2 * np.median(warm)


@pytest.mark.long
def test_a_network_may_have_keys_of_its_own(tmp_path):
    names = ["recurrent_poser", "recurrent_poser+model.members=1+model.width=8"]
    paths = dict(export_all(names, ("profile=tiny",), tmp_path))
    large, small = (paths[name, "streaming"].stat().st_size for name in names)
    assert small < 0.8 * large


@pytest.mark.parametrize("words", [["--models", "mem_mlp@41"], ["model=rpm"], ["model.frames=9"]])
def test_models_include_the_one_that_others_are_compared_with(words: list[str]):
    with pytest.raises(InputError, match="--models"):
        latency.main(words, standalone_mode=False)


def test_the_order_of_files_is_reversed_and_each_rounds_share_of_a_core_is_kept(monkeypatch):
    """By clocks of the test's own: a step is 2 s, and the second round's `b` waits 6 s more for a core."""
    clock, order = {"passed": 0.0, "busy": 0.0}, []
    monkeypatch.setattr(processes.time, "perf_counter", lambda: clock["passed"])
    monkeypatch.setattr(processes.time, "thread_time", lambda: clock["busy"])

    def time_round(key):
        order.append(key)
        clock["busy"] += 2
        clock["passed"] += 8 if order == ["a", "b", "b"] else 2
        return np.array([2.0])

    found = time_in_rounds("ab", 3, time_round)
    assert order == ["a", "b", "b", "a", "a", "b"]
    assert found["a"].core_fractions.tolist() == [1, 1, 1]
    assert found["b"].core_fractions.tolist() == [1, 0.25, 1]
    assert found["b"].seconds.tolist() == [[2], [2], [2]]
