"""The training of networks, of VQ-VAEs, and of their parts without validation clips."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from conftest import long_except

from memmlp.runs.lookup import list_runs
from memmlp.training import train_network
from memmlp.training.train_sage import PARTS

UNVALIDATED = [
    "profile=tiny", "data.synth.minutes=0.05", "data.split.val=0", "loggers=none", "threads=1",
    "export.graph=off", "evaluation.modes=[stream]",
]  # fmt: skip
CHAINS = {
    "model=mem_mlp": ("vqvae", "memmlp"),
    "model=recurrent_poser": ("memmlp",),
    "model=sage": (*PARTS, "memmlp"),
    "refiner=sage": ("memmlp", "memmlp"),
}


@pytest.mark.slow
@pytest.mark.parametrize("network", long_except(list(CHAINS)[:2], CHAINS))
def test_every_kind_of_training_can_do_without_validation(memmlp, network):
    few = [f"{group}.steps=2" for group in ("optim", "vqvae")]
    few += [f"prerequisite.{part}.steps=2" for part in PARTS if network == "model=sage"]
    few += ["model=avatar_poser"] if network == "refiner=sage" else []
    ran = memmlp("train", *UNVALIDATED, network, *few)
    assert ran.code == 0, ran.err
    assert "no validation clips" in ran.err
    runs = list_runs(Path("outputs"))
    assert sorted(run.manifest["kind"] for run in runs) == sorted(CHAINS[network])
    for run in runs:
        assert run.done
        assert {entry.phase for entry in run.metrics()} == {"train"}
        assert run.manifest.get("validation_clips", 0) == 0


def test_a_search_needs_validation_clips(memmlp):
    ran = memmlp("tune", *UNVALIDATED)
    assert ran.code == 2
    assert ran.err.startswith("memmlp: data.split.val: must be above 0 for a search")
    assert ran.err.count("\n") == 1


def test_a_validation_may_take_some_pieces_evenly_spread(monkeypatch):
    pieces = [torch.full((60, 1), float(number)) for number in range(10)]
    monkeypatch.setattr(train_network.modes, "cut_clips", lambda *_, **__: pieces)
    monkeypatch.setattr(
        train_network.modes, "measure_stream", lambda network, given, metrics: [int(one[0]) for one in given]
    )
    data = SimpleNamespace(has=lambda part: True, open=lambda part: torch.zeros(1))
    for count, expected in ((None, list(range(10))), (99, list(range(10))), (4, [0, 2, 5, 7])):
        validate = train_network.make_validation(data, {}, torch.device("cpu"), count)
        assert validate(None) == expected
