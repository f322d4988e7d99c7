"""A tiny network as an ONNX file, and a clip, for the tests of memmlp.player."""

from __future__ import annotations

from pathlib import Path

import live
import numpy as np
import pytest
import tiny

from memmlp.export import export
from memmlp.memory import NoMemory
from memmlp.player.sources import Clip
from memmlp.streaming import streaming

PERSON = live.person(np.arange(121) / 60)


@pytest.fixture(scope="session")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights about a person who stands, as a file."""
    path = tmp_path_factory.mktemp("player") / "step.onnx"
    export(streaming(live.at_ease(tiny.model(NoMemory), PERSON.frames)), path, "0123456789abcdef")
    return path


@pytest.fixture
def clip() -> Clip:
    """Two seconds."""
    return Clip("person", PERSON.frames.numpy())
