"""The body that clips were imported onto, compared with the one that uses them."""

from pathlib import Path

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.motion import body
from memmlp.motion.body import RECORD, check_imported_body, describe_body, make_builtin_rest_joints

BUILTIN, OTHER = make_builtin_rest_joints(), 1.1 * make_builtin_rest_joints()


@pytest.mark.parametrize("folder", [".", "walk", "walk/deep"])
def test_clips_of_an_import_are_used_on_its_body(tmp_path: Path, folder: str):
    clips = [tmp_path / "walk" / "deep" / "one.npz", tmp_path / "two.npz"]
    (tmp_path / "walk" / "deep").mkdir(parents=True)
    record = tmp_path / folder / RECORD
    for rest in (BUILTIN, OTHER):
        check_imported_body(clips, rest, "data.body")  # nobody's import
    write_json(record, describe_body("model.npz", OTHER))
    check_imported_body(clips, OTHER.astype(np.float32).astype(np.float64), "data.body")
    with pytest.raises(InputError, match=r"model\.npz.*data\.body"):
        check_imported_body(clips, BUILTIN, "data.body")


@pytest.mark.parametrize("text", ["[", "[]", "{}", '{"body": "x", "joints": [[0.0], [1.0, 2.0]]}'])
def test_records_of_other_programs_are_ignored(tmp_path: Path, text: str):
    (tmp_path / RECORD).write_text(text)
    check_imported_body([tmp_path / "one.npz"], BUILTIN, "data.body")


@pytest.mark.parametrize(("key", "values", "problem"), [
    ("kintree_table", [[-1, *body.PARENTS[2:], 0]], "tree"), ("v_template", np.nan * BUILTIN, "tree"),
    ("kintree_table", [0], "not an SMPL-H"), ("v_template", BUILTIN[:, :2], "shape"),
    ("J_regressor", np.eye(21, 22), "shape"),
])  # fmt: skip
def test_files_of_other_bodies_are_refused(tmp_path: Path, key: str, values: np.ndarray, problem: str):
    model = {"J_regressor": np.eye(22), "v_template": BUILTIN, "kintree_table": [body.PARENTS]}
    np.savez(tmp_path / "model.npz", **(model | {key: values}))
    with pytest.raises(InputError, match=problem):
        body.load_rest_joints(tmp_path / "model.npz")
