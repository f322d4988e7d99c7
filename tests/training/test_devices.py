"""Devices by their names, and what a manifest says of them."""

import pytest
import torch

from memmlp.common import distributed
from memmlp.common.errors import InputError
from memmlp.training.devices import choose_device, describe_missing_gpu


@pytest.fixture
def gpus(monkeypatch: pytest.MonkeyPatch):
    def there(count: int) -> None:
        answers = {"is_available": count > 0, "device_count": count, "current_device": 0}
        for name, answer in answers.items():
            monkeypatch.setattr(torch.cuda, name, lambda answer=answer: answer)
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda used: f"Card {used.index}")

    return there


def test_with_two_gpus(gpus, monkeypatch: pytest.MonkeyPatch):
    gpus(2)
    found = {name: str(choose_device(name)) for name in ("auto", "cpu", "cuda", "cuda:1")}
    assert found == {"auto": "cuda:0", "cpu": "cpu", "cuda": "cuda:0", "cuda:1": "cuda:1"}
    with pytest.raises(InputError, match="device=cuda:2: must be cuda:0 to cuda:1"):
        choose_device("cuda:2")
    assert describe_missing_gpu() is None
    gpus(2)
    monkeypatch.setattr(distributed, "world_size", lambda: 2)
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert str(choose_device("auto")) == "cuda:1"
    with pytest.raises(InputError, match="device=cuda:1: must be cuda with several"):
        choose_device("cuda:1")


def test_float32_is_no_tf32_on_a_gpu(gpus, monkeypatch: pytest.MonkeyPatch):
    gpus(1)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    choose_device("cpu")
    assert torch.backends.cudnn.allow_tf32
    choose_device("auto")
    assert not torch.backends.cudnn.allow_tf32
    assert not torch.backends.cuda.matmul.allow_tf32


def test_without_gpus(gpus, monkeypatch: pytest.MonkeyPatch):
    gpus(0)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert str(choose_device("auto")) == "cpu"
    for name in ("cuda", "cuda:1", "mps"):
        with pytest.raises(InputError, match=f"device={name}: "):
            choose_device(name)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    assert "torch" in str(describe_missing_gpu())
    assert "CUDA_VISIBLE_DEVICES is '3'" in str(describe_missing_gpu())
