"""Processes are alive or dead, whatever the clocks say."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from machines import Clock
from processes import started, until

from memmlp.common import liveness
from memmlp.common.liveness import Changes, lives, myself


def test_this_process_lives_and_one_of_its_number_before_it_does_not():
    assert lives(myself()) is True
    assert lives(myself() | {"born": "1"}) is False


def test_nobody_knows_of_another_machines_processes(monkeypatch: pytest.MonkeyPatch):
    here = myself()
    monkeypatch.setattr(liveness, "place", lambda: "elsewhere")
    assert lives(here) is None


def test_a_killed_process_is_dead_before_its_parent_knows():
    code = "import json; from memmlp.common.liveness import myself; print(json.dumps(myself())); input()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with started([sys.executable, "-u", "-c", code], **pipes) as process:
        told = json.loads(process.stdout.readline())
        assert told["pid"] == process.pid
        assert lives(told) is True
        process.kill()
        until(lambda: lives(told) is False, "it is dead")
        os.kill(process.pid, 0)  # its number is still taken


def test_what_changes_is_as_young_as_its_last_change():
    clock, sights = Clock(), iter("aabbb")
    changes = Changes(clock)
    ages = []
    for _ in range(5):
        ages.append(changes.unchanged("it", lambda: next(sights)))
        clock.now += 10
    assert ages == [0, 10, 0, 10, 20]
    assert changes.unchanged("another", lambda: "b") == 0
