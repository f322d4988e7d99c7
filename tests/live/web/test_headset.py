"""The site's headset.js in node: what WebXR's input sources are taken for."""

from __future__ import annotations

import json
import subprocess
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

LEFT_HAND, LEFT_GRIP = ({"handedness": "left", kind: {}} for kind in ("hand", "gripSpace"))
RIGHT_HAND, RIGHT_GRIP = ({"handedness": "right", kind: {}} for kind in ("hand", "gripSpace"))


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """The module in a folder whose scripts are modules."""
    script = resources.files("memmlp.live.web").joinpath("page", "headset.js")
    (tmp_path / "headset.js").write_bytes(script.read_bytes())
    (tmp_path / "package.json").write_text('{"type": "module"}')
    return tmp_path


def value(node: str, page: Path, expression: str) -> Any:
    line = f"import * as headset from './headset.js'; console.log(JSON.stringify({expression}));"
    command = [node, "--input-type=module", "-e", line]
    return json.loads(subprocess.run(command, cwd=page, check=True, capture_output=True, timeout=60).stdout)


def test_each_hand_has_its_own_kind(node: str, page: Path):
    """Headsets may track a hand beside a controller; the one does not sit on the wrist as the other."""
    gaze = {"handedness": "none", "gripSpace": {}}
    cases = {
        "both": ([LEFT_GRIP, RIGHT_GRIP], ["controllers", "controllers"]),
        "hands": ([RIGHT_HAND, LEFT_HAND], ["hands", "hands"]),
        "mixed": ([LEFT_HAND, RIGHT_GRIP], ["hands", "controllers"]),
        "one": ([gaze, RIGHT_HAND], [None, "hands"]),
        "gaze": ([gaze], [None, None]),
    }
    sources = json.dumps([given for given, _ in cases.values()])
    assert value(node, page, f"{sources}.map(headset.kindsOf)") == [wanted for _, wanted in cases.values()]


def test_each_hand_has_the_offset_of_its_kind(node: str, page: Path):
    kinds = [["hands", "controllers"], ["hands", "hands"], ["controllers", "controllers"], [None, None]]
    offsets = value(node, page, f"{json.dumps(kinds)}.map(headset.usualOffsets)")
    mixed, hands, controllers, unknown = offsets
    for key in ("positions", "rotations"):
        assert mixed[key] == [hands[key][0], hands[key][1], controllers[key][2]]
        assert hands[key][2] != controllers[key][2]
    assert unknown == controllers
