"""A tiny network as an ONNX file, and a clip, for the tests of memmlp.live.session."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import wearer

from memmlp.live.session.sources import TrackedClip

PERSON = wearer.person(np.arange(121) / 60)


@pytest.fixture
def network(step_files: Callable[..., Path]) -> Path:
    return step_files("no_memory")


@pytest.fixture
def clip() -> TrackedClip:
    return TrackedClip("person", PERSON.frames.numpy())
