"""What `memmlp train` says of a network's size and times."""

from pathlib import Path

import pytest
from fake_runs import fake_run

from memmlp.cli.train_summary import describe_latency, show
from memmlp.training.request import Outcome

MEASURED = {"parameters": 19_238, "parameters_with_vqvae": 27_050, "macs": 218_048, "onnx_bytes": 995_047}


@pytest.mark.parametrize(("steps", "told"), [(2000, False), (20, True)])
def test_a_network_that_hardly_saw_motion_says_so(tmp_path: Path, capsys, steps: int, told: bool):
    config = {"optim": {"steps": steps, "batch": 8}, "model": {"frames": 11}}
    run = fake_run(tmp_path / "[old]", "a", config=config)
    show(Outcome(run, (), {}, ()))
    said = capsys.readouterr().out
    assert ("hardly trained" in said) == told
    assert f"run      {run.folder}\n" in said


TIMES = {"median_ms": 3.39, "p95_ms": 3.5, "ratio_to_yardstick": 1.2}


def latency(record: dict) -> str:
    return "\n".join(map(str, describe_latency(MEASURED | TIMES | record)))


def test_times_and_size_are_those_of_the_file_that_was_asked_for():
    own = {"median_ms": 1.27, "p95_ms": 1.4, "ratio_to_yardstick": 0.45, "onnx_bytes": 600_000}
    said = latency({"settings": {"precision": "int8"}, "int8": own})
    for words in (
        "1.27 ms median", "1.40 ms p95", "0.45 x", "fp32 3.39 ms", "ONNX file 0.6 MB", "0.218 MMAC",
    ):  # fmt: skip
        assert words in said
    assert "available 31% of the time" not in said
    for key in ("core_share", "alone_core_share", "pose_core_share"):
        assert "available 31% of the time" in latency({key: 0.31})


def test_an_int8_file_that_is_not_used_live_is_told():
    for jitter in (0.05, 0.356):
        cost = TIMES | {"onnx_bytes": 600_000, "growth": 0.0016, "jitter_growth": jitter}
        said = latency({"settings": {"precision": "int8"}, "int8": cost})
        assert ("Jitter +35.6%" in said) == ("memmlp live uses float32" in said) == (jitter > 0.1)
