"""A run tells which weights it builds upon, and by what these were made."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.common.files import file_digest
from memmlp.runs.run import Run
from memmlp.runs.upstream_origin import upstream_origins, upstream_recipes

CODES, PART, NETWORK = (letter * 16 for letter in "abc")


def trained(outputs: Path, name: str, upstream: Run | None = None, weights: str = "w", **facts) -> Run:
    run = Run.of(outputs, name)
    above = {"upstream_runs": upstream_origins(upstream)} if upstream else {}
    run.begin("vqvae", {}, data="d", upstream=upstream.id if upstream else None, **facts, **above)
    run.model.write_text(weights)
    run.finish([run.model.name])
    return run


def test_what_a_run_builds_upon_stays_known_when_that_is_trained_again(tmp_path: Path):
    """Its id says how it is trained, and not which weights came of it."""
    codes = trained(tmp_path, CODES, recipes={"vqvae": 1}, gpu="A card", device="cuda")
    network = trained(tmp_path, NETWORK, codes)
    digest, before = file_digest(codes.model), network.manifest["upstream_runs"]
    codes.reset()
    assert upstream_origins(trained(tmp_path, CODES, weights="others"))[0]["weights"] != digest
    (found,) = network.manifest["upstream_runs"]
    assert [found] == before
    assert (found["id"], found["kind"], found["weights"]) == (CODES, "vqvae", digest)
    assert (found["recipes"], found["gpu"], found["device"]) == ({"vqvae": 1}, "A card", "cuda")
    assert {"git", "sources", "cpu", "packages"} <= found.keys()


def test_what_lies_further_upstream_is_known_too(tmp_path: Path):
    codes = trained(tmp_path, CODES, recipes={"vqvae": 1})
    part = trained(tmp_path, PART, codes, recipes={"model.mem_mlp": 2})
    network = trained(tmp_path, NETWORK, part)
    assert [one["id"] for one in network.manifest["upstream_runs"]] == [PART, CODES]
    assert upstream_recipes(network) == {"vqvae": 1, "model.mem_mlp": 2}
    assert upstream_origins(None) == []


def test_a_training_that_is_resumed_upon_other_weights_has_both(tmp_path: Path):
    network = Run.of(tmp_path, NETWORK)
    for weights in ("first", "first", "others"):
        codes = trained(tmp_path, CODES, weights=weights)
        above = upstream_origins(codes)
        network.begin("memmlp", {}, data="d", upstream=CODES, upstream_runs=above)
        network.checkpoint.touch()
    found = [one["weights"] for one in network.manifest["upstream_runs"]]
    assert len(found) == 2
    assert found[0] == codes.weights_digest != found[1]


@pytest.mark.parametrize(
    ("memory", "config", "expected"),
    [
        ("memory.vq", {}, {"vqvae": 1, "codebook.ema": 1}),
        ("memory.vq", {"vqvae": {"codebook": "gradient"}}, {"vqvae": 1, "codebook.gradient": 1}),
        ("memory.vq_joint", {}, {}),  # its own recipes have them
    ],
)
def test_a_run_from_before_this_was_recorded_has_the_first_recipes(
    tmp_path: Path, memory: str, config: dict, expected: dict
):
    run = Run.of(tmp_path, NETWORK)
    run.begin("memmlp", config, data="d", upstream=CODES, recipes={memory: 1})
    assert upstream_recipes(run) == expected


def test_a_refiner_upon_a_network_from_before_has_the_first_recipes_of_its_vqvae(tmp_path: Path):
    network = trained(tmp_path, NETWORK, recipes={"memory.vq": 1})
    refined = trained(tmp_path, PART, network, recipes={"memory.vq": 1, "refiner.sage": 1})
    assert upstream_recipes(refined) == {"memory.vq": 1, "vqvae": 1, "codebook.ema": 1}
