"""The site's stream.js in node, with the site's own ONNX Runtime: the numbers of Python's Stream."""

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wearer
from live.test_tracker_input import POSES
from live.web.conftest import RUN, Made
from processes import finished

from memmlp.common.errors import InputError
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Pose, Stream

pytestmark = pytest.mark.slow

HERE, SPACE = Path(__file__).parent, SPACES["openxr"]
TOLERANCE = 1e-4  # metres, and of rotation matrices
HEIGHT = 1.6  # metres, of another person than the network's


def samples(times: np.ndarray, lost: dict[int, tuple[int, ...]] | None = None) -> list[dict[str, Any]]:
    """A person's trackers at times, some of them lost, as the page takes them."""
    person = wearer.person(times - times[0])
    positions = SPACE.convert_positions_from_amass(person.positions).tolist()
    turns = SPACE.convert_rotations_from_amass(person.rotations).reshape(-1, 3, 3)
    rotations = matrix_to_quaternion(turns).reshape(-1, 3, 4).tolist()
    made = []
    for index, time in enumerate(times):
        gone, at = (lost or {}).get(index, ()), zip(positions[index], rotations[index], strict=True)
        trackers = [None if k in gone else {"position": p, "rotation": q} for k, (p, q) in enumerate(at)]
        made.append({"time": float(time), "trackers": trackers})
    return made


def jittered(seconds: float, hz: float) -> np.ndarray:
    """Times of a device whose clock is no good, among them one twice and one set back a little."""
    jitter = np.random.default_rng(0).uniform(-2e-3, 2e-3, round(seconds * hz))
    times = 100 + np.arange(0, seconds, 1 / hz) + jitter
    times[20], times[30] = times[19], times[29] - 0.1
    return times


def bursts() -> np.ndarray:
    """Times of arrival: every fifth sample comes right before the next, just before a frame is due."""
    times = 100 + np.arange(90) / 60 - 4e-4 * (np.arange(90) > 0)
    times[3::5] = times[4::5] - 2e-5
    return times


def t_pose() -> list[dict[str, Any]]:
    """Devices that sit crookedly on a person in T-pose who looks to the left."""
    turns = [[0.1, 0.2, 0.05, 1], [0.3, -0.6, 0.2, 1], [-0.2, 0.5, 0.4, 1]]
    places = [[0.1, 1.62, 0.2], [0.2, 1.4, 0.95], [0.1, 1.38, -0.55]]
    return [
        {"position": place, "rotation": (np.array(turn) / np.linalg.norm(turn)).tolist()}
        for place, turn in zip(places, turns, strict=True)
    ]


def gaps() -> np.ndarray:
    """Times with a pause in them, and a clock that is set back."""
    times = np.arange(0, 2, 1 / 90)
    times[60:] += 0.6
    times[120:] -= 3
    return times


def gone(first: int, end: int, *which: int) -> dict[int, tuple[int, ...]]:
    return dict.fromkeys(range(first, end), which)


def untracked() -> list[dict[str, Any]]:
    """Samples in which programs report lost trackers in all ways, the head too, and two freeze."""
    made = samples(np.arange(240) / 60)
    lost = [pose and dict(zip(("position", "rotation"), pose, strict=True)) for gone, pose in POSES if gone]
    for index, pose in enumerate(
        json.loads(json.dumps(lost).replace("Infinity", "NaN").replace("NaN", "null"))
    ):
        for sample in made[10 + 4 * index : 12 + 4 * index]:
            sample["trackers"][index % 3] = pose
    for index in range(100, 160):
        made[index]["trackers"][2] = made[100]["trackers"][2]
        made[index + 70]["trackers"][0] = made[170]["trackers"][0]
    return made


PARTS: dict[str, dict[str, Any]] = {
    "60 Hz": {"samples": samples(np.arange(120) / 60)}, "72 Hz": {"samples": samples(np.arange(144) / 72)},
    "50 Hz, jittered": {"samples": samples(jittered(1.6, 50.0))},
    "22 Hz": {"samples": samples(np.arange(40) / 22)},
    "lost hands": {"samples": samples(np.arange(144) / 72, {**gone(30, 70, 1), **gone(60, 100, 1, 2)})},
    "lost head": {"samples": samples(np.arange(100) / 60, {**gone(0, 12, 0, 2), **gone(50, 80, 0)})},
    "untracked": {"samples": untracked()},
    "gaps": {"samples": samples(gaps())}, "bursts": {"samples": samples(bursts())},
    "calibrated": {"samples": samples(np.arange(90) / 90), "calibrate": t_pose(), "height": HEIGHT},
}  # fmt: skip


