"""The site in a browser with a headset in software: worn, played, and all offline."""

import functools
import json
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import Browser
from live.web.conftest import PERSON, REMARK, Made, package_files

from memmlp.common.npm import Package
from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.stream import Stream
from memmlp.live.wearer import Offsets
from memmlp.live.web.site import NUMBERS, pack_clip

pytestmark = pytest.mark.long

HEADSET = Path(__file__).with_name("headset.js")
IWER = Package(  # a headset in software
    "iwer",
    "2.5.0",
    "sha512-grq7iMyWo4s2DYnATKLPPoAByhcNuwLjMHHOILrFU9q8EGHIEzHyUuq1mz+9Xqy6+xrYPn3Ho8Z9eymZCE+D6w==",
)
SITE = "document.documentElement.dataset"
TAPE = """import('./stream.js').then(({ Stream }) => {
  window.tape = [];
  const { step, calibrate } = Stream.prototype;
  Stream.prototype.step = function (...given) {
    const made = step.apply(this, given);
    const noted = { trackers: given.slice(0, 3), time: given[3] };
    window.tape.push(noted);
    const note = ({ held, fresh, positions }) => {
      Object.assign(noted, { held, positions: fresh ? [...positions] : null });
    };
    made.then(note, () => {}); // the page closes the worker while it still computes
    return made;
  };
  Stream.prototype.calibrate = function (...given) {
    const offsets = calibrate.apply(this, given);
    window.tape.push({ calibrated: offsets, scale: given[3], at: given.slice(0, 3) });
    return offsets;
  };
})"""
"""Records samples, poses and calibrations of the page's stream."""
NOTE = """{
  const write = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (...words) {
    if (words[0] == 'Not calibrated:') window.refused = true;
    return write.apply(this, words);
  };
}"""
"""What notes that the mirror's words have told of a calibration that is none."""
TWO = """Promise.all([import('./vr.js'), fetch('site.json')]).then(async ([{ vr }, answer]) => {
  const site = await answer.json();
  site.networks.push({ ...site.networks[0], key: 'other', name: 'other', run: 'other', remark: '' });
  const page = document.createElement('div');
  document.querySelector('#content').replaceChildren(page);
  delete document.documentElement.dataset.vr;
  vr(page, site);
})"""
"""The VR page again, with a second network to choose."""
REMARKED = "document.querySelector('#remark').textContent"
OPEN = "document.querySelector('nav a[aria-current]')?.hash"
TOLERANCE = 1e-4  # metres


class Server(ThreadingHTTPServer):
    """Any static server, which counts what it is asked for in vain."""

    def __init__(self, folder: Path):
        self.missing: list[str] = []
        outer = self

        class Handler(SimpleHTTPRequestHandler):
            def log_request(self, code: Any = "-", size: Any = "-") -> None:
                if int(code) >= 400:
                    outer.missing.append(self.path)

        super().__init__(("127.0.0.1", 0), functools.partial(Handler, directory=folder))
        self.url = f"http://127.0.0.1:{self.server_port}/"
        self.thread = threading.Thread(target=self.serve_forever)
        self.thread.start()

    def stop(self) -> None:
        self.shutdown()
        self.server_close()
        self.thread.join()


def test_it_is_worn_and_played_without_the_server(site: Made):
    (script,) = package_files(IWER, "build/iwer.min.js")
    with Browser(160, 120) as browser:
        browser.before(script.decode() + HEADSET.read_text())
        browser.before(NOTE)
        server = Server(site.folder)
        try:
            with Browser(360, 280) as without_headset:  # where nothing can be worn, it opens on the clips
                without_headset.open(server.url)
                without_headset.wait(f"{OPEN} == '#/play'")
            browser.open(server.url)
            browser.wait(f"{OPEN} == '#/vr'")
            browser.wait(f"{SITE}.offline == 'ready' && {SITE}.vr == 'ready'")
            browser.wait("navigator.serviceWorker.controller !== null")
        finally:
            server.stop()
        assert server.missing == []
        check_wearer(worn(browser, site), site)
        check_play(browser)
        assert browser.errors == []


def go(browser: Browser, page: str, until: str) -> None:
    origin = browser.value("location.origin")
    browser.open("about:blank")
    browser.open(f"{origin}/#/{page}")
    browser.wait(until)


def joints() -> list[list[dict[str, Any]]]:
    """The person's head and wrists, frame by frame, as the site's clip has them."""
    rows = (
        np.frombuffer(pack_clip("", PERSON.frames.numpy(), 4.0).content, "<f4").reshape(-1, NUMBERS).tolist()
    )
    return [[{"position": r[3 * i :][:3], "rotation": r[9 + 4 * i :][:4]} for i in range(3)] for r in rows]


def read_body(site: Made) -> dict[str, Any]:
    return json.loads((site.folder / "site.json").read_text())["networks"][0]["body"]


