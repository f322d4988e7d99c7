"""What the examples of engines share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import shared
from engine_clips import Played, play


@pytest.fixture(scope="session")
def played(
    tmp_path_factory: pytest.TempPathFactory, step_files: Callable[[str], Path]
) -> Callable[[str], Played]:
    """A clip of trackers through a tiny network, by the name of the space."""
    folder = shared(tmp_path_factory, "engines")
    return lambda space: play(folder, step_files("mem_mlp"), space)
