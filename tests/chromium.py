"""Headless Chromium, driven over a pipe by its DevTools protocol: clicks, values, pictures."""

from __future__ import annotations

import atexit
import base64
import functools
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
from typing import Any

import numpy as np
import pytest
from PIL import Image
from processes import MARK, PATIENCE, until

SETPRIV = shutil.which("setpriv")
MODEST = [SETPRIV, "--bounding-set=-sys_nice"] if SETPRIV and os.geteuid() == 0 else []
"""Keeps a root's browser from raising its priority, which starves other processes."""
SLOW_DRAWING = """{
  const display = window.requestAnimationFrame.bind(window);
  window.seldom = 150;
  window.requestAnimationFrame = callback => setTimeout(() => display(callback), window.seldom);
}"""
"""Lets a page draw every `window.seldom` milliseconds only: software draws slowly."""
STALL = "GPU stall due to ReadPixels"  # a warning of drivers in software
UNUSED = [f"WebUIOmnibox{which}Popup" for which in ("", "Full", "Aim")] + ["SpareRendererForSitePerProcess"]
"""Features that load internal pages beside each of a test's: a second of CPU time."""
NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)


class Chromium:
    """A browser that reaches this machine only, and lives as long as the test process. It lacks the mark of
    processes that end with a test file."""

    def __init__(self) -> None:
        if CHROMIUM is None:
            pytest.skip("Chromium is not installed (apt-get install chromium)")
        self.litter = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
        command = [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run",
            "--disable-gpu-compositing",  # a tenth of its time without a GPU
            f"--disable-features={','.join(UNUSED)}",
            "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
            "--remote-debugging-pipe", f"--user-data-dir={self.litter.name}/profile", "about:blank",
        ]  # fmt: skip
        (theirs_in, self.write), (self.read, theirs_out) = os.pipe(), os.pipe()
        line = [*MODEST, "bash", "-c", f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}', "bash", *command]
        unmarked = {name: value for name, value in os.environ.items() if name != MARK}
        self.process = subprocess.Popen(
            line, pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env={**unmarked, "TMPDIR": self.litter.name},
        )  # fmt: skip
        os.close(theirs_in), os.close(theirs_out)
        self.buffer, self.count = b"", 0
        atexit.register(self.end)

    def call(
        self, method: str, session: str | None, errors: list[str], parameters: dict[str, Any]
    ) -> dict[str, Any]:
        """The result of a method; errors in the session meanwhile are added to `errors`."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        os.write(self.write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            wrong = answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded")
            if wrong and answer.get("sessionId") == session and STALL not in str(answer):
                errors.append(json.dumps(answer["params"]))
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            ready, _, _ = select.select([self.read], [], [], 2 * PATIENCE)
            assert ready, "the browser does not answer"
            part = os.read(self.read, 1 << 16)
            assert part, "the browser is gone"
            self.buffer += part
        line, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(line)

    def end(self) -> None:
        os.close(self.write), os.close(self.read)  # at which it ends
        try:
            self.process.wait(60)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(60)
        self.litter.cleanup()


@functools.cache
def chromium() -> Chromium:
    """The browser of this process, started once."""
    return Chromium()


class Browser:
    """One page in its own profile."""

    def __init__(self, width: int = 1100, height: int = 720, dark: bool = False):
        self.chromium, self.session, self.errors = chromium(), None, []
        self.process = self.chromium.process
        self.profile = self.call("Target.createBrowserContext")["browserContextId"]
        target = self.call("Target.createTarget", url="about:blank", browserContextId=self.profile)
        attached = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.size(width, height)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.before(SLOW_DRAWING)

    def size(self, width: int, height: int) -> None:
        settings = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **settings)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a DevTools method."""
        return self.chromium.call(method, self.session, self.errors, parameters)

    def value(self, expression: str, **options: Any) -> Any:
        given = {"expression": expression, "returnByValue": True, "userGesture": True, **options}
        result = self.call("Runtime.evaluate", **given)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def resolved(self, expression: str) -> Any:
        late = f"setTimeout(() => fail(new Error('not within {PATIENCE:.0f} s')), {1000 * PATIENCE:.0f})"
        return self.value(
            f"Promise.race([{expression}, new Promise((_, fail) => {late})])", awaitPromise=True
        )

    def before(self, script: str) -> None:
        """Run a script on every page before its own."""
        self.call("Page.addScriptToEvaluateOnNewDocument", source=script)

    def wait(self, expression: str) -> Any:
        """The first value of an expression that is true."""
        return until(lambda: self.value(expression), f"{expression}; {self.errors}", self.process)

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.wait(f"location.href.startsWith({url!r}) && document.readyState == 'complete'")

    def click(self, selector: str) -> None:
        """Press the mouse in the middle of an element, and again if the page has moved it meanwhile."""
        until(lambda: self._pressed(selector), f"a click on {selector}; {self.errors}", self.process)

    def _pressed(self, selector: str) -> bool:
        """Whether a press of the mouse reached its element."""
        meant = f"event => {{ window.pressed = Boolean(event.target.closest({selector!r})); }}"
        # There is no click if the page replaced the element between press and release.
        missed = "() => setTimeout(() => { window.pressed ??= false; })"
        heard = {"click": meant, "mouseup": missed}
        listen = [
            f"addEventListener('{kind}', {do}, {{ once: true, capture: true }})" for kind, do in heard.items()
        ]
        self.value(f"window.pressed = null; {'; '.join(listen)}")
        box = f"document.querySelector({selector!r}).getBoundingClientRect()"
        x, y = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)  # which chooses a chart's point
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        self.wait("window.pressed !== null")
        return self.value("window.pressed !== false")  # another page knows nothing of it

    def picture(self) -> np.ndarray:
        """The page (H, W, 3), uint8."""
        data = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.session = None
        self.call("Target.disposeBrowserContext", browserContextId=self.profile)
