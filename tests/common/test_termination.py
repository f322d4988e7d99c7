"""A command that is told to end finishes what it has begun."""

from __future__ import annotations

import os
import signal

import pytest

from memmlp.common.termination import closed_in_peace, termination_interrupts


class Slow:
    """A thing during whose end somebody presses Ctrl-C again."""

    closed = False

    def close(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        self.closed = True


def test_an_end_that_has_begun_is_not_interrupted():
    slow = Slow()
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), closed_in_peace(slow):
        raise KeyboardInterrupt
    assert slow.closed
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_request_to_end_is_a_ctrl_c():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), termination_interrupts():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before
