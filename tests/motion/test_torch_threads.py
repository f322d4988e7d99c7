"""Torch's threads while clips are imported."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from bvh_samples import performed, write

from memmlp.motion.importing import convert as module
from memmlp.motion.importing.import_folder import import_folder
from memmlp.motion.importing.skeleton_map import load_skeleton
from memmlp.motion.importing.verify_files import verify
from memmlp.motion.synthetic import synthesize_clip
from memmlp.motion.torch_threads import one_thread


@pytest.fixture(autouse=True)
def _two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_one_thread_and_then_as_many_as_before() -> None:
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2


def test_imports_keep_torch_to_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With more, short clips wait for one another, and busily at that."""
    seen, posed = [], module.clip_kinematics

    def counted(*arguments: object) -> object:
        seen.append(torch.get_num_threads())
        return posed(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "clip_kinematics", counted)
    torch.set_num_threads(2)
    path = write(
        tmp_path, performed(load_skeleton("cmu_daz"), synthesize_clip("walking", 1, seconds=1.0)).text()
    )
    import_folder(path, tmp_path / "out")
    verify(path)
    assert seen == [1, 1]
