"""The axes of engines in the pictures and in the guide's table."""

import importlib
import re
from types import ModuleType

import numpy as np
import pytest
from examples.conftest import EXAMPLES
from scipy.spatial.transform import Rotation

DOCS = EXAMPLES.parent
LEFT_HANDED = {"Unity", "Unreal"}
ROWS = {"glTF": ("openxr", "glTF", 1), "Unity": ("unity", "unity", 1), "Unreal": ("unity", "Unreal", 100)}


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("engine_pictures")


def axes(pictures: ModuleType, name: str) -> np.ndarray:
    """X, Y and Z of a convention as rows (3, 3)."""
    (found,) = (engine for engine in pictures.ENGINES if engine.name.startswith(name))
    return np.array(found.axes)


def test_the_table_turns_numbers_from_one_convention_to_another(pictures: ModuleType):
    """A person looks forward in both, so the axes determine the conversion."""
    for engine in pictures.ENGINES:
        np.testing.assert_allclose(np.array(engine.axes) @ np.array(engine.axes).T, np.eye(3))
        assert engine.right_handed == (not any(name in engine.name for name in LEFT_HANDED)), engine.name
    text = (DOCS / "guides/engines.md").read_text(encoding="utf-8")
    for row, (start, end, scale) in ROWS.items():
        (line,) = re.findall(rf"^\| {row}.*$", text[text.index("## Axes") :], re.MULTILINE)
        _, space, position, quaternion = (cell.strip() for cell in line.strip("| ").split("|"))
        assert space == f"`{start}`"
        way = axes(pictures, end) @ axes(pictures, start).T
        random = np.random.default_rng(0)
        point, turn = random.normal(size=3), Rotation.random(rng=random)
        np.testing.assert_allclose(said(position, "x y z", point), scale * way @ point)
        found = Rotation.from_quat(said(quaternion, "qx qy qz qw", turn.as_quat())).as_matrix()
        np.testing.assert_allclose(found, way @ turn.as_matrix() @ way.T, atol=1e-9)


def said(cell: str, names: str, values: np.ndarray) -> np.ndarray:
    """The values of a cell like "(100 z, -x)", given those of its names."""
    known = dict(zip(names.split(), values, strict=True))
    return np.array(
        [eval(re.sub(r"(\d) ", r"\1 * ", part), {}, known) for part in cell.strip("()").split(",")]
    )
