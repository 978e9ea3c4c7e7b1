"""A headless Chromium for the tests of the page, by the DevTools protocol over a socket."""

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from websockets.sync.client import connect

#: Where it is, or None.
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
FLAGS = [
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--remote-debugging-port=0",
    "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--disable-dev-shm-usage",
]  # fmt: skip


class Browser:
    """One window; `requests`: the addresses that it asked for, `errors`: its complaints."""

    def __init__(self, width=1280, height=760, downloads=None):
        """Start it; the window is empty. `downloads`: a folder for what pages save."""
        self._open = contextlib.ExitStack()
        try:
            self._start(width, height)
            if downloads is not None:
                self._ask("Browser.setDownloadBehavior", behavior="allow",
                          downloadPath=str(downloads))  # fmt: skip
        except BaseException:
            self.close()
            raise

    def _start(self, width, height):
        folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._folder = Path(self._open.enter_context(folder))
        command = [CHROMIUM, *FLAGS, f"--user-data-dir={self._folder}",
                   f"--window-size={width},{height}", "about:blank"]  # fmt: skip
        self._process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self._open.callback(self._end)
        self._numbers = itertools.count(1)
        self.requests, self.errors = [], []
        port = self._port()
        link = connect(port, max_size=None, compression=None, proxy=None, ping_interval=None)
        self._socket = self._open.enter_context(link)
        targets = self._ask("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        made = self._ask("Target.attachToTarget", targetId=page, flatten=True)
        self._session = made["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.ask(f"{domain}.enable")
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height,
                 deviceScaleFactor=1, mobile=False)  # fmt: skip

    def _port(self):
        told = self._folder / "DevToolsActivePort"
        end = time.monotonic() + 60
        while time.monotonic() < end:
            if told.exists() and len(lines := told.read_text().split()) == 2:
                return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
            time.sleep(0.05)
        raise TimeoutError("Chromium did not start")

    def _ask(self, method, session=None, /, **parameters):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        self._socket.send(json.dumps(message | ({"sessionId": session} if session else {})))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self._note(answer)

    def _note(self, event):
        method, what = event.get("method"), event.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(what["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requests.append(what["url"])
        elif method == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(what["exceptionDetails"])[:600])
        elif method == "Log.entryAdded" and what["entry"]["level"] == "error":
            self.errors.append(what["entry"]["text"])

    def ask(self, method, **parameters):
        return self._ask(method, self._session, **parameters)

    def go(self, address):
        self.ask("Page.navigate", url=address)

    def run(self, code):
        """Value of an expression, a promise awaited."""
        found = self.ask("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, code, seconds=60):
        """Wait until an expression is true; its value."""
        end = time.monotonic() + seconds
        while not (value := self.run(code)):
            assert time.monotonic() < end, f"not true in {seconds} s: {code}"
            time.sleep(0.05)
        return value

    def mouse(self, kind, x, y, buttons=1):
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons,
                 clickCount=1)  # fmt: skip

    def drag(self, start, end, steps=8):
        self.mouse("mousePressed", *start)
        for i in range(1, steps + 1):
            self.mouse("mouseMoved", *(a + (b - a) * i / steps for a, b in zip(start, end)))  # noqa: B905
        self.mouse("mouseReleased", *end, buttons=0)

    def key(self, code, shift=False):
        for kind in ("rawKeyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, code=code, key=code,
                     modifiers=8 if shift else 0)  # fmt: skip

    def picture(self, path):
        data = self.ask("Page.captureScreenshot", format="png")["data"]
        Path(path).write_bytes(base64.b64decode(data))

    def _end(self):
        self._process.terminate()
        self._process.wait(timeout=30)

    def close(self):
        """End it."""
        self._open.close()
