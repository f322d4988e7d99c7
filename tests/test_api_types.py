"""The types of the API in a user's script."""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pandas as pd

import memmlp

ROOT = Path(memmlp.__file__).parents[1]

RIGHT = """
from pathlib import Path
from typing import assert_type

import numpy as np
import pandas as pd

import memmlp

run = memmlp.load_run("0123", outputs="outputs")
assert_type(memmlp.Runs("outputs")[0], memmlp.TrainedRun)
assert_type(memmlp.Runs()[1:], memmlp.Runs)
assert_type(memmlp.Runs().per_clip(), pd.DataFrame)
assert_type(run.results["stream"]["rotation"]["MPJPE"], float)
prediction = run.predict("clip", mode="window")
assert_type(prediction, memmlp.Prediction)
prediction.draw("clip.gif", begin=1, end=2.5)
assert_type(prediction.save("clip.glb", truth=True), Path)
assert_type(run.model.count_parameters(), int)
offsets = memmlp.Offsets(np.zeros((3, 3)), np.zeros((3, 3, 3)))
pose = memmlp.Stream(run, space="unity", offsets=offsets).step(((0, 1, 0), np.eye(3)), None, None, time=0.5)
assert_type(pose, memmlp.Pose)
assert_type(run.stream(rotations="quaternion"), memmlp.Stream)
"""

WRONG = """
import memmlp
run = memmlp.load_run("0123", output="outputs")
memmlp.Runs(folder="outputs")
memmlp.Runs()[0].per_clips()
run.predict("clip", mod="window")
run.predict("clip", "windows")
run.predict("clip").draw("a.png", frames=3)
run.predict("clip").error()
run.predict("clip").save("clip.glb", thruth=True)
run.seed = "0"
run.stream(spcae="unity")
memmlp.Stream("run", space="untiy")
memmlp.Stream("run").step(None, None, None).position
memmlp.Strem("run")
memmlp.load_run(3)
"""


SKIPPED = "torch.*,hydra.*,matplotlib.*,mlflow.*,omegaconf.*,onnx.*,optuna.*,plotly.*,scipy.*,sqlalchemy.*"


def test_mypy_strict_reports_every_wrong_line_of_a_script_and_no_other(tmp_path: Path):
    """Of the libraries mypy follows only numpy and pandas, since torch alone takes half a minute."""
    venv.create(tmp_path / "venv", symlinks=True)
    (packages,) = tmp_path.glob("venv/lib/python*/site-packages")
    places = dict.fromkeys(str(Path(module.__file__).parents[1]) for module in (memmlp, np, pd))
    (packages / "installed.pth").write_text("\n".join(places))
    (tmp_path / "mypy.ini").write_text(f"[mypy]\n[mypy-{SKIPPED}]\nfollow_imports = skip\n")
    (tmp_path / "right.py").write_text(RIGHT)
    (tmp_path / "wrong.py").write_text(WRONG)
    options = [
        "--strict",
        "--no-error-summary",
        "--hide-error-context",
        "--python-executable=venv/bin/python",
    ]
    command = [sys.executable, "-m", "mypy", *options, f"--cache-dir={ROOT / '.mypy_cache' / 'scripts'}"]
    ran = subprocess.run(
        [*command, "right.py", "wrong.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.stderr == ""
    found = [line.split(":", 3)[:3] for line in ran.stdout.splitlines()]
    errors = {(file, int(number)) for file, number, kind in found if kind.strip() == "error"}
    expected = {("wrong.py", number) for number in range(3, len(WRONG.splitlines()) + 1)}
    assert errors == expected, ran.stdout
