"""Exported steps in ONNX Runtime, on one thread and without torch."""

from pathlib import Path

import numpy as np
import onnxruntime

from memmlp.common.errors import InputError

Arrays = dict[str, np.ndarray]
STATE, NEXT = "state.", ".next"


class OnnxStream:
    """An ONNX file that runs step by step. The outputs `state.*.next` become the next inputs `state.*`.

    There are two sets of state arrays. A step reads the old state from one set and writes the new state to
    the other set. Then the sets are swapped. So a step does not allocate or copy arrays. `inputs` and
    `outputs` are the other arrays by name: write the inputs before a step; the next step overwrites the
    outputs. Raises InputError if the file is missing, does not run, or is not an exported step."""

    def __init__(self, path: Path):
        self.path = path
        self.session = open_session(path)
        ends = [*self.session.get_inputs(), *self.session.get_outputs()]
        given = {i.name: i.shape for i in self.session.get_inputs()}
        made = {o.name: o.shape for o in self.session.get_outputs()}
        states = {name: shape for name, shape in given.items() if name.startswith(STATE)}
        floats = all(e.type == "tensor(float)" and all(isinstance(n, int) for n in e.shape) for e in ends)
        if not floats or any(made.get(name + NEXT) != shape for name, shape in states.items()):
            raise InputError(f"{path}: is not a memmlp network; expected a file from memmlp export")
        self.inputs = {name: np.zeros(s, np.float32) for name, s in given.items() if name not in states}
        self._state = {name: np.zeros(shape, np.float32) for name, shape in states.items()}
        self._other = {name: np.zeros_like(array) for name, array in self._state.items()}
        self.outputs = {n: np.zeros(s, np.float32) for n, s in made.items() if not n.endswith(NEXT)}
        self._binding = self._bind(self._state, self._other)
        self._other_binding = self._bind(self._other, self._state)

    def _bind(self, old: Arrays, new: Arrays) -> onnxruntime.IOBinding:
        """Bind a step that reads the state from `old` and writes it to `new`."""
        binding = self.session.io_binding()
        for name, array in {**self.inputs, **old}.items():
            binding.bind_input(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
        following = {name + NEXT: array for name, array in new.items()}
        for name, array in {**self.outputs, **following}.items():
            binding.bind_output(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
        return binding

    @property
    def state(self) -> Arrays:
        return {name: array.copy() for name, array in self._state.items()}

    def reset(self) -> None:
        """Set the state to zeros."""
        for array in self._state.values():
            array[:] = 0

    def peek(self) -> None:
        """Run a step from `inputs` to `outputs`, and discard the new state."""
        self.session.run_with_iobinding(self._binding)

    def advance(self) -> None:
        """Run a step from `inputs` to `outputs`, and keep the new state."""
        self.peek()
        self._state, self._other = self._other, self._state
        self._binding, self._other_binding = self._other_binding, self._binding

    def step(self, *given: np.ndarray) -> list[np.ndarray]:
        """Run a step, and return copies of the outputs. Inputs and outputs are in the file's order: a file of
        scope `step` takes sparse (1, 54) and returns rotation6d (1, 22, 6) and position (1, 22, 3)."""
        for array, value in zip(self.inputs.values(), given, strict=True):
            array[:] = value
        self.advance()
        return [array.copy() for array in self.outputs.values()]


def start_session(model: str | bytes) -> onnxruntime.InferenceSession:
    """Start an ONNX Runtime session on one thread, for the path or content of an ONNX file."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def open_session(path: Path) -> onnxruntime.InferenceSession:
    """Open an ONNX file in ONNX Runtime on one thread. Raises InputError if this fails."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a file from memmlp export, or a run's folder")
    try:
        return start_session(str(path))
    except Exception as error:  # ONNX Runtime's own exceptions have no common base class
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: cannot run in ONNX Runtime ({reason})") from error
