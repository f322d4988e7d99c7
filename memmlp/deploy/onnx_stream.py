"""An exported step in ONNX Runtime, on one thread and without torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime

from memmlp.common.errors import InputError

Arrays = dict[str, np.ndarray]
STATE, NEXT = "state.", ".next"


class OnnxStream:
    """An ONNX file whose inputs `state.*` are fed by its outputs `state.*.next`.

    The state is held in two sets of arrays: a step reads the old state from one and writes the new one to the
    other, and the two are then swapped. So nothing is allocated or copied at a step.

    Args:
        path: the ONNX file.

    Attributes:
        inputs: arrays of the other inputs, to be written before a step.
        outputs: arrays of the other outputs, which keep the last step's values until the next step.

    Raises:
        InputError: if the file is missing, does not run, or does not have the inputs and outputs of an
            exported step.
    """

    def __init__(self, path: Path):
        self.path = path
        self.session = open_session(path)
        ends = [*self.session.get_inputs(), *self.session.get_outputs()]
        given = {i.name: i.shape for i in self.session.get_inputs()}
        made = {o.name: o.shape for o in self.session.get_outputs()}
        states = {name: shape for name, shape in given.items() if name.startswith(STATE)}
        floats = all(e.type == "tensor(float)" and all(isinstance(n, int) for n in e.shape) for e in ends)
        if not floats or any(made.get(name + NEXT) != shape for name, shape in states.items()):
            raise InputError(f"{path}: is not a network of memmlp; expected a file that memmlp export writes")
        self.inputs = {name: np.zeros(s, np.float32) for name, s in given.items() if name not in states}
        self._state = {name: np.zeros(shape, np.float32) for name, shape in states.items()}
        self._other = {name: np.zeros_like(array) for name, array in self._state.items()}
        self.outputs = {n: np.zeros(s, np.float32) for n, s in made.items() if not n.endswith(NEXT)}
        self._binding = self._bind(self._state, self._other)
        self._other_binding = self._bind(self._other, self._state)

    def _bind(self, old: Arrays, new: Arrays) -> onnxruntime.IOBinding:
        """Bind a step that reads the state from one set of arrays and writes it to the other."""
        binding = self.session.io_binding()
        for name, array in {**self.inputs, **old}.items():
            binding.bind_input(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
        following = {name + NEXT: array for name, array in new.items()}
        for name, array in {**self.outputs, **following}.items():
            binding.bind_output(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
        return binding

    @property
    def state(self) -> Arrays:
        """A copy of the current state."""
        return {name: array.copy() for name, array in self._state.items()}

    def reset(self) -> None:
        """Set the state to a fresh start, all zeros."""
        for array in self._state.values():
            array[:] = 0

    def peek(self) -> None:
        """Run a step without keeping its new state."""
        self.session.run_with_iobinding(self._binding)

    def advance(self) -> None:
        """Run a step from `inputs` to `outputs` and keep its new state."""
        self.peek()
        self._state, self._other = self._other, self._state
        self._binding, self._other_binding = self._other_binding, self._binding

    def step(self, *given: np.ndarray) -> list[np.ndarray]:
        """Run a step and return copies of its outputs, in the file's order.

        Args:
            given: values of the inputs, in the file's order. A file of scope `step` takes sparse (1, 54)
                and returns rotation6d (1, 22, 6) and position (1, 22, 3).
        """
        for array, value in zip(self.inputs.values(), given, strict=True):
            array[:] = value
        self.advance()
        return [array.copy() for array in self.outputs.values()]


def check_file(path: Path) -> None:
    """Raise InputError if there is no such file."""
    if not path.is_file():
        raise InputError(
            f"{path}: no such file; expected a file that memmlp export writes, or a run's folder"
        )


def start_session(model: str | bytes, severity: int = 2) -> onnxruntime.InferenceSession:
    """Start a session of ONNX Runtime on one thread.

    Args:
        model: an ONNX file's path or content.
        severity: the least severity of messages that it prints: 2 for warnings, 4 for fatal errors.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = severity
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def open_session(path: Path) -> onnxruntime.InferenceSession:
    """Open an ONNX file in ONNX Runtime on one thread.

    Raises:
        InputError: if there is no such file, or ONNX Runtime cannot run it.
    """
    check_file(path)
    try:
        return start_session(str(path))
    except Exception as error:  # ONNX Runtime's own exceptions have no common base class
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: is not an ONNX file that runs here ({reason})") from error
