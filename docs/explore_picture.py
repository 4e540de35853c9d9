"""Screenshot of the LUT page for the site: ``python -m docs.explore_picture`` writes docs/images/explore.jpg.

A LUT of 707 illuminants is computed (`sim table`), and headless Chromium shows it with the photographs of
examples/photographs.py.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import threading
from pathlib import Path

from PIL import Image

from calibration.table.lut import open_lut
from examples.photographs import main as save_photographs
from generator.explore.explorer import Explorer, ExploreServer
from generator.pictures.sources import Preparation, find_pictures
from synthesis.cli import main as sim
from tests.acquisition.monitor.browser import browser_tab

# Size of the browser window, px: it shows the illuminant, the picture and the pixel.
WINDOW = 1280, 790

# Few colours, so that the LUT takes seconds; rendering by colour does not show it.
SETTINGS = 'room.profile = "managed"\nchart.bits = 4\n'

# True when both images and the pixel values are drawn.
DRAWN = "panels.every((one) => one.drawn.endsWith(shown.light) && one.rows.textContent.includes('±'))"


def main() -> None:
    """Write docs/images/explore.jpg."""
    target = Path(__file__).resolve().with_name("images") / "explore.jpg"
    with tempfile.TemporaryDirectory(prefix="crop-") as folder, contextlib.chdir(folder):
        Path("settings.toml").write_text(SETTINGS, encoding="utf-8")
        sim(["table", "lut", "--camera", "EOS 550D", "--settings", "settings.toml"])
        save_photographs(Path("photographs"))
        sources = find_pictures("photographs/coffee.png", Preparation(max_side=1000))
        explorer = Explorer("lut", open_lut(Path("lut")), sources)
        with ExploreServer(explorer, "127.0.0.1", 0) as server, browser_tab() as tab:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            tab.call("Emulation.setScrollbarsHidden", hidden=True)
            tab.open(f"http://127.0.0.1:{server.port}/", width=WINDOW[0], height=WINDOW[1])
            tab.wait_for("document.readyState === 'complete' && typeof shown !== 'undefined' && shown !== null")
            tab.value("move([0.2, 0.36])")
            tab.wait_for("shown.parts.length === 3")
            tab.value("point([246, 203])")
            tab.wait_for(DRAWN)
            picture = tab.screenshot(Path("page.png"), whole=False)
            server.shutdown()
        Image.open(io.BytesIO(picture.read_bytes())).convert("RGB").save(target, quality=85, optimize=True)
    print(target.name)


if __name__ == "__main__":
    main()
