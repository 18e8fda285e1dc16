"""A real headless Chromium for tests, driven by its DevTools protocol over a pipe: clicks, keys,
pictures, the accessibility tree, and the memory of a page.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)


class Browser:
    """One page of a browser. All calls wait for the answer."""

    def __init__(self, process: subprocess.Popen[bytes], read: int, write: int) -> None:
        self._process, self._read, self._write = process, read, write
        self._number, self._buffer, self._session = 0, b"", ""
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Send one command and return its result. Raises RuntimeError for a refusal."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next(60.0)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self.events.append(answer)

    def _next(self, timeout_s: float) -> dict[str, Any]:
        end = time.monotonic() + timeout_s
        while b"\0" not in self._buffer:
            left = end - time.monotonic()
            if left <= 0 or not select.select([self._read], [], [], left)[0]:
                raise TimeoutError("the browser does not answer")
            data = os.read(self._read, 1 << 20)
            if not data:
                raise RuntimeError("the browser ended")
            self._buffer += data
        line, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(line)

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression; a promise is waited for."""
        answer = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"])[:800])
        return answer["result"].get("value")

    def open(self, address: str) -> None:
        """Go to an address and wait until the document is there."""
        self.call("Page.navigate", url=address)
        self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def until(self, script: str, timeout_s: float = 90.0) -> None:
        """Wait until an expression is true. Raises TimeoutError."""
        end = time.monotonic() + timeout_s
        while not self.run(script):
            if time.monotonic() > end:
                raise TimeoutError(f"never true: {script}; page: {self.text()[:1500]}")
            time.sleep(0.05)

    def text(self) -> str:
        """Return the visible text of the page."""
        return str(self.run("document.body.innerText"))

    def size(self, width: int, height: int, *, dark: bool = False, phone: bool = False) -> None:
        """Set the size of the window, and light or dark mode."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def picture(self, path: Path, *, whole: bool = False) -> None:
        """Write a PNG of the window, or of the whole page."""
        data = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(data["data"]))

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send one mouse event: mousePressed, mouseMoved, mouseReleased or mouseWheel."""
        down = kind in ("mousePressed", "mouseReleased")
        button = {"button": "left", "clickCount": 1} if down else {}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **(button | more))

    def click(self, x: float, y: float) -> None:
        """Click at a point of the window."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.mouse(kind, x, y)

    def click_on(self, selector: str) -> None:
        """Scroll an element into view and click its centre."""
        x, y = self.run(
            f"(() => {{const e = document.querySelector({selector!r});"
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
            "return [b.x + b.width / 2, b.y + b.height / 2];})()"
        )
        self.click(x, y)

    def key(self, key: str, code: int = 0, text: str = "", modifiers: int = 0) -> None:
        """Press and release a key. modifiers: 1 Alt, 2 Ctrl, 8 Shift."""
        about = {"key": key, "windowsVirtualKeyCode": code, "modifiers": modifiers}
        self.call(
            "Input.dispatchKeyEvent", type="keyDown", **about, **({"text": text} if text else {})
        )
        self.call("Input.dispatchKeyEvent", type="keyUp", **about)

    def named_parts(self) -> list[tuple[str, str]]:
        """Return role and name of everything in the accessibility tree."""
        nodes = self.call("Accessibility.getFullAXTree")["nodes"]
        return [
            (str(n.get("role", {}).get("value")), str(n.get("name", {}).get("value", "")))
            for n in nodes
            if not n.get("ignored")
        ]

    def memory(self) -> tuple[int, int]:
        """Return bytes of the JavaScript heap after a collection, and the number of nodes."""
        self.call("HeapProfiler.collectGarbage")
        heap = self.call("Runtime.getHeapUsage")["usedSize"]
        return int(heap), int(self.call("Memory.getDOMCounters")["nodes"])

    def complaints(self) -> list[str]:
        """Return errors of the console and refused resources since the start."""
        found = []
        self.run("1")
        for event in self.events:
            params = event.get("params", {})
            if event.get("method") == "Runtime.exceptionThrown":
                found.append(str(params["exceptionDetails"].get("text")))
            elif event.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
                found.append(str(params["entry"]["text"]))
        return found

    def asked_hosts(self) -> set[str]:
        """Return the addresses' beginnings of all requests that the page made."""
        addresses = (
            event["params"]["request"]["url"]
            for event in self.events
            if event.get("method") == "Network.requestWillBeSent"
        )
        return {"/".join(address.split("/")[:3]) for address in addresses}


@contextmanager
def chromium(profile: Path) -> Iterator[Browser]:
    """A browser with an empty profile."""
    to_read, to_write = os.pipe(), os.pipe()  # the browser reads 3 and writes 4

    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
    command += ["--remote-debugging-pipe", f"--user-data-dir={profile}", "--hide-scrollbars"]
    renumbered = (
        "import os, sys; r, w = os.dup(int(sys.argv[1])), os.dup(int(sys.argv[2]));"
        "r, w = os.dup2(r, 103), os.dup2(w, 104); os.dup2(r, 3); os.dup2(w, 4);"
        "os.execv(sys.argv[3], sys.argv[3:])"
    )
    ends = [str(to_read[0]), str(to_write[1])]
    process = subprocess.Popen(
        [sys.executable, "-S", "-c", renumbered, *ends, *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=(to_read[0], to_write[1]),
    )
    os.close(to_read[0])
    os.close(to_write[1])
    try:
        yield Browser(process, to_write[0], to_read[1])
    finally:
        process.terminate()
        process.wait(20)
        os.close(to_read[1])
        os.close(to_write[0])
