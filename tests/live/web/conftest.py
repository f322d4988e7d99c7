"""A site of a tiny network, made once, and what of npm's packages its tests need."""

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
from memmlp.common.npm import ONNXRUNTIME_WEB, Package, read_package_files
from memmlp.live.web.site import Site, SiteNetwork, pack_clip

RUN = "0123456789abcdef"
REMARK = "hardly trained, in a test"
PERSON = wearer.person(np.arange(60 * 4 + 1) / 60)


class Made(NamedTuple):
    """A site, and the file of its network for Python's Stream."""

    folder: Path
    step: Path


def package_files(package: Package, *names: str) -> list[bytes]:
    """Files of an npm package; skips where they cannot be had."""
    try:
        found = read_package_files(package, names)
    except InputError as error:
        pytest.skip(str(error))
    return [found[name] for name in names]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory, step_files: Callable[..., Path]) -> Made:
    """A site with a network to play and wear."""
    package_files(ONNXRUNTIME_WEB, "package.json")
    made = Made(shared(tmp_path_factory, "web") / "site", step_files("no_memory"))
    with FileLock(f"{made.folder}.lock"):
        if not made.folder.exists():
            clip = pack_clip("walk", PERSON.frames.numpy(), 4.0)
            network = exported.NETWORKS["no_memory"]()
            Site([SiteNetwork(RUN, "tiny", RUN, network, (clip.key,), REMARK)], [clip]).write(made.folder)
    return made


@pytest.fixture(scope="session")
def node() -> Callable[..., str]:
    path = shutil.which("node")
    if path is None:
        pytest.skip("node is not installed")
    return path
