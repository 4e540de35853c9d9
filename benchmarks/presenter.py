"""What it costs to be sure of the colour: `FullScreen.show` of all 707 lights, against empty swaps of the same size.

`python -m benchmarks.presenter` prints one JSON object a line for each figure. It lights the display that DISPLAY
names; where there is none, one of Xvfb, where swaps wait for no refresh and OpenGL is done in software. A slowest show
that took much longer than the processor worked for it has waited for other programs.
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
    """Yield what kind of desktop there is, starting a virtual one where there is none; "" where that cannot be."""
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        yield "the display there is"
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
    """Return the seconds of `count` cleared, swapped and finished frames on a display, by GLFW alone."""
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
        begun = time.perf_counter()
        glfw.poll_events()
        colour(number % 2, 0.0, 0.0, 1.0)
        clear(0x4000)
        glfw.swap_buffers(window)
        finish()
        times.append(time.perf_counter() - begun)
    glfw.destroy_window(window)
    glfw.terminate()
    return times


def main() -> int:
    """Measure on the left display."""
    with _desktop() as where:
        if not where:
            print("no display here and no Xvfb (Debian: xvfb): the presenter is not measured", file=sys.stderr)
            return 0
        display = list_displays()[0]
        size = f"{display.width}×{display.height}"
        lights = plan_illuminants()
        screen = FullScreen(display.number)
        shows: list[float] = []
        busy: list[float] = []
        for light in lights:
            begun, worked = time.perf_counter(), time.process_time()
            screen.show(light.colour)
            shows.append(time.perf_counter() - begun)
            busy.append(time.process_time() - worked)
        screen.close()
        swaps = _swaps(len(lights), display.number)
    median, empty = statistics.median(shows), statistics.median(swaps)
    for name, value, unit, against in (
        (f"presenter: show to confirmed, median of {len(lights)}, {size}", median, "s", where),
        (f"presenter: show to confirmed, worst of {len(lights)}, {size}", max(shows), "s", where),
        (f"presenter: processor time of the slowest show, {size}", busy[shows.index(max(shows))], "s", "this process"),
        (f"presenter: empty clear, swap and finish, median, {size}", empty, "s", where),
        (f"presenter: empty clear, swap and finish, worst, {size}", max(swaps), "s", where),
        ("presenter: show to confirmed over an empty swap, medians", median / empty, "ratio", "clear, swap, glFinish"),
    ):
        print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
