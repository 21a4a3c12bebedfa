"""A headless Chromium, driven through its DevTools protocol by the package websockets, which viser brings along."""

import base64
import itertools
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from urllib.request import urlopen

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--window-size=1280,720", "--remote-debugging-port=0",
)  # fmt: skip
#: s: only a hang takes so long, however slow a picture without a graphics card is.
PATIENCE = 300.0


def chromium():
    """Return the program; None = it is not installed."""
    return next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)


class Browser:
    """A page in a headless browser; use as a context manager."""

    def __init__(self, url):
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        command = [chromium(), *FLAGS, f"--user-data-dir={self._folder.name}", "about:blank"]
        self._url = url
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._ids = itertools.count(1)

    def __enter__(self):
        from websockets.sync.client import connect

        try:
            self._socket = connect(self._page(), max_size=None)
            self.send("Page.navigate", url=self._url)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        self._process.terminate()
        self._process.wait()
        self._folder.cleanup()

    def _page(self):
        place = Path(self._folder.name) / "DevToolsActivePort"
        until(lambda: place.is_file() and place.read_text().strip())
        port = place.read_text().split()[0]

        def found():
            pages = json.loads(urlopen(f"http://127.0.0.1:{port}/json/list").read())
            return next((page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page"), None)

        return until(found)

    def send(self, method, **parameters):
        """Return the answer to a command of the protocol."""
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def run(self, script):
        """Return the value of an expression of JavaScript; promises are waited for."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self):
        """Return the text on the page."""
        return self.run("document.body ? document.body.innerText : ''") or ""

    def wait(self, text):
        """Wait until a text is on the page."""
        return until(lambda: text in self.text(), text)

    def click(self, text):
        """Click on the button with a text."""
        script = f"""(() => {{
            const buttons = [...document.querySelectorAll('button, [role=button]')];
            const found = buttons.find(b => b.innerText.includes({json.dumps(text)}));
            if (!found) return null;
            found.scrollIntoView();
            const box = found.getBoundingClientRect();
            return [box.x + box.width / 2, box.y + box.height / 2];
        }})()"""
        x, y = until(lambda: self.run(script), text)
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key, code, number):
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=number)

    def picture(self, path):
        """Write a picture of the page."""
        Path(path).write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))


def until(found, what=""):
    """Return the first true answer of a function; fail after :data:`PATIENCE`."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        try:
            if answer := found():
                return answer
        except OSError:
            pass
        time.sleep(0.1)
    raise AssertionError(f"not on the page after {PATIENCE:g} s: {what}")
