"""Records of runs are regular files of their type, or damaged."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from begun_runs import complete

from memmlp.common.errors import InputError
from memmlp.common.files import read_json, write_json
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.runs.garbage_runs import find_garbage
from memmlp.runs.run import Run


def link_to_endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def write_huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, link_to_endless, write_huge])
def test_special_and_huge_files_are_not_read(tmp_path: Path, make: Callable[[Path], object]):
    run = complete(tmp_path)
    paths = (run.config_path, run.manifest_path, run.metrics_path)
    for path in paths:
        path.unlink(missing_ok=True)
        make(path)
    assert [line.split(":")[0] for line in run.damage] == list(map(str, paths))
    assert (run.status, run.manifest) == ("damaged", {})
    with pytest.raises(InputError, match=r"config\.yaml: cannot be read .*and 2 more"):
        load_measured_run(run.folder)


def test_a_changed_evaluation_is_damage_and_its_numbers_are_not_shown(tmp_path: Path):
    run = complete(tmp_path)
    path = run.evaluation("stream-0")
    write_json(path, read_json(path) | {"mean": {"rotation": {"MPJPE": 0.1}}})
    assert "changed since it was written" in run.damage[0]
    with pytest.raises(InputError, match="changed since"):
        _ = run.results


def test_a_lost_manifest_or_config_is_damage(tmp_path: Path):
    run = complete(tmp_path)
    for path in (run.config_path, run.manifest_path):
        content = path.read_bytes()
        path.unlink()
        assert run.damage == [f"{path}: missing"]
        path.write_bytes(content)
    assert run.damage == []


def test_a_damaged_run_is_no_garbage(tmp_path: Path):
    run = complete(tmp_path)
    run.manifest_path.write_text("{")
    assert find_garbage(tmp_path) == []


def test_a_claim_of_anybody_does_not_break_the_status(tmp_path: Path):
    run = complete(tmp_path)
    for text in ('{"pid": "x"}', '{"pid": 1e400}', '{"pid": -1}', "[" * 100_000, '{"place": []}', "\ud800"):
        for number in (1, 2):
            claim = run.folder / f".lease-{number}"
            claim.write_bytes(text.encode(errors="surrogatepass"))
            assert Run(run.folder).status in ("done", "lost", "trained")
            claim.unlink()
