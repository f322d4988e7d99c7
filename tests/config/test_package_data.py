"""Which shipped grouping an import suggests."""

from __future__ import annotations

from pathlib import Path

from memmlp.config.compose import composed
from memmlp.config.package_data import DEFAULT, grouping_to_choose


def test_names_choose_a_grouping():
    assert grouping_to_choose(["ann/walk", "dataset-1_walk_active_001"]) == "bandai_namco"
    assert grouping_to_choose(["ann/walk"]) is None
    assert grouping_to_choose(["salsa/01", "salsa/16"]) is None  # of the default


def test_the_default_is_that_of_own_motion(tmp_path: Path):
    """A grouping that is suggested replaces it."""

    def groups(*overrides: str) -> list[str]:
        return list(composed(["data=mocap", f"data.root={tmp_path}", *overrides]).data.split.groups)

    assert groups() == groups(f"data/grouping@data.split={DEFAULT}") != []
    assert groups("data/grouping@data.split=bandai_namco") != groups()
