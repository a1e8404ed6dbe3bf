"""Headless Chromium, for tests of pages as people see them."""

import itertools
import json
import os
import shutil
import subprocess

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
WAIT = """new Promise((go) => {
    const wait = () => READY ? go() : setTimeout(wait, 50);
    wait();
})"""
MIDDLE = """(() => {
    const node = document.querySelector('CSS');
    node.scrollIntoView({ block: "center", inline: "center" });
    const box = node.getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
})()"""


class Browser:
    """Chromium with one page, spoken to over a pipe (Chrome DevTools Protocol)."""

    def __init__(self, url, width, ready):
        """Open a page, and wait until the condition `ready` holds there."""
        read_theirs, self._write = os.pipe()
        self._read, write_theirs = os.pipe()
        flags = "--headless --no-sandbox --disable-gpu --remote-debugging-pipe"
        flags += " --disable-ipc-flooding-protection"  # which drops addresses of quick clicks
        redirected = f"exec {CHROMIUM} {flags} 3<&{read_theirs} 4>&{write_theirs}"
        self._process = subprocess.Popen(
            ["bash", "-c", redirected], pass_fds=(read_theirs, write_theirs), stderr=subprocess.DEVNULL
        )
        os.close(read_theirs), os.close(write_theirs)
        self._numbers, self._rest, self._session = itertools.count(1), b"", {}
        target = self("Target.createTarget", url="about:blank")["targetId"]
        session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._session = {"sessionId": session}
        metrics = dict(width=width, height=900, deviceScaleFactor=1, mobile=width < 500)
        self("Emulation.setDeviceMetricsOverride", **metrics)
        self("Page.navigate", url=url)
        self.run(WAIT.replace("READY", ready))

    def __call__(self, method, **params):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": params, **self._session}
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._rest:
                self._rest += os.read(self._read, 1 << 20)
            answer, self._rest = self._rest.split(b"\0", 1)
            if (answer := json.loads(answer)).get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def run(self, script):
        """The value of a script."""
        result = self("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def click(self, css):
        """Click in the middle of an element."""
        x, y = self.run(MIDDLE.replace("CSS", css))
        for kind in ("mousePressed", "mouseReleased"):
            self("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key):
        for kind in ("keyDown", "keyUp"):
            self("Input.dispatchKeyEvent", type=kind, key=key)

    def close(self):
        self("Browser.close")
        self._process.wait(10)
        os.close(self._read), os.close(self._write)
