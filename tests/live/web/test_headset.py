"""The site's headset.js in node: what WebXR's input sources are taken for."""

import json
import subprocess
from importlib import resources
from pathlib import Path
from typing import Any

LEFT_HAND, LEFT_GRIP = ({"handedness": "left", kind: {}} for kind in ("hand", "gripSpace"))
RIGHT_HAND, RIGHT_GRIP = ({"handedness": "right", kind: {}} for kind in ("hand", "gripSpace"))


def value(node: str, folder: Path, expression: str) -> Any:
    (folder / "headset.mjs").write_bytes(
        resources.files("memmlp.live.web").joinpath("page", "headset.js").read_bytes()
    )
    line = f"import * as headset from './headset.mjs'; console.log(JSON.stringify({expression}));"
    command = [node, "--input-type=module", "-e", line]
    return json.loads(subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=60).stdout)


def test_each_hand_has_its_own_kind_and_its_offset(node: str, tmp_path: Path):
    """Headsets may track a hand beside a controller; the one does not sit on the wrist as the other."""
    gaze = {"handedness": "none", "gripSpace": {}}
    cases = [
        ([LEFT_HAND, RIGHT_GRIP], ["hands", "controllers"]), ([RIGHT_HAND, LEFT_HAND], ["hands", "hands"]),
        ([LEFT_GRIP, RIGHT_GRIP], ["controllers", "controllers"]), ([gaze], [None, None]),
        ([gaze, RIGHT_HAND], [None, "hands"]),
    ]  # fmt: skip
    kinds = f"{json.dumps([given for given, _ in cases])}.map(headset.kindsOf)"
    assert value(node, tmp_path, kinds) == [wanted for _, wanted in cases]
    mixed, hands, controllers, unknown, _ = value(node, tmp_path, f"{kinds}.map(headset.usualOffsets)")
    for key in ("positions", "rotations"):
        assert mixed[key] == [hands[key][0], hands[key][1], controllers[key][2]]
        assert hands[key][2] != controllers[key][2]
    assert unknown == controllers
