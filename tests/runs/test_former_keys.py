"""Ids are digests of the former names of renamed keys."""

from __future__ import annotations

from memmlp.runs.former_keys import with_former_names
from memmlp.runs.identity import flatten, run_id

FORMER = {
    "seed": 0,
    "frame": {"coordinates": "heading", "normalize": True},
    "loss": {"name": "manual", "rotation": 2.0, "rotation_velocity": 30.0, "position": 0.5, "velocity": 0.1},
    "model": {"name": "hmd_poser", "layers": 3, "shape": 0.1},
    "data": {"weighting": "clips", "mirror": False},
}
NOW = {
    "seed": 0,
    "normalizer": {"coordinates": "heading", "z_scores": True},
    "loss": {
        "name": "manual", "rotation_all": 2.0, "rotation_velocity": 30.0, "position_branch": 0.5,
        "velocity_lower_body": 0.1,
    },
    "model": {"name": "hmd_poser", "encoder_layers": 3, "shape_weight": 0.1},
    "data": {"drawn_by": "clips", "mirror": False},
}  # fmt: skip


def test_keys_have_their_former_names():
    assert with_former_names(flatten(NOW)) == flatten(FORMER)


def test_an_id_is_that_of_the_former_names():
    made = run_id("memmlp", NOW | {"data": {"drawn_by": "clips"}}, data="d", upstream=None)
    assert made == "30bd7460c64ebd85"
