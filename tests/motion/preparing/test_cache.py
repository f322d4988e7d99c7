"""Caches: content, manifest, bad files, digests, interruption, concurrency."""

import contextlib
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from processes import forked

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.motion.body import PARENTS, RECORD, describe_body, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.geometry import compute_motion_frames
from memmlp.motion.preparing import survey as survey_module
from memmlp.motion.preparing.cache import ClipFolder, prepare_cache
from memmlp.motion.preparing.manifest import Manifest
from memmlp.motion.preparing.splits import SeededSplit
from memmlp.runs.identity import VERSIONS


def motion(length: int, seed: int, fps: float = 60.0) -> Clip:
    rng = np.random.default_rng(seed)
    poses = 0.1 * np.cumsum(rng.normal(size=(length, 22, 3)), 0)
    return Clip(f"a/{seed}", poses, 0.01 * np.cumsum(rng.normal(size=(length, 3)), 0), fps)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for seed in range(10):
        clip = motion(60 + seed, seed, 120 if seed == 3 else 60)
        write_clip(tmp_path / "clips" / "a" / f"{seed}.npz", clip)
    return tmp_path / "clips"


def source(root: Path, **changes) -> ClipFolder:
    return replace(ClipFolder(root, SeededSplit(test=0.2, val=0.2), min_frames=20), **changes)


def test_the_cache_holds_the_clips_frames(root, tmp_path):
    manifest = prepare_cache(source(root), tmp_path / "cache")
    assert manifest == Manifest.load(tmp_path / "cache")
    assert {name: total.clips for name, total in manifest.totals.items()} == {"train": 6, "val": 2, "test": 2}
    rest = torch.tensor(make_builtin_rest_joints())
    for record in manifest.clips:
        seed = int(record.name.split("/")[1])
        clip = motion(60 + seed, seed)
        step = 2 if seed == 3 else 1
        assert record.resampling == ("every 2. frame" if seed == 3 else "kept")
        poses, trans = (x[::step].astype(np.float32).astype(np.float64) for x in (clip.poses, clip.trans))
        expected = compute_motion_frames(torch.tensor(poses), torch.tensor(trans), rest).float()
        split = MotionDataset.open(tmp_path / "cache", record.split)
        found = split.read_clip(split.names.index(record.name))
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def test_bad_files_are_skipped_with_a_reason_or_stop(root, tmp_path):
    (root / "a" / "broken.npz").write_bytes(b"PK broken")
    write_clip(root / "a" / "short.npz", motion(5, 99))
    np.savez(root / "a" / "shape.npz", betas=np.zeros(16))
    manifest = prepare_cache(source(root), tmp_path / "cache")
    assert {Path(file.file).name for file in manifest.skipped} == {"broken.npz", "short.npz"}
    assert all(file.reason and "\n" not in file.reason for file in manifest.skipped)
    assert len(manifest.clips) == 10
    with pytest.raises(InputError, match="npz"):
        prepare_cache(source(root, strict=True), tmp_path / "strict")
    assert not (tmp_path / "strict" / "manifest.json").exists()
    write_json(root / RECORD, describe_body("tall.npz", 1.1 * make_builtin_rest_joints()))
    with pytest.raises(InputError, match=r"tall\.npz.*data\.body"):
        prepare_cache(source(root), tmp_path / "cache")


def test_unchanged_sources_are_not_read_again(root, tmp_path, monkeypatch):
    """Other clips of the same sizes and times are, as from an archive that sets every file's time."""
    first = prepare_cache(source(root), tmp_path / "cache")
    with monkeypatch.context() as patch:
        patch.setattr(survey_module, "read_clip", lambda *_: pytest.fail("read a clip"))
        assert prepare_cache(source(root), tmp_path / "cache") == first
    path = next(root.rglob("*.npz"))
    stat, clip = path.stat(), read_clip(path, "a")
    write_clip(path, replace(clip, poses=clip.poses[::-1].copy()))
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert path.stat().st_size == stat.st_size
    assert prepare_cache(source(root), tmp_path / "cache").digest != first.digest


