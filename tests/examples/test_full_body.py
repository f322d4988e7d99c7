"""The examples that print joints in three languages agree with `memmlp.Stream`."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import wearer
from examples.conftest import EXAMPLES, Played

from memmlp.common import npm
from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS

pytestmark = pytest.mark.slow

ALONE = """
import runpy, sys
sys.modules.update(torch=None, memmlp=None)  # neither can be imported
sys.argv.pop(0)
runpy.run_path(sys.argv[0], run_name="__main__")
"""
FILES = ("ort.wasm.bundle.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm")
HEADERS = [Path(folder) / "onnxruntime" for folder in ("/usr/include", "/usr/local/include")]
Command = list[str]


def python(_folder: Path) -> Command:
    """The example in Python, without torch and memmlp."""
    return [sys.executable, "-c", ALONE, str(EXAMPLES / "python/full_body.py")]


def node(folder: Path) -> Command:
    """The example in JavaScript, with the package of the site."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    try:
        files = npm.read_package_files(
            npm.ONNXRUNTIME_WEB, ["package.json", *(f"dist/{name}" for name in FILES)]
        )
    except InputError as error:
        pytest.skip(str(error))
    for name, content in files.items():
        path = folder / "node_modules/onnxruntime-web" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return ["node", str(shutil.copy(EXAMPLES / "node/full_body.mjs", folder))]


def cpp(folder: Path) -> Command:
    """The example in C++, with the library of the Python package."""
    given = [Path(os.environ[name]) for name in ("ONNXRUNTIME_INCLUDE",) if name in os.environ]
    include = next((path for path in [*given, *HEADERS] if (path / "onnxruntime_cxx_api.h").is_file()), None)
    if include is None or not shutil.which("cmake") or not shutil.which("c++"):
        pytest.skip("cmake, a C++ compiler or ONNX Runtime's headers (ONNXRUNTIME_INCLUDE) are not installed")
    (library,) = (Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*")
    (folder / "libonnxruntime.so").symlink_to(library)
    (folder / "libonnxruntime.so.1").symlink_to(library)  # the name that programs look for
    paths = [f"-DONNXRUNTIME_INCLUDE={include}", f"-DONNXRUNTIME_LIBRARY={folder}/libonnxruntime.so"]
    build = ["-S", str(EXAMPLES / "cpp"), "-B", str(folder / "build"), "-DCMAKE_CXX_FLAGS=-Werror", *paths]
    for words in (build, ["--build", str(folder / "build")]):
        subprocess.run(["cmake", *words], check=True, stdout=subprocess.DEVNULL, timeout=300)
    return [str(folder / "build/full_body")]


@pytest.fixture(scope="module", params=[python, node, cpp], ids=lambda make: make.__name__)
def command(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Command:
    return request.param(tmp_path_factory.mktemp("example"))


def ran(command: Command, *files: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*command, *map(str, files)], capture_output=True, text=True, timeout=300, check=False
    )


def test_it_prints_the_joints_of_the_stream_and_refuses_bad_files(
    command: Command, played: Callable[[str], Played], step_files: Callable[[str], Path], tmp_path: Path
):
    clip = played("unity")
    done = ran(command, clip.network, clip.trackers)
    assert done.returncode == 0, done.stderr
    header, *rows = done.stdout.splitlines()
    assert header.split(",") == [f"{joint}.{axis}" for joint in JOINTS for axis in "xyz"]
    joints = np.array([row.split(",") for row in rows], float).reshape(-1, 22, 3)
    assert wearer.fastest(joints) > 10  # centimetres a second: it moves
    np.testing.assert_allclose(joints, clip.joints, atol=1e-4)

    lines = clip.trackers.read_text().splitlines()
    lines[2] = re.sub(r",[^,]+,", ",nan,", lines[2], count=1)
    damaged = tmp_path / "damaged.csv"
    damaged.write_text("\n".join(lines))
    done = ran(command, clip.network, damaged)
    assert done.returncode == 1
    assert re.fullmatch(r"\S+damaged.csv: line 3: not [^\n]+\n", done.stderr)
    done = ran(command, step_files("mem_mlp"), clip.trackers)
    assert done.returncode == 1
    assert re.fullmatch(r"[^\n]*not written by memmlp export with --scope full\n", done.stderr)
