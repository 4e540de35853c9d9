"""What the page of a table waits for: a light is dragged over the plane, and each place asked for as the page does.

`python -m benchmarks.explore [LUT]` prints one JSON object a line: median and slowest time of each answer over
loopback, at 1000 x 750 px, and of the three that a page draws a light from, one after another (a page asks for both
images at once). The demo table unless another is named. Each light is asked for once: none is in any cache, but for
what a table keeps of its own lights. Where Chromium is installed, a last line has the time from a light's choice on the
page to both pictures tone mapped and drawn.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import numpy.typing as npt

from calibration.table.demo_table import table_folder
from calibration.table.lut import open_lut
from generator.explore.explorer import MAX_SIDE, Explorer, ExploreServer
from generator.lights.gamut import Gamut
from generator.pictures.sources import Preparation, find_pictures
from tests.acquisition.monitor.browser import CHROMIUM, browser_tab

# Lights that are asked for.
PLACES = 40

# A script that moves the light on the page from place to place, and comes to the time of each, ms.
DRAGGED = """
(async () => {
  const times = [];
  for (const rb of PLACES) {
    const before = panels.map((panel) => panel.drawn);
    const begun = performance.now();
    move(rb);
    while (panels.some((panel, at) => panel.drawn === before[at])) await new Promise((go) => setTimeout(go, 1));
    times.push(performance.now() - begun);
    while (panels.some((panel) => panel.drawn !== `0 ${shown.light}`)) await new Promise((go) => setTimeout(go, 1));
  }
  return times;
})()
"""

# Of the picture, px.
SIZE = MAX_SIDE, 750


def _picture() -> bytes:
    """Return a picture of smooth colours with the grain of a photograph, as PNG."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (8, 12, 3)).astype(np.float32)
    smooth = np.asarray(cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC), np.float64)
    grainy = np.asarray(np.clip(smooth + rng.normal(0, 4, smooth.shape), 0, 255), np.uint8)
    return cv2.imencode(".png", grainy)[1].tobytes()


def _ask(address: str, **query: object) -> tuple[float, bytes]:
    begun = time.perf_counter()
    with urllib.request.urlopen(f"{address}?{urllib.parse.urlencode(query)}") as answer:
        body = answer.read()
    return time.perf_counter() - begun, body


def _drawn(base: str, ways: npt.NDArray[np.float64]) -> list[float]:
    """Return how long each of some chromaticities (N, 2) takes to be drawn on the page, ms."""
    with browser_tab() as tab:
        tab.open(base)
        tab.wait_for("document.readyState === 'complete' && panels.length === 2 && panels.every((one) => one.drawn)")
        # Lights that are not in the program's caches yet: a little beside those before.
        return tab.value(DRAGGED.replace("PLACES", json.dumps((ways + 1e-4).tolist())))


def main() -> None:
    """Print the times."""
    given = sys.argv[1] if len(sys.argv) > 1 else "demo:"
    lut = open_lut(table_folder(Path(given)))
    places = Gamut.of(lut).rb
    ways = np.random.default_rng(1).dirichlet(np.ones(len(places)), PLACES + 1) @ places
    with tempfile.TemporaryDirectory(prefix="crop-") as folder:
        (Path(folder) / "picture.png").write_bytes(_picture())
        explorer = Explorer(given, lut, find_pictures([folder], Preparation(max_side=MAX_SIDE)))
        with ExploreServer(explorer, "127.0.0.1", 0) as server:
            Thread(target=server.serve_forever, daemon=True).start()
            base = f"http://127.0.0.1:{server.port}/"
            times: dict[str, list[float]] = {"light": [], "by codes": [], "by colour": [], "pixel": []}
            for number, (r, b) in enumerate(ways):
                took, body = _ask(f"{base}shown.json", picture=0, light=f"r={r:.5f},b={b:.5f}")
                light = json.loads(body)["light"]
                codes, image = _ask(f"{base}counts", picture=0, light=light, rendering="codes")
                colour, _ = _ask(f"{base}counts", picture=0, light=light, rendering="colorimetric")
                pixel, _ = _ask(f"{base}pixel.json", picture=0, light=light, x=500, y=400)
                assert len(image) == 8 + 6 * SIZE[0] * SIZE[1]
                # The first compiles, and searches the print for colours, which is kept on disk.
                if number:
                    for name, seconds in zip(times, (took, codes, colour, pixel), strict=True):
                        times[name].append(1000 * seconds)
                else:
                    print(json.dumps({"answer": "first of a process", "ms": round(1000 * (took + codes + colour))}))
            times["drawn by Chromium"] = _drawn(base, ways[1:]) if CHROMIUM else []
            server.shutdown()
    times["light and both"] = [sum(parts) for parts in zip(*list(times.values())[:3], strict=True)]
    for name, each in times.items():
        if not each:
            continue
        print(json.dumps({"answer": name, "ms": round(statistics.median(each), 1), "slowest": round(max(each), 1)}))


if __name__ == "__main__":
    main()
