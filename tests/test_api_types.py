"""What a type checker knows of the API in a user's script."""

from __future__ import annotations

import subprocess
import sys
import venv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

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


UNREAD = "torch.*,hydra.*,matplotlib.*,mlflow.*,omegaconf.*,onnx.*,optuna.*,plotly.*,scipy.*,sqlalchemy.*"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment where the package and what it needs are installed."""
    folder = tmp_path_factory.mktemp("user") / "venv"
    venv.create(folder, symlinks=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    places = dict.fromkeys(str(Path(module.__file__).parents[1]) for module in (memmlp, np, pd))
    (packages / "installed.pth").write_text("\n".join(places))
    return folder / "bin" / "python"


def complaints(python: Path, folder: Path) -> Iterator[tuple[str, int, str]]:
    """What mypy --strict has to say to a user's scripts: file, line, message.

    Of the libraries only numpy and pandas are read: no other types of theirs are ours, and torch alone takes
    half a minute.
    """
    (folder / "mypy.ini").write_text(f"[mypy]\n[mypy-{UNREAD}]\nfollow_imports = skip\n")
    mypy = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--hide-error-context"]
    options = [f"--python-executable={python}", f"--cache-dir={ROOT / '.mypy_cache' / 'scripts'}"]
    ran = subprocess.run(
        [*mypy, *options, "right.py", "wrong.py"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert ran.stderr == ""
    for line in ran.stdout.splitlines():
        file, number, kind, message = line.split(":", 3)
        if kind.strip() == "error":
            yield file, int(number), message


def test_mypy_of_a_script_sees_the_types(python: Path, tmp_path: Path):
    """A misspelt name, argument or value is an error, and nothing that is right is one."""
    (tmp_path / "right.py").write_text(RIGHT)
    (tmp_path / "wrong.py").write_text(WRONG)
    found = list(complaints(python, tmp_path))
    assert [complaint for complaint in found if complaint[0] != "wrong.py"] == []
    lines = WRONG.splitlines()
    assert {number for _, number, _ in found} == set(range(3, len(lines) + 1)), found
