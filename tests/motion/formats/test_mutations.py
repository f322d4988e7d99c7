"""Damaged files of every format: one line, or finite numbers; never anything else, and little memory."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import person
from mutations import mutated, sound_npz

from memmlp.common.errors import InputError, escape_line_breaks
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.npz import read_clip

MOST = 50e6  # bytes while a file of at most 60 kB is read


def npz_numbers(path: Path) -> np.ndarray:
    clip = read_clip(path, "a")
    return np.concatenate([clip.poses.reshape(len(clip), -1), clip.trans], 1)


FORMATS: dict[str, tuple[Callable[[], bytes], Callable[[Path], np.ndarray]]] = {
    "a.npz": (lambda: sound_npz(packed=False), npz_numbers),
    "packed.npz": (lambda: sound_npz(packed=True), npz_numbers),
    "a.bvh": (
        lambda: person("cmu_motionbuilder", frames=5, seed=0).text().encode(),
        lambda path: read_bvh(path).compute_kinematics()[1],
    ),
}


@pytest.mark.parametrize("name", FORMATS)
def test_damage_is_one_line_or_finite(name, tmp_path):
    make, read = FORMATS[name]
    sound, rng, refused = make(), np.random.default_rng(0), 0
    path = tmp_path / name
    path.write_bytes(sound)
    assert np.isfinite(read(path)).all()
    tracemalloc.start()
    try:
        for _ in range(40):
            path.write_bytes(mutated(sound, rng))
            message = ""
            try:
                assert np.isfinite(read(path)).all()
            except InputError as error:
                message = str(error)
            if message:
                refused += 1
                assert str(path) in message
                assert escape_line_breaks(message) == message
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()
    assert refused > 10
