"""Processes of memmlp's own search for garbage seldom; those that call it from Python as they like."""

import gc
import sys

from processes import finished

from memmlp.cli.main import main
from memmlp.common.python_gc import THRESHOLDS
from memmlp.sweep.executors.submitit_jobs import Requeued

COMMAND = """
import atexit, gc, sys
from memmlp.cli.main import main

atexit.register(lambda: print(gc.get_threshold(), gc.get_freeze_count() > 0))  # called after what comes later
sys.argv = ["memmlp", "--version"]
main()
"""


def test_a_command_of_its_own_process():
    said = finished([sys.executable, "-c", COMMAND]).stdout.splitlines()
    assert said[-1] == f"{THRESHOLDS} True"


def test_a_worker():
    before = gc.get_threshold()
    gc.set_threshold(1000, 1, 1)
    try:
        assert Requeued(lambda: str(gc.get_threshold()))() == str(THRESHOLDS)
    finally:
        gc.set_threshold(*before)


def test_a_command_line_that_python_calls_leaves_it_alone(capsys):
    before = gc.get_threshold()
    gc.set_threshold(1000, 1, 1)
    try:
        main(["--version"])
        assert gc.get_threshold() == (1000, 1, 1)
    finally:
        gc.set_threshold(*before)
