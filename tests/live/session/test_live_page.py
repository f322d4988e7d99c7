"""The page in a browser: it draws, stops, goes back, and fits a phone."""

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import Browser
from processes import PATIENCE, hearing_interrupts, started, until

from memmlp.live.session.loop import Fitting, make_greeting, run_loop
from memmlp.live.session.server import Hub, LiveServer
from memmlp.live.session.sources import ClipSource, TrackedClip
from memmlp.live.stream import Stream

pytestmark = pytest.mark.slow

SHOWN = "Number(document.documentElement.dataset.shown)"
NEWEST = "Number(document.querySelector('#scrub').max)"


@contextlib.contextmanager
def playing(stream: Stream, source: ClipSource, hub: Hub, *rest: Any) -> Iterator[None]:
    stopped = threading.Event()
    parts = (stream, source, hub.publish, stopped, *rest)
    loop = threading.Thread(target=run_loop, args=parts, daemon=True)
    loop.start()
    yield
    stopped.set()
    loop.join(PATIENCE)


@pytest.fixture
def url(network: Path, clip: TrackedClip) -> Iterator[str]:
    source = ClipSource(clip, 60)
    hub = Hub(make_greeting(source, "tiny"))
    with LiveServer(hub, 0) as server, playing(Stream(network), source, hub):
        yield server.url


@pytest.fixture
def browser() -> Iterator[Browser]:
    with Browser() as browser:
        yield browser


def stage(browser: Browser) -> np.ndarray:
    x, y, width, height = browser.value(
        "(b => [b.x, b.y, b.width, b.height])(document.querySelector('#stage').getBoundingClientRect())"
    )
    return browser.picture()[round(y) : round(y + height), round(x) : round(x + width)].astype(int)


def test_the_shipped_network_moves_without_arguments(browser: Browser, tmp_path: Path):
    browser.size(480, 400)  # software draws what is small sooner
    line = [sys.executable, "-m", "memmlp.cli.main", "live", "--no-browser", "--port", "0"]
    with hearing_interrupts(), started(line, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        browser.open(process.stdout.readline().split()[0])
        browser.wait(f"{SHOWN} > 20")
    assert not list(tmp_path.iterdir())


def test_it_plays_pauses_and_goes_back(browser: Browser, url: str):
    browser.size(480, 400)
    browser.open(url)
    browser.wait(f"{SHOWN} > 20")
    picture = stage(browser)
    background = np.abs(picture - picture[5, 5]).max(-1) < 12
    vivid = picture.max(-1) - picture.min(-1) > 60
    assert 0.3 < background.mean() < 0.97
    assert vivid.mean() > 0.01

    browser.click("#pause")
    browser.wait("document.querySelector('#pause').textContent == 'Play'")
    stopped = browser.value(SHOWN)
    browser.wait(f"{NEWEST} > {stopped} + 20")
    assert browser.value(SHOWN) == stopped
    still = stage(browser)

    early = browser.value("Number(document.querySelector('#scrub').min)") + 3
    slide = f"s.value = {early}; s.dispatchEvent(new Event('input'))"
    browser.value(f"(s => {{ {slide} }})(document.querySelector('#scrub'))")
    browser.wait(f"{SHOWN} == {early}")
    moved = lambda: (np.abs(stage(browser) - still).max(-1) > 30).mean() > 0.002  # noqa: E731
    until(moved, "another picture")

    browser.click("#newest")
    browser.wait(f"{SHOWN} > {stopped} + 20")
    assert browser.value("document.querySelector('#about').textContent") == "tiny · person at 60 Hz"
    assert float(browser.value("document.querySelector('#mean').textContent")) > 0
    assert browser.errors == []


class Worn(ClipSource):
    """A clip that counts as somebody's devices."""

    has_wearer = True


def test_the_wearer_fits_the_stream_from_the_page(browser, network: Path, clip: TrackedClip, monkeypatch):
    monkeypatch.setattr("memmlp.live.stream.FAR", 0.0)  # nobody stands so well in a T-pose
    source, stream = Worn(clip, 60), Stream(network)
    hub = Hub(make_greeting(source, "tiny"))
    fitting = Fitting(
        stream, "amass", None, hub.publish_state, clock=lambda: 0.0
    )  # a countdown ends when cancelled
    with (
        LiveServer(hub, 0, take_command=fitting.submit_command) as server,
        playing(stream, source, hub, None, fitting),
    ):
        browser.open(server.url)
        browser.wait("document.querySelector('#height').value == '172'")
        for name, value in (("height", 186), ("floor", 5)):
            change = f"i.value = {value}; i.dispatchEvent(new Event('change'))"
            browser.value(f"(i => {{ {change} }})(document.querySelector('#{name}'))")
            until(lambda name=name, value=value: getattr(stream.wearer, name) == value / 100, name)
        browser.wait("document.querySelector('#answer').textContent.includes('5 cm')")
        noted = "new MutationObserver(() => counted.push(seconds.textContent))"
        browser.value(f"counted = []; {noted}.observe(seconds, {{ childList: true }})")
        browser.click("#calibrate")
        browser.wait("document.querySelector('#countdown').open")
        assert browser.value("document.querySelector('#what').textContent") == "Stand in a T-pose"
        assert browser.wait("counted[0]") == "5"  # whatever it shows by now
        browser.click("#cancel")
        browser.wait("!document.querySelector('#countdown').open")
        fitting.submit_command({"action": "calibrate", "value": 0})
        browser.wait("document.querySelector('#answer').classList.contains('failed')")
        whole = "parseFloat(document.querySelector('#whole').textContent)"
        assert browser.wait(whole) > 0
    assert browser.errors == []
