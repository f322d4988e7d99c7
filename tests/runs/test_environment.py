"""What a run records of where it ran."""

from __future__ import annotations

import json

from memmlp.runs.environment import environment


def test_environment_says_what_ran_without_the_machines_name():
    import platform

    found = environment()
    assert {"version", "git", "python", "packages", "platform", "cpu", "cores", "host"} == set(found)
    assert found["packages"]["torch"].startswith("2.")
    assert platform.node() not in json.dumps(found)
