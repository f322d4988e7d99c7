"""AMASS npz: every spelling of the frame rate, damage of every kind, no pickle."""

import io
import pickle
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.motion.formats import npz as npz_format
from memmlp.motion.formats.npz import NoMotionError, read_clip


def arrays(frames: int = 20, width: int = 156) -> dict[str, np.ndarray]:
    """Someone who stands, Z up, and sways."""
    rng = np.random.default_rng(0)
    return {
        "poses": rng.normal(size=(frames, width)) * 0.1 + np.eye(1, width) * np.pi / 2,
        "trans": rng.normal(size=(frames, 3)) * 0.01 + [0.0, 0.0, 0.95],
        "betas": np.zeros(16),
        "gender": np.array("male"),
        "mocap_framerate": np.array(120.0),
    }


def npz(**values: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **values)  # type: ignore[arg-type]
    return buffer.getvalue()


def test_every_spelling_is_read(tmp_path):
    path = tmp_path / "a.npz"
    for key, rate, width in (
        ("mocap_framerate", np.array(120.0), 156), ("mocap_framerate", np.array([120.0]), 165),
        ("mocap_framerate", 120, 72), ("mocap_framerate", np.array(b"120"), 66),
        ("mocap_framerate", np.array("120.0"), 156), ("mocap_frame_rate", 120.0, 156), ("fps", 120, 156),
    ):  # fmt: skip
        values = arrays(width=width)
        del values["mocap_framerate"]
        path.write_bytes(npz(**values, **{key: rate}))
        clip = read_clip(path, "a")
        assert clip.fps == 120
        np.testing.assert_allclose(clip.poses.reshape(20, 66), values["poses"][:, :66])
        np.testing.assert_allclose(clip.trans, values["trans"])


def parted(root: str, body: str, trans: str, width: int) -> dict[str, np.ndarray]:
    """The motion of `arrays` under other keys, with `width` columns of body joints."""
    good = arrays()
    parts = {root: good["poses"][:, :3], body: good["poses"][:, 3 : 3 + width], trans: good["trans"]}
    return parts | {"mocap_frame_rate": np.array(120.0)}


def test_every_layout_gives_the_same_clip_and_parts_of_another_size_are_refused(tmp_path):
    for values in (
        parted("root_orient", "pose_body", "trans", 63), parted("global_orient", "body_pose", "transl", 63),
        parted("global_orient", "body_pose", "transl", 69),
        arrays() | {"poses": arrays()["poses"].reshape(20, 52, 3)},
        {key: np.asfortranarray(value) for key, value in arrays().items()},
        arrays() | {"poses": arrays()["poses"].astype(">f8")},
        arrays() | {"poses": arrays()["poses"].astype("g")},
    ):  # fmt: skip
        np.savez_compressed(tmp_path / "a.npz", **values)
        clip = read_clip(tmp_path / "a.npz", "a")
        np.testing.assert_array_equal(clip.poses.reshape(20, 66), arrays()["poses"][:, :66])
        np.testing.assert_array_equal(clip.trans, arrays()["trans"])
    path = tmp_path / "a.npz"
    good = parted("root_orient", "pose_body", "trans", 63)
    root, body = good["root_orient"], good["pose_body"]
    for change in ({"pose_body": body[:, :60]}, {"root_orient": body}, {"root_orient": root[:5]}):
        path.write_bytes(npz(**(good | change)))
        with pytest.raises(InputError, match=r"a\.npz: .*(root_orient|pose_body)"):
            read_clip(path, "a")