def t_pose(site: Made) -> list[dict[str, Any]]:
    body = read_body(site)
    places = (np.array(body["rest"]) - [0, body["floor"], 0]).tolist()
    return [{"position": place, "rotation": [0, 0, 0, 1]} for place in places]


def worn(browser: Browser, site: Made) -> dict[str, Any]:
    """Enter VR, calibrate in T-pose, move as the clip does, leave, choose another network. A calibration
    before, with exchanged hands and another height, is refused, and changes nothing."""
    go(browser, "vr", f"{SITE}.vr == 'ready'")
    assert browser.value(REMARKED) == f"This network is {REMARK}."
    browser.resolved(TWO)
    browser.wait(f"{SITE}.vr == 'ready'")
    height = read_body(site)["height"]
    browser.value(f"document.querySelector('#height').value = {100 * height}")
    browser.resolved(TAPE)
    browser.value("document.querySelector('#immersive-vr').click()")
    browser.wait("window.headset.session && Number(document.querySelector('#frames').textContent) > 0")
    browser.resolved("headset.learn()")
    browser.resolved(
        "import('./headset.js').then(module => { window.offsets = module.usualOffsets([null, null]); })"
    )
    browser.value(f"window.tPose = {json.dumps(t_pose(site))}")
    browser.value("document.querySelector('#height').value = 200")
    exchanged = "[[tPose[0], tPose[2], tPose[1]]]"
    browser.resolved(f"headset.play({exchanged}, offsets)")  # the countdown does not wait for a slow machine
    browser.resolved("headset.pull()")
    browser.resolved(f"headset.play({exchanged}, offsets, () => window.refused)")
    seen = browser.value("Number(document.querySelector('#frames').textContent)")
    later = f"Number(document.querySelector('#frames').textContent) > {seen} + 20"
    browser.resolved(f"headset.play([tPose], offsets, () => {later})")
    assert browser.value("document.querySelector('#user-height').textContent") == f"{height:.2f}"
    browser.value(f"document.querySelector('#height').value = {100 * height}")
    browser.resolved("headset.pull()")
    browser.resolved(f"headset.play([tPose], offsets, () => {SITE}.calibrated)")
    browser.resolved(f"headset.play({json.dumps(joints()[:120])}, offsets)")
    browser.resolved("headset.session.end()")
    choose = "s.value = 'other'; s.dispatchEvent(new Event('change'))"
    browser.value(f"(s => {{ {choose} }})(document.querySelector('#content select'))")
    assert browser.value("document.querySelector('#remark').hidden")
    return {"samples": browser.value("tape"), "worn": browser.value("offsets")}


def check_wearer(recording: dict[str, Any], site: Made) -> None:
    """The samples that the page recorded, through Python's Stream: the same joints to 1e-4 m."""
    calibrated = [sample for sample in recording["samples"] if "calibrated" in sample]
    assert len(calibrated) == 1
    begun = recording["samples"].index(calibrated[0])
    offsets = Offsets(*(calibrated[0]["calibrated"][key] for key in ("positions", "rotations")))
    height = read_body(site)["height"] / calibrated[0]["scale"]
    stream, apart = Stream(site.step, space="openxr", height=height), []
    worn = recording["worn"]  # how the devices sat on the network's own body, laid as near as it can be
    np.testing.assert_allclose(offsets.rotations, worn["rotations"], atol=1e-5)
    np.testing.assert_allclose(offsets.positions[0], 2 / 3 * np.array(worn["positions"][0]), atol=1e-5)
    found = stream.calibrate(*given(calibrated[0]["at"]))
    np.testing.assert_allclose(found.positions, offsets.positions, atol=1e-5)
    stream.offsets = Offsets(np.array(offsets.positions), quaternion_to_matrix(np.array(offsets.rotations)))
    for sample in recording["samples"][begun + 1 :]:
        if "held" not in sample:  # it still waited for the network
            break
        pose = stream.step(*given(sample["trackers"]), time=sample["time"])
        if sample["positions"]:
            made = np.array(sample["positions"]).reshape(-1, 3)
            apart.append(np.linalg.norm(made - pose.positions, axis=1).max())
        assert list(pose.held) == sample["held"]
    assert len(apart) > 40
    assert max(apart) <= TOLERANCE, max(apart)


def given(trackers: list[dict[str, Any] | None]) -> list[Any]:
    return [t and (t["position"], t["rotation"]) for t in trackers]


def check_play(browser: Browser) -> None:
    go(browser, "play", f"Number({SITE}.shown) > 20")
    browser.value("document.querySelector('#pause').click()")
    browser.wait("document.querySelector('#pause').textContent == 'Play'")
    assert 0 < float(browser.value("document.querySelector('#mean').textContent")) < 200
    assert browser.value(REMARKED) == f"This network is {REMARK}."
