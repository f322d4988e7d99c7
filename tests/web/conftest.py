"""A site of a tiny network, made once, and what of npm's packages its tests need."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import exported
import numpy as np
import pytest
import wearer
from conftest import shared
from filelock import FileLock

from memmlp.common.errors import InputError
from memmlp.common.npm import ONNXRUNTIME_WEB, Package, read
from memmlp.deploy.export import export
from memmlp.networks.streaming import streaming
from memmlp.networks.window_model import WindowModel
from memmlp.web.clips import packed
from memmlp.web.networks import SiteNetwork
from memmlp.web.site import Site

RUN = "0123456789abcdef"
SECONDS = 4.0
PERSON = wearer.person(np.arange(60 * 4 + 1) / 60)


class Made(NamedTuple):
    """A site, and the file of its network for Python's Stream."""

    folder: Path
    step: Path


def network() -> WindowModel:
    """A tiny network of random weights that stands as a person does."""
    return wearer.at_ease(exported.NETWORKS["mem_mlp"](), PERSON.frames)


def package_files(package: Package, *names: str) -> list[bytes]:
    """Files of an npm package; skips where they cannot be had."""
    try:
        found = read(package, names)
    except InputError as error:
        pytest.skip(str(error))
    return [found[name] for name in names]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A site with a network to play and wear, and one beside it to be timed."""
    package_files(ONNXRUNTIME_WEB, "package.json")
    home = shared(tmp_path_factory, "web")
    made = Made(home / "site", home / "step.onnx")
    with FileLock(home / "lock"):
        if not made.step.exists():
            model, clip = network(), packed("walk", PERSON.frames.numpy(), SECONDS)
            base = SiteNetwork("base", "AvatarPoser", "random", exported.NETWORKS["no_memory"]())
            Site(
                networks=[SiteNetwork(RUN, "tiny", RUN, model, (clip.key,))],
                base=base,
                clips=[clip],
                calibration=[PERSON.frames],
                webgpu=False,
            ).make(made.folder)
            export(streaming(model), made.step, RUN)
    return made


@pytest.fixture(scope="session")
def node() -> Callable[..., str]:
    """Node, or a skip."""
    path = shutil.which("node")
    if path is None:
        pytest.skip("node is not installed")
    return path
