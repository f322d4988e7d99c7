"""Seeded damage to sound files of motion: flips, cuts, splices, and changes to what headers declare."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable

import numpy as np

from memmlp.motion.synthetic import synthesize_clip

NUMBERS = (b"0", b"-1", b"1e999", b"nan", b"99999999999999999999", b"1_0", b"\xff", b"(", b"}", b"\n")


def sound_npz(packed: bool) -> bytes:
    clip, buffer = synthesize_clip("walking", 0, seconds=0.5), io.BytesIO()
    poses = np.zeros((len(clip), 156))
    poses[:, :66] = clip.poses.reshape(len(clip), -1)
    save = np.savez_compressed if packed else np.savez
    save(buffer, poses=poses, trans=clip.trans, gender="neutral", mocap_framerate=60.0)
    return buffer.getvalue()


def mutated(sound: bytes, rng: np.random.Generator) -> bytes:
    """Return the file damaged: one small change far inside, or one to three kinds of damage anywhere."""
    if rng.integers(2):
        return _entry(sound, rng)
    data = sound
    for _ in range(rng.integers(1, 4)):
        data = KINDS[rng.integers(len(KINDS))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Draw a place: anywhere, or near the beginning or the end, where the headers are."""
    last = max(1, len(data))
    near = min(last, 600)
    return int(rng.choice([rng.integers(last), rng.integers(near), last - 1 - rng.integers(near)]))


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(data or b"\0")
    for _ in range(rng.integers(1, 30)):
        damaged[_place(bytes(damaged), rng)] ^= int(rng.integers(1, 256))
    return bytes(damaged)


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _spliced(data: bytes, rng: np.random.Generator) -> bytes:
    """Repeat, move or drop a stretch."""
    start, length, target = _place(data, rng), int(rng.integers(1, 3000)), _place(data, rng)
    return data[:target] + data[start : start + length] + data[target + int(rng.integers(0, 300)) :]


def _declared(data: bytes, rng: np.random.Generator) -> bytes:
    """Put another number, or something else, where one stands in a header or a row."""
    at = _place(data, rng)
    digits = next((i for i in range(at, len(data)) if data[i : i + 1].isdigit()), at)
    return data[:digits] + NUMBERS[rng.integers(len(NUMBERS))] + data[digits + int(rng.integers(1, 4)) :]


def _entry(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage an entry of an npz and pack it soundly again, so that the damage is found inside."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as old:
            entries = {name: old.read(name) for name in old.namelist()}
    except Exception:  # a text
        return _declared(data, rng)
    if not entries:
        return data
    name = sorted(entries)[rng.integers(len(entries))]
    harm = (_flipped, _cut, _spliced, _declared, lambda *_: data)[rng.integers(5)]
    head, rest = entries[name][:128], entries[name][128:]
    entries[name] = harm(head, rng) + rest if rng.integers(2) else harm(entries[name], rng)
    buffer = io.BytesIO()
    method = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)[rng.integers(3)]
    with zipfile.ZipFile(buffer, "w", method) as new:
        for entry, content in entries.items():
            new.writestr(entry, content)
    return buffer.getvalue()


KINDS: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    _flipped, _cut, _spliced, _declared, _entry,
)  # fmt: skip
