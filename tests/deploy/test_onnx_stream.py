"""Exported steps in ONNX Runtime: their states, and files that are not such steps."""

import numpy as np
import onnx
import pytest
import tiny

from memmlp.common.errors import InputError
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.motion.body import SPARSE_DIM

pytestmark = pytest.mark.slow


def test_a_reset_is_a_fresh_start_and_a_peek_keeps_the_state(step_files):
    stream = OnnxStream(step_files("mem_mlp"))
    sparse = tiny.clip(5)[:, None, :SPARSE_DIM].numpy()
    first = [stream.step(frame)[1] for frame in sparse]
    stream.reset()
    again = [stream.step(frame)[1] for frame in sparse]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    before = stream.state
    stream.inputs["sparse"][:] = sparse[1]
    stream.peek()
    peeked = stream.outputs["position"].copy()
    assert all(np.array_equal(stream.state[name], array) for name, array in before.items())
    assert np.array_equal(stream.step(sparse[1])[1], peeked)
    assert not all(np.array_equal(stream.state[name], array) for name, array in before.items())


def test_networks_of_other_programs_are_rejected(tmp_path):
    real, text = onnx.TensorProto.FLOAT, onnx.TensorProto.STRING
    for name, kind, shape in (("x", real, ["batch", 3]), ("x", text, [3]), ("state.x", real, [3])):
        ends = [onnx.helper.make_tensor_value_info(end, kind, shape) for end in (name, "y")]
        node = onnx.helper.make_node("Identity", [name], ["y"])
        graph = onnx.helper.make_graph([node], "foreign", ends[:1], ends[1:])
        model = onnx.helper.make_model(graph, ir_version=9, opset_imports=[onnx.helper.make_opsetid("", 18)])
        onnx.save(model, tmp_path / "foreign.onnx")
        with pytest.raises(InputError, match=r"foreign\.onnx"):
            OnnxStream(tmp_path / "foreign.onnx")
