"""Checkpoints: damage is refused, and a file that changes while it is read is read as one version."""

import pytest
import torch

from memmlp.common.errors import InputError
from memmlp.networks import checkpoint


def test_a_checkpoint_is_read_whole_or_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    checkpoint.write(path, {"a": torch.arange(3)}, {"step": 3})
    (tmp_path / ".checkpoint.safetensors.1.tmp").write_bytes(b"half")
    tensors, values = checkpoint.read(path)
    assert values == {"step": 3}
    assert torch.equal(tensors["a"], torch.arange(3))
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(InputError, match=r"checkpoint\.safetensors"):
        checkpoint.read(path)
    module, other = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
    collect = checkpoint.collect_module_tensors
    tensors = collect("model", other) | collect("modelling", module)
    checkpoint.load_module("model", module, tensors)
    assert torch.equal(module.weight, other.weight)


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_the_old_one(tmp_path, monkeypatch):
    """It was opened twice, for its header and for its tensors, which were another file's by then."""
    path, load = tmp_path / "checkpoint.safetensors", checkpoint.load
    checkpoint.write(path, {"a": torch.arange(30)}, {"step": 3})

    def replaced(content: bytes) -> dict[str, torch.Tensor]:
        checkpoint.write(path, {"a": torch.arange(3)}, {"step": 4})
        return load(content)

    monkeypatch.setattr(checkpoint, "load", replaced)
    tensors, values = checkpoint.read(path)
    assert values == {"step": 3}
    assert torch.equal(tensors["a"], torch.arange(30))
