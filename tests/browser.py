"""A headless Chromium driven over a pipe, for pages that take their time."""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import subprocess
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

CHROMIUM = shutil.which("chromium")
_TRIES = 50


class Browser:
    """One tab; the protocol is Chromium's DevTools', messages end with a zero byte."""

    def __init__(self, home: Path) -> None:
        inward, self._write = os.pipe()
        self._read, outward = os.pipe()
        options = "--headless --no-sandbox --enable-unsafe-swiftshader --use-angle=swiftshader --remote-debugging-pipe"
        command = (
            f'exec "{CHROMIUM}" {options} --window-size=1280,800 --user-data-dir="{home}" 3<&{inward} 4>&{outward}'
        )
        self._process = subprocess.Popen(["bash", "-c", command], pass_fds=(inward, outward), stderr=subprocess.DEVNULL)
        os.close(inward)
        os.close(outward)
        self._numbers, self._rest = itertools.count(1), b""
        self._session: str | None = None
        target = self._send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def open(self, url: str) -> None:
        self._send("Page.navigate", url=url)

    def screenshot(self) -> bytes:
        return base64.b64decode(self._send("Page.captureScreenshot")["data"])

    def emulate(self, width: int, *, dark: bool) -> None:
        """A screen of so many CSS pixels, of a user who likes it dark or light."""
        self._send("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=True)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._send("Emulation.setEmulatedMedia", media="screen", features=[scheme])

    def content_width(self) -> int:
        """How wide the page is, which may be wider than the screen."""
        return int(self._send("Page.getLayoutMetrics")["cssContentSize"]["width"])

    def style(self, selector: str, name: str) -> str:
        """A property of the first element of a CSS selector, as it is shown."""
        expression = f"getComputedStyle(document.querySelector('{selector}')).{name}"
        return str(self._send("Runtime.evaluate", expression=expression)["result"]["value"])

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(20)
        os.close(self._read)
        os.close(self._write)

    def _send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command; while a page is on its way to another one it is refused, and sent again."""
        for _ in range(_TRIES):
            answer = self._answer(method, **parameters)
            if "result" in answer:
                result: dict[str, Any] = answer["result"]
                return result
            time.sleep(0.2)
        raise RuntimeError(f"{method}: {answer}")

    def _answer(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        os.write(
            self._write, json.dumps(message | ({"sessionId": self._session} if self._session else {})).encode() + b"\0"
        )
        while True:
            while b"\0" not in self._rest:
                self._rest += os.read(self._read, 1 << 20)
            text, self._rest = self._rest.split(b"\0", 1)
            answer: dict[str, Any] = json.loads(text)
            if answer.get("id") == number:
                return answer
