"""A headless Chromium over a pair of pipes (Chrome DevTools Protocol, `--remote-debugging-pipe`): no port, no package.

Messages are JSON objects that end in a zero byte; the browser reads descriptor 3 and writes descriptor 4. Beside it,
scripts that look over a whole page for what a reader would stumble on; each comes to a list of what it found.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
LIMIT_S = 60.0  # Time limit of an answer on a busy machine

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed (Debian: chromium)")

# Texts with a contrast below 4.5 : 1 (WCAG 2.2, success criterion 1.4.3, level AA).
POOR_CONTRAST = """
(() => {
  const linear = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);
  const luminance = (colour) => {
    const [r, g, b] = colour.match(/[0-9.]+/g).map((text) => linear(Number(text) / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (one) => {
    for (let at = one; at; at = at.parentElement) {
      const colour = getComputedStyle(at).backgroundColor;
      if (!colour.startsWith("rgba(0, 0, 0, 0")) return colour;
    }
    return "rgb(255, 255, 255)";
  };
  const poor = [];
  for (const one of document.querySelectorAll("body *")) {
    const says = [...one.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!says || one.closest(".unseen, .skip, script, style, noscript, title, [hidden], :disabled")) continue;
    const style = getComputedStyle(one);
    const [a, b] = [luminance(one.closest("svg") ? style.fill : style.color), luminance(behind(one))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < 4.5) poor.push([one.tagName, one.id, one.textContent.slice(0, 30), ratio.toFixed(2)]);
  }
  return poor;
})()
"""


# Elements beyond the right edge of the window.
TOO_WIDE = """
[...document.querySelectorAll("body *")]
  .filter((one) => one.getBoundingClientRect().right > document.documentElement.clientWidth + 1)
  .filter((one) => !one.closest(".unseen, .skip, script, svg"))
  .map((one) => [one.tagName, one.id, one.className, one.getBoundingClientRect().right])
"""


# Controls and pictures without an accessible name (WCAG 2.2, 1.1.1 and 4.1.2).
NAMELESS = """
[...document.querySelectorAll("button, img, svg:not([aria-hidden]), [role=img], [role=group], section")]
  .filter((one) => !one.closest("[hidden]"))
  .filter((one) => !["aria-label", "alt", "aria-labelledby"].some((name) => one.getAttribute(name)))
  .filter((one) => !one.textContent.trim())
  .map((one) => one.outerHTML)
"""


# Requested addresses on other servers.
OUTSIDE = """
performance.getEntriesByType("resource").map((one) => one.name)
  .filter((name) => !name.startsWith("data:") && !name.startsWith(location.origin + "/"))
"""


class Tab:
    """One tab of a running browser; uncaught and logged errors of its page are in `errors`."""

    def __init__(self, write_to: int, read_from: int) -> None:
        self._write_to, self._read_from = write_to, read_from
        self._buffer = b""
        self._number = 0
        self._session: str | None = None
        self.errors: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write_to, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self._take(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def open(self, url: str, *, width: int = 1280, height: int = 900, dark: bool = False) -> None:
        """Open an address in a window of this size."""
        self.resize(width, height, dark=dark)
        self.call("Page.navigate", url=url)

    def resize(self, width: int, height: int, *, dark: bool = False) -> None:
        """Show the page in a window of this size, dark or light."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=scheme)

    def value(self, expression: str) -> Any:
        """Return the value of a script's expression."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait_for(self, expression: str, *, limit_s: float = LIMIT_S) -> Any:
        """Return the value of an expression as soon as it is true."""
        end = time.monotonic() + limit_s
        while not (value := self.value(expression)):
            if time.monotonic() > end:
                pytest.fail(f"{expression} did not come true within {limit_s:g} s; the page says: {self.text()[:600]}")
            time.sleep(0.05)
        return value

    def text(self) -> str:
        """Return the visible text of the page."""
        return str(self.value("document.body ? document.body.innerText : ''"))

    def drag(self, path: list[tuple[float, float]]) -> None:
        """Press the mouse at the first position (px of the window), move along the path, and release it at the last."""
        kinds = [(path[0], "mousePressed"), *((place, "mouseMoved") for place in path[1:]), (path[-1], "mouseReleased")]
        for (x, y), kind in kinds:
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def press(self, key: str) -> None:
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def screenshot(self, path: Path, *, whole: bool = True) -> Path:
        """Save a picture of the page as PNG."""
        data = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)["data"]
        path.write_bytes(base64.b64decode(data))
        return path

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            piece = os.read(self._read_from, 1 << 16)
            if not piece:
                raise RuntimeError("the browser has ended")
            self._buffer += piece
        message, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(message)

    def _take(self, event: dict[str, Any]) -> None:
        parameters = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(parameters["exceptionDetails"]))
        elif event.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(json.dumps(parameters["entry"]))
        elif event.get("method") == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "assert"):
            self.errors.append(json.dumps(parameters["args"]))


@contextmanager
def browser_tab() -> Generator[Tab]:
    """Run a browser with its own profile, and yield one of its tabs."""
    assert CHROMIUM is not None
    to_browser, ours_out = os.pipe()
    ours_in, from_browser = os.pipe()

    def place_pipes() -> None:
        # Moved away first: one of them may be 3 or 4 itself.
        read_end, write_end = os.dup(to_browser), os.dup(from_browser)
        os.dup2(read_end, 3)
        os.dup2(write_end, 4)

    # Its other processes may write to the profile when it has ended.
    scratch = tempfile.TemporaryDirectory(prefix="crop-", ignore_cleanup_errors=True)
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-pipe", "--mute-audio"]
    process = subprocess.Popen(
        [CHROMIUM, *flags, f"--user-data-dir={scratch.name}", "about:blank"],
        preexec_fn=place_pipes,
        close_fds=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(to_browser)
    os.close(from_browser)
    try:
        yield Tab(ours_out, ours_in)
    finally:
        process.terminate()
        process.wait(30)
        os.close(ours_out)
        os.close(ours_in)
        scratch.cleanup()
