"""Clips and folders of clips -> files of other programs; what is skipped, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Memmlp, one_line

from memmlp.common.errors import InputError
from memmlp.motion.body import RECORD, describe_body, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.exporting import FORMATS, export, find_format, plan_export, write_motion
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.npz import write_clip

REST = make_builtin_rest_joints()


def moving(seed: int, fps: float = 120.0) -> Clip:
    random = np.random.default_rng(seed)
    return Clip(f"clip {seed}", random.normal(size=(5, 22, 3)), 0.01 * random.normal(size=(5, 3)), fps)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """dance/one.v2.npz, walk.npz, bad.npz, which is none, and AMASS' shape.npz, which is none of motion."""
    for seed, name in enumerate(["dance/one.v2", "walk"]):
        write_clip(tmp_path / "clips" / f"{name}.npz", moving(seed))
    (tmp_path / "clips" / "bad.npz").write_bytes(b"no npz")
    np.savez(tmp_path / "clips" / "shape.npz", betas=np.zeros(16))
    return tmp_path / "clips"


def files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_names_are_kept_and_bad_or_equal_ones_refused(folder: Path, tmp_path: Path):
    for name, chosen in FORMATS.items():
        out = tmp_path / f"out {name}"
        report = export(plan_export(folder, out, name))
        assert files(out) == [f"dance/one.v2{chosen.suffix}", f"walk{chosen.suffix}"]
        assert [path.relative_to(out).as_posix() for path in report.written] == files(out)
        assert [skipped.file for skipped in report.skipped] == ["bad.npz"]
        assert str(tmp_path) not in report.skipped[0].reason
        assert report.seconds == pytest.approx(2 * 5 / 120)
    with pytest.raises(InputError, match=r"bad\.npz: not a zip"):
        export(plan_export(folder, tmp_path / "out", "bvh"), strict=True)
    write_clip(folder / "walk.NPZ", moving(5))
    if len(list(folder.glob("walk.*"))) == 1:
        pytest.skip("this file system does not tell letter case")
    with pytest.raises(InputError, match="walk: 2 npz files"):
        plan_export(folder, tmp_path / "out", "bvh")


def test_a_clip_keeps_its_rate_or_gets_another_and_is_exported_on_its_import_s_body(folder, tmp_path):
    export(plan_export(folder / "walk.npz", tmp_path / "own.bvh"))
    export(plan_export(folder / "walk.npz", tmp_path / "new" / "half.BVH"), fps=60)
    own, half = read_bvh(tmp_path / "own.bvh"), read_bvh(tmp_path / "new" / "half.BVH")
    assert (own.fps, len(own), half.fps, len(half)) == (120, 5, 60, 3)
    found, expected = half.compute_kinematics()[1], own.compute_kinematics()[1][::2]
    np.testing.assert_allclose(found, expected, atol=1e-4)  # cm
    (folder / RECORD).write_text(json.dumps(describe_body("model.npz", 1.1 * REST)))
    for source, out, name in ((folder, "out", "bvh"), (folder / "walk.npz", "walk.glb", None)):
        with pytest.raises(InputError, match=rf"^{folder.resolve()}: .*model\.npz.*--body"):
            export(plan_export(source, tmp_path / out, name))
    export(plan_export(folder / "walk.npz", tmp_path / "walk.npz"), fps=30)  # has no bones
    (folder / RECORD).write_text(json.dumps(describe_body("builtin", REST)))
    export(plan_export(folder / "walk.npz", tmp_path / "walk.glb"))


def test_unclear_or_dangerous_targets_are_refused(folder: Path):
    (folder.parent / "file").write_text("")
    (folder / "empty").mkdir()
    before, beside = files(folder.parent), folder / "walk.npz" / "a.glb"
    with pytest.raises(InputError, match="cannot be written"):
        write_motion(beside, moving(0), REST, find_format(beside))
    for source, out, name, *words in (
        ("none.npz", "a.bvh", None, "none.npz", "no such file or folder"),
        ("walk.npz", "a.fbx", None, "--out", "a.fbx", ".bvh, .npz, .glb"),
        ("walk.npz", "a.glb", "bvh", "--out", "--format bvh"),
        ("walk.npz", "walk.npz", None, "--out", "source"),
        (".", "../a", None, "--format", "bvh, npz, gltf"),
        (".", "below", "npz", "--out", "a separate folder"),
        ("empty", "../a", "npz", "no npz"),
    ):
        with pytest.raises(InputError) as error:
            plan_export(folder / source, folder / out, name)
        assert [word for word in words if word not in str(error.value)] == []
        assert len(str(error.value).splitlines()) == 1
    assert files(folder.parent) == before


def test_the_command_exports_or_refuses_in_one_line(folder: Path, memmlp: Memmlp, tmp_path: Path):
    ran = memmlp("data", "export", str(folder), "--out", "out", "--format", "gltf")
    assert ran.code == 0
    assert ran.out.startswith("skipped bad.npz: not a zip")
    assert ran.out.endswith("\n2 clips, 0.1 seconds, in out\n")
    assert memmlp("data", "export", str(folder / "walk.npz"), "--out", "w.bvh", "--fps", "30").code == 0
    assert read_bvh(tmp_path / "w.bvh").fps == 30
    wrong = memmlp("data", "export", str(folder / "walk.npz"), "--out", "a.bvh", "--body", "no.npz")
    assert one_line(wrong, "data.body", "no.npz")
    assert one_line(memmlp("data", "export", str(folder / "bad.npz"), "--out", "a.bvh"), "bad.npz")


def spinning(frames: int = 50) -> Clip:
    random = np.random.default_rng(4)
    axes = random.normal(size=(22, 3))
    poses = np.linspace(-9, 9, frames)[:, None, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Clip("spinning", poses, random.normal(size=(frames, 3)), 60.0)


@pytest.mark.parametrize("name", ["bvh", "gltf"])
def test_pieces_leave_no_seam(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    chosen = FORMATS[name]
    whole, parted = (tmp_path / f"{kind}{chosen.suffix}" for kind in ("whole", "parted"))
    write_motion(whole, spinning(), REST, chosen)
    for frames in (1, 49):
        monkeypatch.setattr(Clip.split_into_pieces, "__defaults__", (frames,))
        write_motion(parted, spinning(), REST, chosen)
        assert parted.read_bytes() == whole.read_bytes()
