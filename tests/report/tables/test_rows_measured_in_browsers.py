"""Rows of Table 17 that a browser measured: shown beside the others, and refused where they are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from memmlp.common.errors import InputError
from memmlp.config.compose_plan import find_sweep
from memmlp.report.tables.build_table import make_empty_table
from memmlp.report.tables.rows_measured_in_browsers import add_rows, read_bench
from memmlp.report.tables.table_text import FORMATS

ROW = {
    "network": "AvatarPoser", "run": "random", "parameters": 4_120_000, "graph": "naive",
    "precision": "fp32", "backend": "wasm",
    "threads": 1, "steps": 500, "median_ms": 20.0, "p95_ms": 25.0, "ratio_to_avatar_poser": 1.0,
    "ratio_to_yardstick": 0.8, "whole_median_ms": 21.0, "whole_p95_ms": 26.0,
}  # fmt: skip
OURS = ROW | {
    "network": "mine", "graph": "streaming", "precision": "int8", "median_ms": 5.0,
    "ratio_to_avatar_poser": 0.25, "ratio_to_yardstick": 0.2, "whole_median_ms": None, "whole_p95_ms": None,
}  # fmt: skip
FILE = {
    "format": "memmlp web bench 1", "date": "2026-01-02T03:04:05+00:00", "device": "Quest 9", "clock_ms": 0.1,
    "browser": "OculusBrowser 1", "onnxruntime_web": "1.2.3", "rows": [ROW, OURS],
}  # fmt: skip


def written(folder: Path, content: Any) -> Path:
    """A file of JSON, or of a text."""
    path = folder / "rows.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_they_stand_below_the_table_s_own_with_device_and_browser(tmp_path: Path):
    table = make_empty_table(find_sweep("17", ()), ("stream",), "nothing measured")
    shown = add_rows(table, read_bench(written(tmp_path, FILE)))
    base, ours = shown.rows[len(table.rows) :]
    assert (
        base.label == "AvatarPoser of 4.12 M parameters, as published, fp32, wasm: Quest 9, OculusBrowser 1"
    )
    assert base.against is None
    cells = ours.cells["stream"]
    means = {metric: cell.mean for metric, cell in cells.items()}
    assert means == {"ms": 5.0, "network ms": None, "pose ms": None, "ratio": 0.2, "FPS": 200.0}
    assert base.cells["stream"]["pose ms"].mean == 21.0
    assert cells["ms"].effect is not None
    assert cells["ms"].effect.mean == -15.0
    assert ours.against == base.label
    for form, words in FORMATS.items():
        text = words(shown)
        assert "Quest 9" in text, form
        assert "6.8" in text, form  # the paper's
    assert "(x 0.25)" in FORMATS["md"](shown)
    assert "onnxruntime-web 1.2.3, 1 thread, the median of 500 steps" in shown.flags[-1]


def test_rows_of_other_threads_steps_and_backends(tmp_path: Path):
    table = make_empty_table(find_sweep("17", ()), ("stream",), "nothing measured")
    rows = [ROW, OURS | {"threads": 4, "steps": 200, "backend": "webgpu"}]
    shown = add_rows(table, read_bench(written(tmp_path, FILE | {"rows": rows})))
    assert "1 or 4 threads, the median of 200 or 500 steps" in shown.flags[-1]
    assert shown.rows[-1].against is None  # its backend has no AvatarPoser
    assert shown.rows[-1].cells["stream"]["ms"].effect is None


WRONG: list[tuple[Any, str]] = [
    ("{", "Expecting"),
    ([], "rows.json"),
    (FILE | {"format": "memmlp web bench 2"}, "format"),
    (FILE | {"rows": []}, "rows"),
    (FILE | {"rows": [ROW, 3]}, "rows.json"),
    (FILE | {"device": ""}, "device="),
    ({k: v for k, v in FILE.items() if k != "browser"}, "browser"),
    (FILE | {"rows": [ROW | {"median_ms": 0}]}, "median_ms=0"),
    (FILE | {"rows": [ROW | {"median_ms": True}]}, "median_ms=True"),
    (FILE | {"rows": [ROW | {"whole_median_ms": float("nan")}]}, "whole_median_ms=nan"),
    (FILE | {"rows": [ROW | {"ratio_to_yardstick": "1"}]}, "ratio_to_yardstick=1"),
]


def test_other_files_are_rejected(tmp_path: Path):
    for content, words in WRONG:
        with pytest.raises(InputError, match="--add") as error:
            read_bench(written(tmp_path, content))
        assert words in str(error.value), content
    with pytest.raises(InputError, match=r"none\.json: no such file"):
        read_bench(tmp_path / "none.json")
    (tmp_path / "rows.json").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match=r"rows\.json"):
        read_bench(tmp_path / "rows.json")


def test_words_of_a_file_do_not_reach_a_terminal_as_commands(tmp_path: Path):
    measured = read_bench(written(tmp_path, FILE | {"device": "evil\x1b[2J\nthing"}))
    assert measured.about["device"] == "evil\\x1b[2J\\nthing"


def test_other_tables_take_none(tmp_path: Path):
    table = make_empty_table(find_sweep("5", ()), ("stream",), "nothing measured")
    with pytest.raises(InputError, match=r"--add: must be used with memmlp table 17"):
        add_rows(table, read_bench(written(tmp_path, FILE)))
