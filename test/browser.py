"""A real browser without a window, driven by the DevTools protocol over a pipe; needs nothing but the browser."""

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
PATIENCE = 30.0  # s
FROM_BROWSER, TO_BROWSER = 4, 3  # file descriptors of the browser, as --remote-debugging-pipe has them


def screenshot_folder(otherwise):
    """Where pictures of the page are kept: HMT_SLAM_SCREENSHOTS, or another folder."""
    folder = Path(os.environ.get("HMT_SLAM_SCREENSHOTS", otherwise))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def find_browser():
    """The path of a browser that there is here, None where there is none."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


def _pipe():
    """Reader and writer, whose numbers are none of those that the browser wants."""
    ends = os.pipe()
    moved = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends]
    for end in ends:
        os.close(end)
    return moved


class Browser:
    """One browser with one page. Messages on the pipe are JSON, each ended by a zero byte."""

    def __init__(self, profile):
        """:param profile: an empty folder."""
        theirs_in, self._out = _pipe()
        self._in, theirs_out = _pipe()

        def take_pipes():
            os.dup2(theirs_in, TO_BROWSER)
            os.dup2(theirs_out, FROM_BROWSER)

        self._process = subprocess.Popen(
            [find_browser(), *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=take_pipes,  # noqa: PLW1509  no other way gives a child these two numbers
            pass_fds=(TO_BROWSER, FROM_BROWSER),
            start_new_session=True,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._number, self._rest, self.complaints = 0, b"", []
        self._session = None
        targets = self.send("Target.getTargets")["targetInfos"]
        target = next(one["targetId"] for one in targets if one["type"] == "page")
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method, **parameters):
        """What the browser answers to a command."""
        self._number += 1
        command = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            command["sessionId"] = self._session
        os.write(self._out, json.dumps(command).encode() + b"\0")
        deadline = time.monotonic() + PATIENCE
        while True:
            message = self._next(deadline)
            if message.get("id") == self._number:
                assert "error" not in message, message["error"]
                return message["result"]

    def _next(self, deadline):
        while b"\0" not in self._rest:
            ready = select.select([self._in], [], [], max(0.0, deadline - time.monotonic()))[0]
            assert ready, "the browser does not answer"
            more = os.read(self._in, 1 << 16)
            assert more, "the browser has ended"
            self._rest += more
        text, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(text)
        self._note(message.get("method"), message.get("params", {}))
        return message

    def _note(self, method, parameters):
        """What a developer would see in red."""
        if method == "Runtime.exceptionThrown":
            self.complaints.append(parameters["exceptionDetails"])
        elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert"):
            self.complaints.append(parameters["args"])
        elif method == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
            self.complaints.append(parameters["entry"])

    def size(self, width, height, mobile=False, ratio=1.0):
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=ratio, mobile=mobile
        )
        self.send("Emulation.setTouchEmulationEnabled", enabled=mobile)

    def dark(self, dark):
        feature = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[feature])

    def open(self, url):
        """Load a page that there is, and wait until all of it is there."""
        fault = self.send("Page.navigate", url=url).get("errorText")
        assert fault is None, fault
        while self.evaluate("document.readyState") != "complete":
            time.sleep(0.05)

    def evaluate(self, expression):
        """The value of an expression of JavaScript in the page."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def screenshot(self, path, whole=False):
        picture = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(picture["data"]))

    def close(self):
        try:
            self._session = None
            self.send("Browser.close")
            self._process.wait(10)
        finally:
            self._process.kill()
            self._process.wait()
            os.close(self._in)
            os.close(self._out)


class Page:
    """The live page in a browser, and what it shows."""

    def __init__(self, browser, listener, nodes):
        self.browser, self._listener, self._nodes = browser, listener, nodes

    def until(self, condition):
        """Wait for it; the page is polled a few times a second."""
        requested = 0.0

        def due():
            nonlocal requested
            if time.monotonic() - requested < 0.3:
                return False
            requested = time.monotonic()
            return condition()

        self._listener.until(due, seconds=120.0, alive=self._nodes)

    @property
    def drawing(self):
        return json.loads(self.browser.evaluate("document.getElementById('plan').dataset.drawn ?? '{}'"))

    def text(self, name):
        return self.browser.evaluate(f"document.getElementById('{name}').innerText")

    def click(self, x, y):
        """A click at pixels of the window."""
        for kind in ("mousePressed", "mouseReleased"):
            self.browser.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def pinch(self, x, y, before, after):
        """Two fingers beside a pixel of the window, whose distance changes."""
        for kind, distance in (("touchStart", before), ("touchMove", 0.5 * (before + after)), ("touchMove", after)):
            points = [{"x": x + side * 0.5 * distance, "y": y, "id": k} for k, side in enumerate((-1, 1))]
            self.browser.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        self.browser.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def colors(self, canvas):
        """How many different ones there are on a canvas."""
        return self.browser.evaluate(
            f"""(() => {{
                const drawn = document.getElementById('{canvas}');
                const copy = new OffscreenCanvas(drawn.width, drawn.height).getContext('2d');
                copy.drawImage(drawn, 0, 0);
                const pixels = copy.getImageData(0, 0, drawn.width, drawn.height).data;
                return new Set(new Uint32Array(pixels.buffer)).size;
            }})()"""
        )

    @property
    def sideways(self):
        """By how many pixels the page is wider than the screen."""
        return self.browser.evaluate("document.documentElement.scrollWidth - window.innerWidth")
