"""Graphs without their weights run with others of the same size, and take no part of what is no weight."""

from __future__ import annotations

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from memmlp.deploy import latency
from memmlp.deploy.latency import YARDSTICK_SHAPE, yardstick
from memmlp.live.web.networks import LEAST, LOCATION, remove_weights


def drawn_bytes(drawn: list) -> bytearray:
    """What a page draws, here by NumPy."""
    last = drawn[-1]
    content, random = bytearray(last.offset + 4 * last.size), np.random.default_rng(0)
    for part in drawn:
        values = random.normal(0, part.scale, part.size)
        raw = values.astype(part.kind).tobytes()
        content[part.offset : part.offset + len(raw)] = raw
    return content


def test_the_yardstick_runs_with_drawn_weights(monkeypatch: pytest.MonkeyPatch):
    """All of it, where runs of the tests have one layer (tests/small_pictures.py)."""
    monkeypatch.setattr(latency, "YARDSTICK_SHAPE", YARDSTICK_SHAPE)  # as it was imported
    assert YARDSTICK_SHAPE[2] == 8
    whole = yardstick().SerializeToString()
    model = yardstick()
    (part,) = drawn = remove_weights(model)
    _, width, _ = YARDSTICK_SHAPE
    assert (part.offset, part.size, part.kind) == (0, width * width, "float32")
    assert part.scale == pytest.approx(1 / np.sqrt(width), rel=0.02)
    bare = model.SerializeToString()
    assert len(bare) < len(whole) / 100
    options = onnxruntime.SessionOptions()
    content = bytes(drawn_bytes(drawn))
    options.add_external_initializers_from_files_in_memory([LOCATION], [content], [len(content)])
    session = onnxruntime.InferenceSession(bare, options, providers=["CPUExecutionProvider"])
    (made,) = session.run(None, {"input": np.ones(YARDSTICK_SHAPE[:2], np.float32)})
    (real,) = onnxruntime.InferenceSession(whole, providers=["CPUExecutionProvider"]).run(
        None, {"input": np.ones(YARDSTICK_SHAPE[:2], np.float32)}
    )
    assert np.isfinite(made).all()
    assert 0.1 < made.std() / real.std() < 10


def graph(**tensors: np.ndarray) -> onnx.ModelProto:
    made = [numpy_helper.from_array(values, name) for name, values in tensors.items()]
    return helper.make_model(helper.make_graph([], "g", [], [], made))


def test_masks_indices_and_small_tensors_stay():
    count = LEAST // 4
    model = graph(
        small=np.ones(count - 1, np.float32),
        mask=np.where(np.arange(count) % 2, -np.inf, 0).astype(np.float32),
        index=np.arange(count),
        weight=np.full((2, count), 0.5, np.float32),
        half=np.full(2 * count + 8, 0.25, np.float16),
        bytes=np.full(5 * count, -3, np.int8),
    )
    drawn = remove_weights(model)
    assert [(part.size, part.kind, part.scale) for part in drawn] == [
        (2 * count, "float32", 0.5),
        (2 * count + 8, "float16", 0.25),
        (5 * count, "int8", 3.0),
    ]
    outside = [t.name for t in model.graph.initializer if t.data_location == TensorProto.EXTERNAL]
    assert outside == ["weight", "half", "bytes"]
    ends = [part.offset + part.size * np.dtype(part.kind).itemsize for part in drawn]
    assert all(end <= part.offset for end, part in zip(ends, drawn[1:], strict=False))
    assert all(part.offset % 64 == 0 for part in drawn)