def test_the_digest_knows_every_ingredient(root, tmp_path):
    base = prepare_cache(source(root), tmp_path / "0").digest
    copy = shutil.copytree(root, tmp_path / "elsewhere")
    assert prepare_cache(source(copy), tmp_path / "1").digest == base
    body = make_builtin_rest_joints() * 1.1
    model = tmp_path / "model.npz"
    parents = np.array([[-1, *PARENTS[1:]], range(22)])
    np.savez(model, J_regressor=np.eye(22), v_template=body, kintree_table=parents)
    others = [source(root, split=SeededSplit(test=0.2, val=0.2, seed=1)), source(root, body=str(model))]
    digests = {prepare_cache(other, tmp_path / f"x{i}").digest for i, other in enumerate(others)}
    (root / "a" / "9.npz").unlink()
    digests.add(prepare_cache(source(root), tmp_path / "y").digest)
    assert len(digests | {base}) == 4


def test_how_frames_are_interpolated_counts_where_some_are(root, tmp_path):
    def prepared(name: str, interpolation: str) -> tuple[str, np.ndarray]:
        manifest = prepare_cache(source(root, interpolation=interpolation), tmp_path / name)
        assert manifest.interpolation == interpolation
        return manifest.digest, np.load(tmp_path / name / "train.npy")

    (lines, _), (splines, _) = prepared("0", "lines"), prepared("1", "splines")
    assert lines == splines  # all rates are multiples of 60 Hz
    for seed in range(10):
        write_clip(root / "a" / f"{seed}.npz", motion(60 + seed, seed, 30))
    (lines, ours), (splines, theirs) = prepared("0", "lines"), prepared("1", "splines")
    assert lines != splines
    assert ours.shape == theirs.shape
    assert not np.array_equal(ours, theirs)


def test_unfinished_caches_and_those_of_another_format_are_made_again(root, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Manifest, "write", lambda *args: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            prepare_cache(source(root), tmp_path / "cache")
    with pytest.raises(InputError):
        Manifest.load(tmp_path / "cache")
    assert len(prepare_cache(source(root), tmp_path / "cache").clips) == 10
    path = tmp_path / "cache" / "manifest.json"
    first = prepare_cache(source(root), tmp_path / "cache")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 1}))
    with pytest.raises(InputError, match="format 1"):
        Manifest.load(tmp_path / "cache")
    assert prepare_cache(source(root), tmp_path / "cache") == first
    assert str(tmp_path) not in path.read_text()


def test_other_caches_and_files_are_kept_without_overwrite(root, tmp_path):
    out = tmp_path / "cache"
    first = prepare_cache(source(root), out, overwrite=False)
    shutil.copytree(root, tmp_path / "copy")
    same = prepare_cache(source(tmp_path / "copy"), out, overwrite=False)
    assert (same.digest, Manifest.load(out)) == (first.digest, same)
    before = {path: path.read_bytes() for path in out.glob("[!.]*")}
    with pytest.raises(InputError, match="other data or settings"):
        prepare_cache(source(root, min_frames=62), out, overwrite=False)
    assert {path: path.read_bytes() for path in before} == before
    for folder in (root / "a", tmp_path / "arrays"):
        folder.mkdir(exist_ok=True)
        np.save(folder / "train.npy", np.zeros(2))
        files = sorted(folder.iterdir())
        with pytest.raises(InputError, match=r"has other files, such as (0\.npz|train\.npy)"):
            prepare_cache(source(root), folder, overwrite=False)
        assert sorted(folder.iterdir()) == files


def _digest(root: Path, cache: Path, said: Path) -> None:
    said.write_text(prepare_cache(source(root), cache).digest)


@pytest.mark.slow
def test_two_processes_at_once(root, tmp_path):
    said = [tmp_path / "one.txt", tmp_path / "other.txt"]
    with contextlib.ExitStack() as running:
        both = [running.enter_context(forked(_digest, root, tmp_path / "cache", path)) for path in said]
        assert [process.wait() for process in both] == [0, 0]
    digests = [path.read_text() for path in said]
    assert len(set(digests)) == 1
    assert Manifest.load(tmp_path / "cache").digest == digests[0]


def test_frames_of_an_older_component_version_are_made_again(root, tmp_path, monkeypatch):
    first = prepare_cache(source(root), tmp_path / "cache")
    made = (tmp_path / "cache" / "train.npy").stat().st_mtime_ns
    prepare_cache(source(root), tmp_path / "cache")
    assert (tmp_path / "cache" / "train.npy").stat().st_mtime_ns == made
    monkeypatch.setitem(VERSIONS, "features", VERSIONS["features"] + 1)
    again = prepare_cache(source(root), tmp_path / "cache")
    assert (tmp_path / "cache" / "train.npy").stat().st_mtime_ns > made
    assert again.digest == first.digest
