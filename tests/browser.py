"""A headless Chromium, controlled through a pipe with its DevTools protocol, without a further package."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
TIMEOUT = 60.0  # s for one answer
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run", "--disable-dev-shm-usage",
    "--disable-extensions", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--remote-debugging-pipe",
)  # fmt: skip


class Browser:
    """One page in a headless Chromium.

    Args:
        width: of the window, CSS pixels.
        height: of the window, CSS pixels.
        dark: whether the user prefers dark pages.
        phone: whether it has a touch screen and two pixels per CSS pixel.
    """

    def __init__(self, width: int = 1280, height: int = 900, *, dark: bool = False, phone: bool = False) -> None:
        assert CHROMIUM is not None
        self.events: list[dict[str, Any]] = []
        self._number, self._rest, self._session = 0, b"", None
        with contextlib.ExitStack() as stack:
            home = stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
            ours, theirs = (os.pipe() for _ in range(2))
            read, write = (fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (ours[0], theirs[1]))

            def take() -> None:  # the browser reads from 3 and writes to 4
                os.dup2(read, 3)
                os.dup2(write, 4)

            command = [CHROMIUM, *FLAGS, f"--user-data-dir={home}", "about:blank"]
            quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            self._process = subprocess.Popen(command, preexec_fn=take, pass_fds=(3, 4), **quiet)
            stack.callback(self._process.wait)
            stack.callback(self._process.kill)
            for end in (ours[0], theirs[1], read, write):
                os.close(end)
            self._out, self._in = ours[1], theirs[0]
            stack.callback(os.close, self._out)
            stack.callback(os.close, self._in)
            target = self.call("Target.createTarget", url="about:blank")["targetId"]
            self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Network", "Log"):
                self.call(f"{domain}.enable")
            self.call(
                "Emulation.setDeviceMetricsOverride",
                width=width, height=height, deviceScaleFactor=2 if phone else 1, mobile=phone,
            )  # fmt: skip
            self.call("Emulation.setTouchEmulationEnabled", enabled=phone)
            scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
            self.call("Emulation.setEmulatedMedia", features=[scheme])
            self._stack = stack.pop_all()

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result; events received meanwhile are stored."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + TIMEOUT
        while True:
            answer = self._next(end)
            if answer.get("id") == self._number:
                assert "error" not in answer, (method, answer["error"])
                return dict(answer["result"])
            self.events.append(answer)

    def _next(self, end: float) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(0.0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            part = os.read(self._in, 1 << 20)
            assert part, "the browser has ended"
            self._rest += part
        line, self._rest = self._rest.split(b"\0", 1)
        return dict(json.loads(line))

    def open(self, url: str) -> None:
        """Navigate to a page."""
        self.call("Page.navigate", url=url)
        self.wait("document.readyState === 'complete'")

    def run(self, expression: str) -> Any:
        """Evaluate an expression on the page; promises are awaited."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait(self, expression: str) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + TIMEOUT
        while not self.run(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.05)

    def key(self, key: str, **more: Any) -> None:
        """Press and release a key, as in ``"k"``, ``"ArrowLeft"``."""
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text, **more)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key, **more)

    def place(self, selector: str, across: float = 0.5, down: float = 0.5) -> tuple[float, float]:
        """Position of an element in the window, after scrolling to it."""
        x, y = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            "e.scrollIntoView({block: 'center'});"
            f"const b = e.getBoundingClientRect(); return [b.x + {across} * b.width, b.y + {down} * b.height]; }})()"
        )
        return x, y

    def click(self, selector: str, across: float = 0.5, down: float = 0.5) -> None:
        """Click on an element with the mouse."""
        x, y = self.place(selector, across, down)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def drag(self, selector: str, by: tuple[float, float]) -> None:
        """Drag with the mouse, from the middle of an element."""
        x, y = self.place(selector)
        mouse = "Input.dispatchMouseEvent"
        self.call(mouse, type="mousePressed", x=x, y=y, button="left", buttons=1, clickCount=1)
        for share in (0.5, 1.0):
            self.call(mouse, type="mouseMoved", x=x + share * by[0], y=y + share * by[1], button="left", buttons=1)
        self.call(mouse, type="mouseReleased", x=x + by[0], y=y + by[1], button="left", clickCount=1)

    def touch(self, *paths: tuple[tuple[float, float], tuple[float, float]]) -> None:
        """Touch the start of each path with a finger, move to the ends, and lift the fingers."""
        for kind, share in (("touchStart", 0.0), ("touchMove", 0.5), ("touchMove", 1.0)):
            points = [
                {"x": start[0] + share * (end[0] - start[0]), "y": start[1] + share * (end[1] - start[1]), "id": finger}
                for finger, (start, end) in enumerate(paths)
            ]
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def tap(self, selector: str) -> None:
        """Touch an element."""
        point = self.place(selector)
        self.touch((point, point))

    def screenshot(self, path: str | os.PathLike[str]) -> None:
        """Write a PNG of the window."""
        Path(path).write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
