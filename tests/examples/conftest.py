"""A clip of trackers through a tiny network in a space, as the examples of docs/examples read it."""

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import wearer
from conftest import shared
from filelock import FileLock

from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Pose, Stream

EXAMPLES = Path(__file__).parents[2] / "docs/examples"
PERSON = wearer.person(np.arange(61) / 60)


class Played(NamedTuple):
    """The files of a clip and of a network in a space, and the poses of `memmlp.Stream` for them."""

    network: Path
    trackers: Path
    poses: list[Pose]

    @property
    def joints(self) -> np.ndarray:
        """Positions (N, 22, 3), metres."""
        return wearer.joints(self.poses)


def trackers(space: str) -> np.ndarray:
    """Head, left and right of the clip (N, 3, 7), x y z qx qy qz qw."""
    rotations = SPACES[space].convert_rotations_from_amass(PERSON.rotations)
    quaternions = matrix_to_quaternion(rotations.reshape(-1, 3, 3)).reshape(-1, 3, 4)
    return np.concatenate([SPACES[space].convert_positions_from_amass(PERSON.positions), quaternions], -1)


@pytest.fixture(scope="session")
def played(tmp_path_factory: pytest.TempPathFactory, step_files) -> Callable[[str], Played]:
    """A clip of trackers through a tiny network, by the name of the space."""
    folder = shared(tmp_path_factory, "engines")

    def play(space: str) -> Played:
        network, path = step_files("mem_mlp", space), folder / f"{space}.csv"
        with FileLock(f"{path}.lock"):
            if not path.exists():
                runpy.run_path(str(EXAMPLES / "trackers.py"))["write"](path, trackers(space))
        there = SPACES[space]
        given = (
            there.convert_positions_from_amass(PERSON.positions),
            there.convert_rotations_from_amass(PERSON.rotations),
        )
        return Played(network, path, wearer.play(Stream(step_files("mem_mlp"), space=space), *given))

    return play
