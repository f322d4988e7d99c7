"""What the page tells of searches."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from fake_search import director, finish, open_study

from memmlp.common.files import write_json
from memmlp.report.ui.searches import Searches


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "outputs/tune/mine"
    folder.mkdir(parents=True)
    return folder


def test_a_search_in_a_custom_storage_is_read_again(folder: Path, tmp_path: Path):
    """It has no journal that grows; its director touches the plan."""
    study = open_study(folder, storage=f"sqlite:///{tmp_path / 'trials.db'}", n_trials=2)
    write_json(folder / "search.json", asdict(study.search))
    one, searches = director(study, folder), Searches(tmp_path / "outputs")
    plan = folder / "controllers/a.json"
    one.update(1).save(plan)
    assert searches.describe("mine")["counts"] == {"running": 1}
    before = searches.make_change_stamp()
    finish(one.update(1))
    one.update(1).save(plan)
    assert searches.describe("mine")["counts"] == {"complete": 1, "running": 1}
    assert searches.make_change_stamp() != before


@pytest.mark.parametrize("changes", [{"storage": 5}, {"name": []}, {"objectives": None}, {"space": [[]]}])
def test_a_damaged_search_hides_no_other(folder: Path, changes: dict[str, Any]):
    study = open_study(folder)
    write_json(folder / "search.json", asdict(study.search))
    bad = folder.with_name("bad")
    bad.mkdir()
    write_json(bad / "search.json", asdict(study.search) | changes)
    searches = Searches(folder.parents[1])
    assert "search.json: cannot be read" in searches.describe("bad")["error"]
    assert "error" not in searches.describe("mine")


def test_a_search_makes_no_database_where_its_record_says(folder: Path, tmp_path: Path):
    study = open_study(folder)
    write_json(folder / "search.json", asdict(study.search) | {"storage": f"sqlite:///{tmp_path}/new.db"})
    assert Searches(folder.parents[1]).describe("mine")["error"] == "has not started"
    assert not (tmp_path / "new.db").exists()
