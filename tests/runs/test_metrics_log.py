"""The log of metrics survives kills and says what is broken."""

import json
import math
from pathlib import Path

import pytest
from begun_runs import begun, complete
from machines import fenced

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.runs.run import Run


def test_metrics_survive_a_torn_line_and_a_repeated_step(tmp_path: Path):
    run = begun(tmp_path)
    run.log(1, {"loss": 3.0})
    run.log(2, {"loss": 2.0})
    run.log(2, {"loss": 2.5}, phase="val")
    with open(run.metrics_path, "ab") as file:
        file.write(b'{"step": 3, "phase": "tr')
    assert [entry.step for entry in run.metrics()] == [1, 2, 2]
    resumed = Run(run.folder)
    resumed.log(2, {"loss": 1.0})
    resumed.log(3, {"loss": 0.5})
    assert [(e.phase, e.step, e.values["loss"]) for e in resumed.metrics()] == [
        ("train", 1, 3.0), ("train", 2, 1.0), ("val", 2, 2.5), ("train", 3, 0.5),
    ]  # fmt: skip


def test_every_cut_of_the_log_is_repaired(tmp_path: Path):
    run = begun(tmp_path)
    run.log(1, {"loss": 1.0})
    run.log(2, {"loss": 2.0})
    content = run.metrics_path.read_bytes()
    first = content.index(b"\n") + 1
    for cut in range(len(content) + 1):
        run.metrics_path.write_bytes(content[:cut])
        Run(run.folder).log(9, {"loss": 9.0})
        expected = [1] * (cut >= first) + [2] * (cut == len(content)) + [9]
        assert [entry.step for entry in run.metrics()] == expected


def test_a_broken_line_inside_the_log_is_named(tmp_path: Path):
    run = begun(tmp_path)
    run.metrics_path.write_text('{"step": 1}\n')
    with pytest.raises(InputError, match=r"metrics\.jsonl: line 1"):
        run.metrics()


def test_values_that_are_no_numbers_stay_json(tmp_path: Path):
    run = begun(tmp_path)
    run.log(1, {"nan": math.nan, "inf": -math.inf})
    json.loads(run.metrics_path.read_text(), parse_constant=pytest.fail)
    values = run.metrics()[0].values
    assert math.isnan(values["nan"])
    assert values["inf"] == -math.inf
    write_json(run.results_path, {"a": [math.nan]})
    assert run.results == {"a": ["nan"]}


def test_a_line_that_is_written_late_goes_to_the_old_file(tmp_path: Path):
    """The process is frozen between opening and writing, and the run's next owner begins meanwhile."""
    run = complete(tmp_path)
    run.log(1, {"loss": 1.0})

    class Frozen:
        number, thread, checks = 3, None, 0

        def check(self) -> None:
            self.checks += (run.folder / "now").exists()
            if self.checks == 2:  # the log is open
                Run(run.folder).log(1, {"loss": 0.5})

    with fenced(run.folder, Frozen()):
        run.log(2, {"loss": 2.0})
        (run.folder / "now").touch()
        run.log(3, {"loss": 3.0})
    assert [entry.values for entry in run.metrics()] == [{"loss": 0.5}, {"loss": 2.0}]
