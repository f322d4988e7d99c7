"""AMASS npz: every spelling of the frame rate, damage of every kind, no pickle."""

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import read_clip, write_clip


def arrays(frames: int = 20, width: int = 156) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "poses": rng.normal(size=(frames, width)) * 0.3,
        "trans": rng.normal(size=(frames, 3)),
        "betas": np.zeros(16),
        "gender": np.array("male"),
        "mocap_framerate": np.array(120.0),
    }


def npz(**values: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **values)  # type: ignore[arg-type]
    return buffer.getvalue()


@pytest.mark.parametrize("width", [156, 165, 66])
@pytest.mark.parametrize(
    ("key", "rate"),
    [("mocap_framerate", np.array(120.0)), ("mocap_framerate", np.array([120.0])), ("mocap_framerate", 120),
     ("mocap_framerate", np.array(b"120")), ("mocap_framerate", np.array("120.0")),
     ("mocap_frame_rate", 120.0)],
)  # fmt: skip
def test_every_spelling_is_read(key, rate, width, tmp_path):
    values = arrays(width=width)
    del values["mocap_framerate"]
    path = tmp_path / "a.npz"
    path.write_bytes(npz(**values, **{key: rate}))
    clip = read_clip(path, "a")
    assert clip.fps == 120
    np.testing.assert_allclose(clip.poses.reshape(20, 66), values["poses"][:, :66])
    np.testing.assert_allclose(clip.trans, values["trans"])


def test_written_clips_are_read_back(tmp_path):
    clip = Clip("x", arrays()["poses"][:, :66].reshape(-1, 22, 3), arrays()["trans"], 59.94)
    write_clip(tmp_path / "sub" / "x.npz", clip)
    back = read_clip(tmp_path / "sub" / "x.npz", "x")
    np.testing.assert_allclose(back.poses, clip.poses, atol=1e-6)
    assert back.fps == pytest.approx(59.94)


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
    wrong: list[dict[str, object]] = [
        {"poses": good["poses"][:, :60]}, {"poses": good["poses"][0]}, {"poses": good["poses"].astype(int)},
        {"poses": good["poses"][:0], "trans": good["trans"][:0]}, {"poses": np.full((20, 156), np.nan)},
        {"poses": np.full((20, 156), np.inf)}, {"poses": good["poses"] * 1e6}, {"trans": good["trans"][:5]},
        {"trans": good["trans"] * np.nan}, {"trans": good["trans"][:, :2]}, {"trans": np.array("a")},
        {"trans": good["trans"] + 1e9}, {"mocap_framerate": np.array(0.0)},
        {"mocap_framerate": np.array(-60.0)},
        {"mocap_framerate": np.array(np.nan)}, {"mocap_framerate": np.array("fast")},
        {"mocap_framerate": np.array([])}, {"mocap_framerate": np.array(1e9)},
        {"poses": np.zeros((20, 156), complex)},
        {"mocap_framerate": np.array([None], dtype=object)},
    ]  # fmt: skip
    files = [npz(**(good | change)) for change in wrong]
    files += [
        npz(**{k: v for k, v in good.items() if k != gone}) for gone in ("poses", "trans", "mocap_framerate")
    ]
    one = good["poses"].copy()
    one[7, 3] = np.nan
    return [*files, npz(**(good | {"poses": one})), b"", b"PK\x03\x04", b"not a zip at all", npz()]


def huge_header() -> bytes:
    """An array that claims terabytes."""
    buffer = io.BytesIO()
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 156), }"
    block = b"\x93NUMPY\x01\x00" + len(header + b"\n").to_bytes(2, "little") + header + b"\n"
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("poses.npy", block)
        archive.writestr("trans.npy", block)
        archive.writestr("mocap_framerate.npy", block)
    return buffer.getvalue()


def mutants(count: int = 130) -> list[bytes]:
    """Seeded damage: flipped bytes, cuts, zeroed and repeated blocks."""
    good, rng = npz(**arrays(6)), np.random.default_rng(1)
    made = []
    for i in range(count):
        data, at = bytearray(good), int(rng.integers(len(good)))
        if i % 4 == 0:
            made.append(bytes(data[:at]))
            continue
        if i % 4 == 1:
            for spot in rng.integers(len(good), size=40):
                data[spot] ^= int(rng.integers(1, 256))
        elif i % 4 == 2:
            data[at : at + 200] = bytes(min(200, len(good) - at))
        else:
            data[at:at] = data[at // 2 : at // 2 + 64]
        made.append(bytes(data))
    return made


def test_damage_raises_one_line_or_reads_as_finite(tmp_path):
    path, refused = tmp_path / "bad.npz", 0
    damaged = [*structural(), huge_header(), *mutants()]
    assert len(damaged) >= 150
    for content in damaged:
        path.write_bytes(content)
        message = ""
        try:
            clip = read_clip(path, "bad")
        except InputError as error:
            message = str(error)
        if message:
            refused += 1
            assert str(path) in message
            assert "\n" not in message
        else:
            assert np.isfinite(clip.poses).all()
            assert np.isfinite(clip.trans).all()
    assert refused >= 120


def test_all_structural_damage_is_refused(tmp_path):
    for i, content in enumerate([*structural(), huge_header()]):
        path = tmp_path / f"{i}.npz"
        path.write_bytes(content)
        with pytest.raises(InputError, match=path.name):
            read_clip(path, "bad")
