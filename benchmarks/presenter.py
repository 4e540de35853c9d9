"""Time to show and verify a colour: `FullScreen.show` of all 707 illuminants, compared with empty swaps of this size.

`python -m benchmarks.presenter` prints one JSON object per result and line. It uses the display in DISPLAY. If DISPLAY
is not set, it starts Xvfb, where swaps do not wait for a refresh and OpenGL runs in software. If the slowest call took
much longer than its processor time, it waited for other programs.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Generator
from typing import Any

from drivers.display.fullscreen import FullScreen, list_displays
from experiment.lights import plan_illuminants

SIZE = "1920x1080"


@contextlib.contextmanager
def _desktop() -> Generator[str]:
    """Yield a description of the desktop, starting a virtual one if needed; empty if there is none."""
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        yield "the existing display"
        return
    if shutil.which("Xvfb") is None:
        yield ""
        return
    arguments = ["Xvfb", "-displayfd", "1", "-screen", "0", f"{SIZE}x24", "-nolisten", "tcp", "-noreset"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        assert server.stdout is not None
        os.environ["DISPLAY"] = f":{server.stdout.readline().decode().strip()}"
        try:
            yield f"Xvfb {SIZE}"
        finally:
            server.terminate()


def _swaps(count: int, display: int) -> list[float]:
    """Return the seconds of `count` cleared, swapped and finished frames on a display, with GLFW alone."""
    import glfw

    glfw.init()
    monitor = sorted(glfw.get_monitors(), key=glfw.get_monitor_pos)[display - 1]
    mode = glfw.get_video_mode(monitor)
    window = glfw.create_window(mode.size.width, mode.size.height, "empty", monitor, None)
    glfw.make_context_current(window)
    glfw.swap_interval(1)
    prototype: Any = ctypes.CFUNCTYPE
    clear = prototype(None, ctypes.c_uint)(glfw.get_proc_address("glClear"))
    colour = prototype(None, *[ctypes.c_float] * 4)(glfw.get_proc_address("glClearColor"))
    finish = prototype(None)(glfw.get_proc_address("glFinish"))
    times: list[float] = []
    for number in range(count):
        start = time.perf_counter()
        glfw.poll_events()
        colour(number % 2, 0.0, 0.0, 1.0)
        clear(0x4000)
        glfw.swap_buffers(window)
        finish()
        times.append(time.perf_counter() - start)
    glfw.destroy_window(window)
    glfw.terminate()
    return times


def main() -> int:
    """Measure on the left display."""
    with _desktop() as desktop:
        if not desktop:
            print("no DISPLAY and no Xvfb; nothing was measured. Install xvfb", file=sys.stderr)
            return 0
        display = list_displays()[0]
        size = f"{display.width}×{display.height}"
        lights = plan_illuminants()
        screen = FullScreen(display.number)
        show_s: list[float] = []
        busy: list[float] = []
        for light in lights:
            start, processor_start = time.perf_counter(), time.process_time()
            screen.show(light.colour)
            show_s.append(time.perf_counter() - start)
            busy.append(time.process_time() - processor_start)
        screen.close()
        swap_s = _swaps(len(lights), display.number)
    median, empty = statistics.median(show_s), statistics.median(swap_s)
    for name, value, unit, against in (
        (f"presenter: show to confirmed, median of {len(lights)}, {size}", median, "s", desktop),
        (f"presenter: show to confirmed, worst of {len(lights)}, {size}", max(show_s), "s", desktop),
        (
            f"presenter: processor time of the slowest show, {size}",
            busy[show_s.index(max(show_s))],
            "s",
            "this process",
        ),
        (f"presenter: empty clear, swap and finish, median, {size}", empty, "s", desktop),
        (f"presenter: empty clear, swap and finish, worst, {size}", max(swap_s), "s", desktop),
        ("presenter: show to confirmed / empty swap", median / empty, "ratio", "clear, swap, glFinish"),
    ):
        print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
