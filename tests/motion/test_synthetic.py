"""The embedded data set: reproducible, in AMASS' layout, and of plausible people."""

import re

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.synthetic import ACTIVITIES, synthesize, synthesize_clip


def test_a_seed_gives_the_same_bytes_and_another_gives_others(tmp_path):
    first, again, other = (
        {path.relative_to(tmp_path / name): path.read_bytes() for path in made}
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
        for made in [synthesize(tmp_path / name, minutes=0.5, seed=seed, fps=20.0)]
    )
    assert first == again
    assert not set(first.values()) & set(other.values())


def test_files_are_in_amass_layout_and_last_as_long_as_asked(tmp_path):
    paths = synthesize(tmp_path, minutes=3.0, seed=1, fps=20.0)
    lengths = []
    for path in paths:
        assert re.fullmatch(rf"{path.parent.name}_\d\d\d", path.stem)
        with np.load(path, allow_pickle=False) as file:
            assert set(file.files) == {"poses", "trans", "betas", "gender", "mocap_framerate"}
            assert file["poses"].dtype == file["trans"].dtype == np.float32
            assert file["poses"].shape[1] == 156
        clip = read_clip(path, path.stem)
        assert clip.fps == 20.0
        lengths.append(len(clip))
    assert sum(lengths) == 3 * 60 * 20
    assert min(lengths) > 7 * 20
    assert max(lengths) < 22 * 20
    assert {path.parent.name for path in paths} == set(ACTIVITIES)
    assert len(set(paths)) == len(paths)


def test_a_little_is_three_short_clips_and_bad_arguments_are_named(tmp_path):
    """There is one clip for each part of a split."""
    for seconds in (0.01, 1.0):
        paths = synthesize(tmp_path / str(seconds), minutes=seconds / 60)
        lengths = [len(read_clip(path, path.stem)) for path in paths]
        assert len(lengths) == 3
        assert sum(lengths) == max(6, seconds * 60)
        assert min(lengths) >= max(2, 0.6 / 1.4 * sum(lengths) / 5)
    for key, value in (("minutes", 0.0), ("minutes", float("nan")), ("fps", 0.0), ("fps", 1e9), ("seed", -1)):
        with pytest.raises(InputError, match=f"^{key}="):
            synthesize(tmp_path / "out", **{key: value})
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="activity=flying"):
        synthesize_clip("flying", 0)
