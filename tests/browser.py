# SPDX-License-Identifier: MIT
"""A headless Chromium that is told what to do over its own protocol; nothing but pages of ours."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import time
from contextlib import contextmanager
from urllib.request import urlopen

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
OPTIONS = (
    "--headless --no-sandbox --disable-dev-shm-usage --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader --hide-scrollbars --no-first-run --disable-background-networking "
    "--remote-debugging-port=0 --disable-component-update --disable-sync"
).split()


class Page:
    """One tab.

    Args:
        socket: Connection to the tab.
    """

    def __init__(self, socket):
        self.socket, self.number = socket, 0
        self.requests, self.faults = [], []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method, **given):
        """Call a method of the protocol and return its result."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": given}))
        while True:
            message = json.loads(self.socket.recv(timeout=60))
            if message.get("id") == self.number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message):
        method, given = message.get("method"), message.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requests.append(given["url"])
        elif method == "Runtime.exceptionThrown":
            details = given["exceptionDetails"]
            found = details.get("exception", {}).get("description", "")
            self.faults.append(f"{details.get('text')} {found}".strip())
        elif method == "Runtime.consoleAPICalled" and given["type"] == "error":
            self.faults.append(" ".join(str(a.get("value", a)) for a in given["args"]))
        elif method == "Log.entryAdded" and given["entry"]["level"] == "error":
            self.faults.append(f"{given['entry']['text']} {given['entry'].get('url', '')}")

    def size(self, width, height):
        """Take a window of so many pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip

    def open(self, url):
        """Open a page."""
        self.call("Page.navigate", url=url)

    def value(self, expression):
        """Return the value of an expression in the page."""
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        return found["result"].get("value")

    def until(self, expression, seconds=30):
        """Wait until an expression in the page is true, and return it."""
        end = time.monotonic() + seconds
        while not (found := self.value(expression)):
            assert time.monotonic() < end, f"{expression} did not come true: {self.faults}"
            time.sleep(0.1)
        return found

    def picture(self):
        """Return a PNG file of the window."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def mouse(self, kind, x, y, **more):
        """Move or press the mouse."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x, y):
        """Click at a place."""
        self.mouse("mouseMoved", x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)

    def drag(self, start, end, steps=8):
        """Drag from one place to another."""
        self.mouse("mouseMoved", *start)
        time.sleep(0.2)
        self.mouse("mousePressed", *start, button="left", clickCount=1)
        for step in range(1, steps + 1):
            place = [a + (b - a) * step / steps for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", *place, button="left", buttons=1)
            time.sleep(0.05)
        self.mouse("mouseReleased", *end, button="left", clickCount=1)

    def outside(self):
        """Return what was asked for beyond this machine."""
        here = re.compile(r"(http|ws)://127\.0\.0\.1[:/]|data:|blob:|file:|about:|chrome")
        return [url for url in self.requests if not here.match(url)]


@contextmanager
def browser(folder):
    """Start Chromium with a profile in a folder, and give one page."""
    from websockets.sync.client import connect

    process = subprocess.Popen(
        [CHROMIUM, *OPTIONS, f"--user-data-dir={folder}", "about:blank"],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        port = None
        for line in process.stderr:
            if found := re.search(r"DevTools listening on ws://127\.0\.0\.1:(\d+)/", line):
                port = int(found.group(1))
                break
        with urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            tab = next(one for one in json.load(answer) if one["type"] == "page")
        with connect(tab["webSocketDebuggerUrl"], max_size=2**28, ping_interval=None) as socket:
            yield Page(socket)
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
