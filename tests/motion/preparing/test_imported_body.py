"""The body that clips were imported onto, beside the one that a network was trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.preparing.imported_body import (
    RECORD,
    body_name,
    body_record,
    check_networks_body,
    check_networks_joints,
)

BODIES = {
    "builtin": builtin_rest_joints(), "a/model.npz": np.ones((22, 3)), "b/model.npz": np.full((22, 3), 2.0)
}  # fmt: skip


@pytest.mark.parametrize("imported", BODIES)
@pytest.mark.parametrize("trained", BODIES)
def test_clips_of_an_import_are_predicted_on_its_body(tmp_path: Path, imported: str, trained: str):
    clips = [tmp_path / "walk" / "one.npz", tmp_path / "two.npz"]
    name = body_name(trained, BODIES[trained])
    check_networks_body(clips, name)  # of nobody's import
    (tmp_path / "walk").mkdir()
    write_json(tmp_path / RECORD, body_record(imported, BODIES[imported]))
    if imported == trained:
        check_networks_body(clips, name)
    else:
        with pytest.raises(InputError, match=f"imported onto the body .*trained on {name}; allowed"):
            check_networks_body(clips, name)


def test_an_import_that_recorded_a_name_alone_has_that_body(tmp_path: Path):
    write_json(tmp_path / RECORD, {"body": "model.npz"})
    check_networks_body([tmp_path / "one.npz"], "model.npz 01234567")
    with pytest.raises(InputError, match=r"imported onto the body model\.npz"):
        check_networks_body([tmp_path / "one.npz"], "builtin")
    (tmp_path / RECORD).write_text("[")
    check_networks_body([tmp_path / "one.npz"], "builtin")


@pytest.mark.parametrize("imported", BODIES)
@pytest.mark.parametrize("trained", BODIES)
def test_a_network_without_a_name_of_its_body_is_known_by_its_joints(
    tmp_path: Path, imported: str, trained: str
):
    clips, rest = [tmp_path / "one.npz"], BODIES[trained].astype(np.float32).astype(np.float64)
    check_networks_joints(clips, rest)  # of nobody's import
    record = body_record(imported, BODIES[imported])
    write_json(tmp_path / RECORD, record)
    if imported == trained:
        check_networks_joints(clips, rest)
    else:
        with pytest.raises(InputError, match=r"imported onto the body .*trained on another; allowed"):
            check_networks_joints(clips, rest)
    write_json(tmp_path / RECORD, {**record, "joints": [[0.0], [1.0, 2.0]]})
    if imported != "builtin":
        with pytest.raises(InputError, match="trained on another"):
            check_networks_joints(clips, rest)


def test_an_earlier_import_without_joints_is_told_from_the_built_in_body_alone(tmp_path: Path):
    write_json(tmp_path / RECORD, {"body": "model.npz", "rest_joints": "0123456789abcdef"})
    check_networks_joints([tmp_path / "one.npz"], BODIES["a/model.npz"])
    with pytest.raises(InputError, match=r"imported onto the body model\.npz"):
        check_networks_joints([tmp_path / "one.npz"], builtin_rest_joints())
    write_json(tmp_path / RECORD, {"time": 1.0})
    check_networks_joints([tmp_path / "one.npz"], builtin_rest_joints())