HEAD, LEFT, RIGHT = t_pose()
HANGING = [HEAD, LEFT | {"position": [0.15, 0.85, 0.45]}, RIGHT | {"position": [0.15, 0.85, -0.05]}]
REFUSED = {
    "the head looks backwards relative to the hands": [HEAD, RIGHT, LEFT],
    "cm from its joint in a T-pose": HANGING,
}


def refused(words: str) -> dict[str, Any]:
    return {"samples": [], "calibrate": REFUSED[words]}


def in_python(step: Path, part: dict[str, Any]) -> tuple[Stream, list[Pose]]:
    stream = Stream(step, space="openxr", height=part.get("height"))

    def given(trackers: list[dict[str, Any] | None]) -> list[Any]:
        return [t and (t["position"], t["rotation"]) for t in trackers]

    if "calibrate" in part:
        stream.calibrate(*given(part["calibrate"]))
    return stream, [stream.step(*given(one["trackers"]), time=one["time"]) for one in part["samples"]]


@pytest.fixture(scope="module")
def answers(site: Made, node: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What node makes of all parts, in one process."""
    folder = tmp_path_factory.mktemp("node")
    entry = json.loads((site.folder / "site.json").read_text())["networks"][0]
    assert entry["run"] == RUN
    for name, packed in (("model.onnx", entry["play"]), ("ort.wasm", "ort/wasm.wasm.gz")):
        (folder / name).write_bytes(gzip.decompress((site.folder / packed).read_bytes()))
    page = folder / "page"
    (page / "three").mkdir(parents=True)
    (page / "package.json").write_text('{"type": "module"}')
    for name in ("onnx_stream.js", "stream.js", "rotations.js", "three/three.core.min.js"):
        (page / name).write_bytes((site.folder / name).read_bytes())
    (page / "wasm.js").write_bytes((site.folder / "ort/wasm.js").read_bytes())
    job = folder / "job.json"
    job.write_text(json.dumps({"body": entry["body"], "parts": [*PARTS.values(), *map(refused, REFUSED)]}))
    files = (HERE / "play.mjs", page, page / "wasm.js", folder / "ort.wasm", folder / "model.onnx", job)
    finished([node, *map(str, files)])
    names = [*PARTS, *REFUSED]
    return dict(zip(names, json.loads(Path(f"{job}.answer").read_text()), strict=True))


@pytest.mark.parametrize("name", PARTS)
def test_it_is_python_s_stream(name: str, site: Made, answers: dict[str, Any]):
    stream, expected = in_python(site.step, PARTS[name])
    found = answers[name]["poses"]
    flags = [(list(pose.held), pose.fresh, pose.restarted) for pose in expected]
    assert [(pose["held"], pose["fresh"], pose["restarted"]) for pose in found] == flags
    np.testing.assert_allclose([p["time"] for p in found], [p.time for p in expected], atol=1e-9)
    names = {"positions": "positions", "rotations": "rotations", "joints": "position_branch"}
    for theirs, ours in names.items():
        made = np.array([pose[theirs] for pose in found])
        wanted = np.array([getattr(pose, ours).ravel() for pose in expected])
        np.testing.assert_allclose(made, wanted, atol=TOLERANCE)
    if name == "untracked":
        assert {held for pose in expected for held in pose.held} == {"head", "left", "right"}
        assert [expected[index].held for index in (159, 229, 239)] == [("right",), ("head",), ()]
    if stream.offsets is not None:
        offsets = answers[name]["offsets"]
        np.testing.assert_allclose(offsets["positions"], stream.offsets.positions, atol=1e-9)
        turns = np.abs((offsets["rotations"] * matrix_to_quaternion(stream.offsets.rotations)).sum(1))
        np.testing.assert_allclose(turns, 1, atol=1e-9)


@pytest.mark.parametrize("words", REFUSED)
def test_both_refuse_other_poses_than_a_t_pose_for_the_same_reason(words: str, site, answers: dict[str, Any]):
    with pytest.raises(InputError, match=words) as error:
        in_python(site.step, refused(words))
    said = answers[words]["refused"]
    assert words in said
    assert said.split("; ")[0] in str(error.value)
    assert answers[words]["offsets"] is None
