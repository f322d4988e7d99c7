"""A site of a tiny network, made once, and what of npm's packages its tests need."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import tiny
import wearer
from conftest import shared
from filelock import FileLock

from memmlp.common.errors import InputError
from memmlp.common.npm import ONNXRUNTIME_WEB, Package, read_package_files
from memmlp.deploy.export import export
from memmlp.live.web.site import Site, SiteNetwork, pack_clip
from memmlp.networks.memory import NoMemory
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.streaming import make_streaming_graph

RUN = "0123456789abcdef"
REMARK = "hardly trained, in a test"
PERSON = wearer.person(np.arange(60 * 4 + 1) / 60)


class Made(NamedTuple):
    """A site, and the file of its network for Python's Stream."""

    folder: Path
    step: Path


def network() -> MotionModel:
    return wearer.at_ease(tiny.model(NoMemory), PERSON.frames)


def package_files(package: Package, *names: str) -> list[bytes]:
    """Files of an npm package; skips where they cannot be had."""
    try:
        found = read_package_files(package, names)
    except InputError as error:
        pytest.skip(str(error))
    return [found[name] for name in names]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A site with a network to play and wear."""
    package_files(ONNXRUNTIME_WEB, "package.json")
    home = shared(tmp_path_factory, "web")
    made = Made(home / "site", home / "step.onnx")
    with FileLock(home / "lock"):
        if not made.step.exists():
            clip = pack_clip("walk", PERSON.frames.numpy(), 4.0)
            Site(
                networks=[SiteNetwork(RUN, "tiny", RUN, network(), (clip.key,), REMARK)],
                clips=[clip],
            ).write(made.folder)
            export(make_streaming_graph(network()), made.step, RUN)
    return made


@pytest.fixture(scope="session")
def node() -> Callable[..., str]:
    path = shutil.which("node")
    if path is None:
        pytest.skip("node is not installed")
    return path
