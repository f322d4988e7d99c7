"""Which files of tests go to one process."""

from __future__ import annotations

from pathlib import Path

import pytest
from work_units import SHARED, WorkUnits, shared

SERVER, BROWSER, MLFLOW = SHARED


def test_files_that_share_something_are_one_unit(pytestconfig: pytest.Config):
    units = object.__new__(WorkUnits)
    units.config = pytestconfig
    tests = (
        "kills/test_search",
        "cli/test_tune",
        "report/ui/test_page",
        "test_chromium",
        "test_architecture",
    )
    scopes = [units._split_scope(f"tests/{name}.py::test_it[a::b]") for name in tests]
    assert scopes == [SERVER, SERVER, BROWSER, BROWSER, "tests/test_architecture.py"]


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("from processes import forked, until", SERVER),
        ("x = 1\nfrom chromium import Browser", BROWSER),
        ("def test():\n    from mlflow import MlflowClient", MLFLOW),
        ("from a import forkedness  # as chromium import", None),
        ("# forked", None),
    ],
)
def test_a_file_is_known_by_its_words(tmp_path: Path, text: str, unit: str | None):
    (tmp_path / "test_one.py").write_text(text)
    assert shared(tmp_path / "test_one.py") == unit
