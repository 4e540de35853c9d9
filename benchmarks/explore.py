"""Response times of the page of a LUT while an illuminant is dragged over the plane.

`python -m benchmarks.explore [LUT]` prints one JSON object per line: the median and the longest time of each answer of
the server, over loopback, for a picture of 1000 × 750 px. It also prints the total time of the three answers that a
page needs for one illuminant. Without an argument the demo LUT is used. Each mixed illuminant is requested only once,
so no cache contains it. If Chromium is installed, the last line is the time from the choice of an illuminant until both
images are drawn.
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

# Number of requested illuminants.
PLACES = 40

# Moves the illuminant on the page from place to place and returns the time of each move, in ms.
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

# Size of the picture, px.
SIZE = MAX_SIDE, 750


def _picture() -> bytes:
    """Return a PNG picture of smooth colours with photographic grain."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (8, 12, 3)).astype(np.float32)
    smooth = np.asarray(cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC), np.float64)
    grainy = np.asarray(np.clip(smooth + rng.normal(0, 4, smooth.shape), 0, 255), np.uint8)
    return cv2.imencode(".png", grainy)[1].tobytes()


def _request(address: str, **query: object) -> tuple[float, bytes]:
    start = time.perf_counter()
    with urllib.request.urlopen(f"{address}?{urllib.parse.urlencode(query)}") as response:
        body = response.read()
    return time.perf_counter() - start, body


def _drawing_times_ms(base: str, positions: npt.NDArray[np.float64]) -> list[float]:
    """Return the drawing time on the page of each chromaticity (N, 2), in ms."""
    with browser_tab() as tab:
        tab.open(base)
        tab.wait_for("document.readyState === 'complete' && panels.length === 2 && panels.every((one) => one.drawn)")
        # Shift the illuminants slightly, so that they are not cached.
        return tab.value(DRAGGED.replace("PLACES", json.dumps((positions + 1e-4).tolist())))


def main() -> None:
    lut_name = sys.argv[1] if len(sys.argv) > 1 else "demo:"
    lut = open_lut(table_folder(Path(lut_name)))
    lut_rb = Gamut.of(lut).rb
    positions = np.random.default_rng(1).dirichlet(np.ones(len(lut_rb)), PLACES + 1) @ lut_rb
    with tempfile.TemporaryDirectory(prefix="crop-") as folder:
        (Path(folder) / "picture.png").write_bytes(_picture())
        explorer = Explorer(lut_name, lut, find_pictures([folder], Preparation(max_side=MAX_SIDE)))
        with ExploreServer(explorer, "127.0.0.1", 0) as server:
            Thread(target=server.serve_forever, daemon=True).start()
            base = f"http://127.0.0.1:{server.port}/"
            times: dict[str, list[float]] = {"light": [], "by codes": [], "by colour": [], "pixel": []}
            for number, (r, b) in enumerate(positions):
                place_s, body = _request(f"{base}shown.json", picture=0, light=f"r={r:.5f},b={b:.5f}")
                light = json.loads(body)["light"]
                codes_s, image = _request(f"{base}counts", picture=0, light=light, rendering="codes")
                colour_s, _ = _request(f"{base}counts", picture=0, light=light, rendering="colorimetric")
                pixel_s, _ = _request(f"{base}pixel.json", picture=0, light=light, x=500, y=400)
                assert len(image) == 8 + 6 * SIZE[0] * SIZE[1]
                # The first request does not count: it compiles, and computes the map of the print, which is then kept
                # on disk.
                if number:
                    for name, seconds in zip(times, (place_s, codes_s, colour_s, pixel_s), strict=True):
                        times[name].append(1000 * seconds)
                else:
                    print(json.dumps({"answer": "first request", "ms": round(1000 * (place_s + codes_s + colour_s))}))
            times["drawn by Chromium"] = _drawing_times_ms(base, positions[1:]) if CHROMIUM else []
            server.shutdown()
    times["light and both"] = [sum(answers) for answers in zip(*list(times.values())[:3], strict=True)]
    for name, times_ms in times.items():
        if not times_ms:
            continue
        print(
            json.dumps(
                {"answer": name, "ms": round(statistics.median(times_ms), 1), "slowest": round(max(times_ms), 1)}
            )
        )


if __name__ == "__main__":
    main()
