"""A tiny network as an ONNX file, and a clip, for the tests of memmlp.live.session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny
import wearer

from memmlp.deploy.export import export
from memmlp.live.session.sources import TrackedClip
from memmlp.networks.memory import NoMemory
from memmlp.networks.streaming import make_streaming_graph

PERSON = wearer.person(np.arange(121) / 60)


@pytest.fixture(scope="session")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export a network with random weights whose pose is near that of a person who stands."""
    path = tmp_path_factory.mktemp("player") / "step.onnx"
    export(
        make_streaming_graph(wearer.at_ease(tiny.model(NoMemory), PERSON.frames)), path, "0123456789abcdef"
    )
    return path


@pytest.fixture
def clip() -> TrackedClip:
    return TrackedClip("person", PERSON.frames.numpy())