class Payload:
    """Unpickled, it would make a file."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pickles_are_refused_and_never_run(tmp_path):
    trace = tmp_path / "ran"
    values = arrays() | {"poses": np.array([Payload(trace)], dtype=object)}
    (tmp_path / "a.npz").write_bytes(npz(**values))
    (tmp_path / "b.npz").write_bytes(pickle.dumps(Payload(trace)))
    for name in ("a", "b"):
        with pytest.raises(InputError, match=f"{name}.npz"):
            read_clip(tmp_path / f"{name}.npz", name)
    assert not trace.exists()


def structural() -> list[bytes]:
    """Sound zip files with wrong content."""
    good = arrays()
    poses, trans = good["poses"], good["trans"]
    one = poses.copy()
    one[7, 3] = np.nan
    wrong: dict[str, list[Any]] = {
        "poses": [
            poses[:, :60], np.zeros((20, 88)), poses[0], poses.astype(int), np.full((20, 156), np.nan), one,
            np.full((20, 156), np.inf), poses * 1e6, np.zeros((20, 156), complex),
        ],
        "trans": [trans[:5], trans * np.nan, trans[:, :2], np.array("a"), trans + 1e9],
        "mocap_framerate": [0.0, -60.0, np.nan, "fast", [], 1e9, np.array([None], dtype=object)],
    }  # fmt: skip
    files = [npz(**(good | {key: np.array(bad)})) for key, values in wrong.items() for bad in values]
    files += [npz(**{key: value for key, value in good.items() if key != gone}) for gone in wrong]
    empty = npz(**(good | {"poses": poses[:0], "trans": trans[:0]}))
    return [*files, empty, b"", b"PK\x03\x04", b"not a zip at all", npz()]


def huge_header() -> bytes:
    """An array that claims terabytes."""
    buffer = io.BytesIO()
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 156), }"
    block = b"\x93NUMPY\x01\x00" + len(header + b"\n").to_bytes(2, "little") + header + b"\n"
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in ("poses", "trans", "mocap_framerate"):
            archive.writestr(f"{name}.npy", block)
    return buffer.getvalue()


def test_wrong_content_is_one_line(tmp_path):
    path = tmp_path / "bad.npz"
    for content in (*structural(), huge_header()):
        path.write_bytes(content)
        with pytest.raises(InputError, match=rf"^{path}.*\Z"):
            read_clip(path, "bad")
    np.savez(tmp_path / "shape.npz", betas=np.zeros(16))
    with pytest.raises(NoMotionError):
        read_clip(tmp_path / "shape.npz", "shape")


def test_damaged_entries_are_one_line(tmp_path):
    whole = npz(**arrays())
    with zipfile.ZipFile(io.BytesIO(whole)) as packed:
        entries = {name: packed.read(name) for name in packed.namelist()}
    sound = entries["poses.npy"]
    for poses in (
        whole,  # the entry is itself a zip
        sound.replace(b"(20, 156)", b"(20, 156 "),  # tokenize.TokenError
        sound.replace(b"'<f8'", b"'|O8'"), sound.replace(b"(20, 156)", b"(-2,-156)"),
        sound.replace(b"(20, 156)", b"(21, 156)"), b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535,
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + bytes(20), b"\x93NUMPY\x03\x00" + sound[8:], b"",
    ):  # fmt: skip
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as new:
            for name, content in (entries | {"poses.npy": poses}).items():
                new.writestr(name, content)
        with pytest.raises(InputError, match=r"\A.*a\.npz: .*(poses|cannot be read).*\Z"):
            read_clip(tmp_path / "a.npz", "a")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as new:  # frames beyond the shape are not lost silently
        for name, content in entries.items():
            new.writestr(name, content.replace(b"(20, ", b"(19, "))
    with pytest.raises(InputError, match=r"a\.npz: poses has more bytes than an array float64 \(19, 156\)"):
        read_clip(tmp_path / "a.npz", "a")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_LZMA) as new:
        for name, content in entries.items():
            new.writestr(name, content)
    with pytest.raises(InputError, match=r"a\.npz: .* compression method 14; must be stored or deflate"):
        read_clip(tmp_path / "a.npz", "a")


def peak_of_refusal(path: Path, match: str) -> int:
    """Return the most bytes that were allocated while the file was refused."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=match):
            read_clip(path, "a")
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_files_that_unpack_to_much_are_refused_before_they_do(tmp_path, monkeypatch):
    monkeypatch.setattr(npz_format, "MAX_BYTES", 1_000_000)
    path = tmp_path / "a.npz"
    np.savez_compressed(path, **(arrays() | {"poses": np.zeros((5000, 156))}))
    assert path.stat().st_size < 100_000
    assert peak_of_refusal(path, "poses has 6240128 bytes; must have at most 1000000") < 500_000


def test_clips_of_too_many_frames_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(npz_format, "MAX_ROWS", 19)
    np.savez(tmp_path / "a.npz", **arrays())
    with pytest.raises(InputError, match=r"poses has type and shape float64 \(20, 156\); must have 1 to 19"):
        read_clip(tmp_path / "a.npz", "a")
