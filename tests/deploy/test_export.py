"""The ONNX step: the same numbers on a whole clip, its interface, its latency."""

import json
import logging

import numpy as np
import onnx
import pytest
import tiny
import torch

from memmlp.common import thread_core_share
from memmlp.deploy import latency
from memmlp.deploy.export import export, save
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import TOLERANCE, parity
from memmlp.motion.body import JOINTS, SPARSE_DIM
from memmlp.networks.memory import NoMemory
from memmlp.networks.vqvae import VQVAE

pytestmark = pytest.mark.slow

CLIP = tiny.clip(50)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A network as it was trained; others are in tests/config/test_build.py, streams in exported.py."""
    model = tiny.model()
    path = tmp_path_factory.mktemp("onnx") / "step.onnx"
    export(model, path, "0123456789abcdef")
    return model, path


def test_torch_and_onnx_agree_on_a_whole_clip(exported):
    model, path = exported
    assert parity(model, path, CLIP) <= TOLERANCE


class SameTwice(torch.nn.Module):
    """Two outputs that are one constant, which the exporter's passes complain of."""

    def forward(self, x):
        return x, torch.ones(1, 40), torch.ones(1, 40)


def test_an_export_says_nothing_of_its_own_passes(tmp_path, caplog):
    save(SameTwice(), (torch.zeros(1),), ["x"], ["y", "ones.next", "again.next"], tmp_path / "step.onnx", {})
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_interface_and_metadata(exported):
    model, path = exported
    graph = onnx.load(path)
    inputs = {i.name: [d.dim_value for d in i.type.tensor_type.shape.dim] for i in graph.graph.input}
    outputs = {o.name: [d.dim_value for d in o.type.tensor_type.shape.dim] for o in graph.graph.output}
    states = {name: list(tensor.shape) for name, tensor in model.initial_state(1).items()}
    assert inputs == {"sparse": [1, 54]} | {f"state.{name}": shape for name, shape in states.items()}
    assert outputs == {"rotation6d": [1, 22, 6], "position": [1, 22, 3]} | {
        f"state.{name}.next": shape for name, shape in states.items()
    }
    props = {p.key: p.value for p in graph.metadata_props}
    assert json.loads(props["joints"]) == list(JOINTS)
    assert (props["fps"], props["T"], props["run_id"]) == ("60", "7", "0123456789abcdef")
    assert "features" in props
    assert "memmlp_version" in props


def test_zeros_are_a_fresh_start(exported):
    _, path = exported
    stream = OnnxStream(path)
    sparse = CLIP[:5, None, :SPARSE_DIM].numpy()
    first = [stream.step(frame)[1] for frame in sparse]
    stream.reset()
    again = [stream.step(frame)[1] for frame in sparse]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


def test_latency_and_size(exported, small_yardstick):
    model, path = exported
    measured = latency.measure_step(path, steps=1)
    assert measured["steps"] == 200
    assert 0 < measured["median_ms"] <= measured["p95_ms"]
    assert measured["ratio_to_yardstick"] > 0
    assert 0 < measured["core_share"] < 1.01
    size = latency.size(model, model, path)
    assert size["flops"] == 2 * size["macs"] > 0
    assert size["onnx_bytes"] == path.stat().st_size


@pytest.mark.parametrize("codebook", ["ema", "gradient"])
def test_code_vectors_are_counted_however_they_are_learned(codebook, tmp_path):
    model = tiny.model(codes=VQVAE(codes=5, width=16, encoder_depth=1, codebook=codebook))
    (file := tmp_path / "step.onnx").touch()
    size = latency.size(model, model, file)
    encoder, decoder = 252 * 16 + 16 + 2 * 16 + 16 * 16 + 16, 2 * 16 + 16 * 16 + 16 + 16 * 132 + 132
    assert size["parameters_with_vqvae"] - size["parameters"] == encoder + 5 * 16 + decoder


def test_a_thread_without_a_core_is_seen(exported, small_yardstick, monkeypatch):
    clock = iter([5.0, 5.0 + 1e-9])
    monkeypatch.setattr(latency.time, "thread_time", lambda: next(clock))
    assert latency.measure_step(exported[1], steps=1)["core_share"] < 1e-6


def test_the_order_of_files_is_reversed_and_each_rounds_share_of_a_core_is_kept(monkeypatch):
    """By clocks of the test's own: a step is 2 s, and the second round's `b` waits 6 s more for a core."""
    clock, order = {"passed": 0.0, "busy": 0.0}, []
    monkeypatch.setattr(thread_core_share.time, "perf_counter", lambda: clock["passed"])
    monkeypatch.setattr(thread_core_share.time, "thread_time", lambda: clock["busy"])

    def time_round(key):
        order.append(key)
        clock["busy"] += 2
        clock["passed"] += 8 if order == ["a", "b", "b"] else 2
        return np.array([2.0])

    found = latency.in_turn("ab", 3, time_round)
    assert order == ["a", "b", "b", "a", "a", "b"]
    assert found["a"].core_shares.tolist() == [1, 1, 1]
    assert found["b"].core_shares.tolist() == [1, 0.25, 1]
    assert found["b"].seconds.tolist() == [[2], [2], [2]]


def test_files_are_timed_in_turn(exported):
    found = latency.time_in_turn({"a": exported[1], "b": exported[1]}, 2, 3)
    assert all(times.seconds.shape == (2, 3) and (times.seconds > 0).all() for times in found.values())
    assert all(times.core_shares.shape == (2,) for times in found.values())


def test_macs_are_counted_by_hand():
    """The network has a stem, 4 blocks of time and channel mixing, and two branches of a block and a
    linear.
    """
    model = tiny.model(NoMemory)
    frames, hidden = model.frames, model.hidden
    block = frames * frames * hidden + frames * hidden * hidden
    newest = frames * hidden + hidden * hidden  # the branches' last block makes the newest frame alone
    expected = frames * 54 * hidden + 4 * block + 2 * newest + hidden * (132 + 66)
    with torch.no_grad():
        assert latency.macs(model) == expected
