"""Damaged files of every format: one line, or finite numbers; never anything else, and little memory."""

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import person

from memmlp.common.errors import InputError, escape_line_breaks
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.synthetic import synthesize_clip

MOST = 50e6  # bytes while a file of at most 60 kB is read
NUMBERS = (b"0", b"-1", b"1e999", b"nan", b"99999999999999999999", b"1_0", b"\xff", b"(", b"}", b"\n")


def sound_npz() -> bytes:
    clip, buffer = synthesize_clip("walking", 0, seconds=0.5), io.BytesIO()
    poses = np.pad(clip.poses.reshape(len(clip), -1), ((0, 0), (0, 90)))
    np.savez(buffer, poses=poses, trans=clip.trans, gender="neutral", mocap_framerate=60.0)
    return buffer.getvalue()


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip bytes, cut, repeat or drop a stretch, or put another number where one stands."""
    near, last = min(len(data), 600), len(data)
    start, target = (  # anywhere, or near the beginning or the end, where the headers are
        int(rng.choice([rng.integers(last), rng.integers(near), last - 1 - rng.integers(near)]))
        for _ in range(2)
    )
    kind = rng.integers(4)
    if kind == 0:
        flips = rng.integers(1, 256, 20, dtype=np.uint8).tobytes()
        flipped = bytes(a ^ b for a, b in zip(data[start:], flips, strict=False))
        return data[:start] + flipped + data[start + len(flipped) :]
    if kind == 1:
        return data[:start]
    if kind == 2:
        return data[:target] + data[start : start + int(rng.integers(3000))] + data[target + 100 :]
    at = next((i for i in range(start, last) if data[i : i + 1].isdigit()), start)
    return data[:at] + NUMBERS[rng.integers(len(NUMBERS))] + data[at + int(rng.integers(1, 4)) :]


def damaged_inside(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage the head of an entry of an npz, or all of it, and pack it soundly again."""
    with zipfile.ZipFile(io.BytesIO(data)) as old:
        entries = {name: old.read(name) for name in old.namelist()}
    name = sorted(entries)[rng.integers(len(entries))]
    head = 128 if rng.integers(2) else len(entries[name])
    entries[name] = damaged(entries[name][:head], rng) + entries[name][head:]
    buffer, method = io.BytesIO(), (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)
    with zipfile.ZipFile(buffer, "w", method[rng.integers(3)]) as new:
        for entry, content in entries.items():
            new.writestr(entry, content)
    return buffer.getvalue()


def npz_numbers(path: Path) -> np.ndarray:
    clip = read_clip(path, "a")
    return np.concatenate([clip.poses.reshape(len(clip), -1), clip.trans], 1)


FORMATS = {
    "a.npz": (sound_npz, damaged, npz_numbers),
    "inside.npz": (sound_npz, damaged_inside, npz_numbers),
    "a.bvh": (
        lambda: person("cmu_motionbuilder", frames=5, seed=0).text().encode(), damaged,
        lambda path: read_bvh(path).compute_kinematics()[1],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_damage_is_one_line_or_finite(name, tmp_path):
    make, damage, read = FORMATS[name]
    sound, rng, messages, path = make(), np.random.default_rng(0), [], tmp_path / name
    path.write_bytes(sound)
    assert np.isfinite(read(path)).all()
    tracemalloc.start()
    try:
        for _ in range(40):
            path.write_bytes(damage(sound, rng))
            try:
                assert np.isfinite(read(path)).all()
            except InputError as error:
                messages.append(str(error))
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()
    assert len(messages) > 10
    assert all(str(path) in message and escape_line_breaks(message) == message for message in messages)
