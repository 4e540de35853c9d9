"""The page of a table in a browser: lights are picked, dragged and mixed, pictures shown, measured, and dropped."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from foundation.errors import QualityError
from generator.explore.explorer import Explorer, ExploreServer
from generator.files import flash
from generator.lights.gamut import rb_of
from generator.lights.lighting import parse_mixture
from generator.pictures.sources import Preparation, find_pictures
from tests.acquisition.monitor.browser import (
    NAMELESS,
    OUTSIDE,
    POOR_CONTRAST,
    TOO_WIDE,
    Tab,
    browser_tab,
    needs_chromium,
)
from tests.generator.explore.conftest import png
from tests.generator.rendering.conftest import MakeTable
from tests.serving import serving

pytestmark = [pytest.mark.slow, needs_chromium]
HOSTILE = "<img src=x onerror='window.hacked=1'>&{data}.png"
DRAWN = "panels.length === 2 && panels.every((panel) => panel.drawn === `${state.picture} ${shown?.light}`)"
"""Both renderings of what is chosen are drawn."""


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    with browser_tab() as opened:
        yield opened


@pytest.fixture
def explorer(make_table: MakeTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Explorer:
    """Return an explorer of a print under three black bodies, with two pictures of names that are markup."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / HOSTILE.replace("/", "|")).write_bytes(png(1, 160, 90))
    (folder / "other.png").write_bytes(png(2, 120, 100))
    return Explorer("lut", make_table(), find_pictures([str(folder)], Preparation(max_side=100)), 100)


@contextmanager
def shown(
    tab: Tab, explorer: Explorer, *, width: int = 1280, dark: bool = False, host: str = "127.0.0.1"
) -> Generator[ExploreServer]:
    with serving(ExploreServer(explorer, host, 0)) as server:
        try:
            tab.errors.clear()
            tab.open(f"http://127.0.0.1:{server.port}/{server.path}", width=width, dark=dark)
            # The black body nearest to 5600 K comes first, and tests begin with the reddest light.
            tab.wait_for(f"document.readyState === 'complete' && {DRAWN} && shown.light === '1'")
            tab.value("pick(0)")
            tab.wait_for(f"{DRAWN} && shown.light === '0'")
            yield server
        finally:
            errors = list(tab.errors)
            tab.open("about:blank")
        assert errors == []


def text_of(tab: Tab, place: str) -> str:
    return tab.value(f"document.getElementById('{place}').textContent")


def place_in_plane(tab: Tab, rb: list[float]) -> tuple[float, float]:
    """Return where a chromaticity is in the window, px."""
    x, y = tab.value(
        f"(() => {{ const [x, y] = plane.place({json.dumps(rb)}); "
        "const at = new DOMPoint(x, y).matrixTransform(plane.svg.getScreenCTM()); return [at.x, at.y]; })()"
    )
    return x, y


def light(tab: Tab) -> str:
    """Return the light that is shown, when both renderings of it are drawn."""
    return tab.wait_for(f"!document.hidden && {DRAWN} && shown.light")


def histogram(tab: Tab, panel: int) -> list[list[int]]:
    """Return which of 96 bins hold pixels of red, green and blue, as drawn: a curve is on the ground in the others."""
    paths = tab.value(f"[...panels[{panel}].histogram.querySelectorAll('path')].map((one) => one.getAttribute('d'))")
    heights = [[float(point.split()[1]) for point in path[1:].split("L")][:96] for path in paths]
    return [[bin_ for bin_, height in enumerate(curve) if height < 110] for curve in heights]


def test_a_table_is_seen_at_once(tab: Tab, explorer: Explorer) -> None:
    with shown(tab, explorer):
        assert tab.value("document.querySelectorAll('circle.light').length") == 3
        assert text_of(tab, "command-codes").endswith("--max-side 100 --light 0 --rendering codes")
        assert text_of(tab, "command-colorimetric").endswith("--max-side 100 --light 0")
        truth = explorer.lut.white[0] / explorer.lut.white[0].sum()
        assert all(f"{part:.3f}".removeprefix("0") in text_of(tab, "light-facts") for part in truth)
        for panel, rendering in enumerate(("codes", "colorimetric")):
            image = explorer.counts(0, "0", rendering)
            assert tab.value(f"[...panels[{panel}].counts.slice(0, 600)]") == image.ravel()[:600].tolist()
            label = tab.value(f"panels[{panel}].histogram.querySelector('svg').getAttribute('aria-label')")
            assert f"up to {image.max()} of {explorer.lut.provenance.white_level}" in label
            assert histogram(tab, panel) == [
                np.histogram(image[..., channel], 96, (0, explorer.lut.provenance.white_level))[0].nonzero()[0].tolist()
                for channel in range(3)
            ]
        assert tab.value(OUTSIDE) == []
        assert "NaN" not in tab.value("document.body.innerHTML")
        assert "undefined" not in tab.value("document.querySelector('main').innerHTML")
        assert HOSTILE.replace("/", "|") in text_of(tab, "picture-name")
        assert tab.value("window.hacked") is None
        for way in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "new Function"):
            assert way not in tab.value("document.querySelector('script').textContent")


def test_a_light_is_picked_dragged_and_moved_by_keys(tab: Tab, explorer: Explorer) -> None:
    rb = rb_of(explorer.lut.white)
    with shown(tab, explorer):
        tab.drag([place_in_plane(tab, rb[2].tolist())])
        tab.wait_for("shown.light === '2'")
        assert tab.value("document.getElementById('light').value") == "2"
        middle = rb.mean(axis=0).tolist()
        tab.drag([place_in_plane(tab, place) for place in (rb[2].tolist(), (rb[:2].mean(axis=0)).tolist(), middle)])
        tab.wait_for("shown.parts.length === 3")
        # The wanted chromaticity is written with five decimals, and a pixel is a thousandth.
        tab.wait_for(f"Math.hypot(shown.rb[0] - {middle[0]}, shown.rb[1] - {middle[1]}) < .004")
        made = rb_of(parse_mixture(light(tab)).white(explorer.lut)).tolist()
        assert tab.value("plane.chosen") == pytest.approx(made)
        tab.value("document.getElementById('plane').focus()")
        tab.press("ArrowRight")
        tab.wait_for(f"Math.abs(shown.rb[0] - {made[0] + 0.001}) < 2e-5")
        tab.press("PageDown")
        tab.wait_for("shown.light === '1'")
        far = (place_in_plane(tab, rb[0].tolist())[0] + 40, place_in_plane(tab, rb[0].tolist())[1])
        tab.drag([far])
        tab.wait_for("document.getElementById('light-facts').textContent.includes('nearest')")


def forget_refusals(tab: Tab) -> None:
    """Forget what the browser itself logs of an answer that the page tells."""
    assert tab.errors
    assert all("status of 422" in error for error in tab.errors)
    tab.errors.clear()


def test_two_lights_are_mixed(tab: Tab, explorer: Explorer) -> None:
    with shown(tab, explorer):
        tab.value(
            "(() => { const other = $('other'); other.value = '2'; other.dispatchEvent(new Event('change')); })()"
        )
        tab.wait_for("shown.light === '0:0.5+2:0.5'")
        tab.value("(() => { $('share').value = '.2'; $('share').dispatchEvent(new Event('input')); })()")
        tab.wait_for("shown.light === '0:0.8+2:0.2'")
        assert light(tab) == "0:0.8+2:0.2"
        assert text_of(tab, "share-text") == "20 %"
        for share, alone in (("0", "0"), ("1", "2")):
            tab.value(f"(() => {{ $('share').value = '{share}'; $('share').dispatchEvent(new Event('input')); }})()")
            tab.wait_for(f"shown.light === '{alone}'")
        tab.value("(() => { $('text').value = '4000K'; $('write').requestSubmit(); })()")
        tab.wait_for("shown.parts.length === 2 && shown.parts[1][0] === 1")
        tab.value("(() => { $('text').value = 'sunny'; $('write').requestSubmit(); })()")
        tab.wait_for("!document.getElementById('fault').hidden")
        assert "sunny" in text_of(tab, "fault")
        forget_refusals(tab)


def test_of_many_moves_the_last_is_shown(tab: Tab, explorer: Explorer) -> None:
    with shown(tab, explorer):
        tab.value("(() => { for (let i = 0; i < 60; i++) pick(i % 3); pick(1); })()")
        tab.wait_for("shown.light === '1'")
        light(tab)
        assert (
            tab.value("[...panels[0].counts.slice(0, 300)]") == explorer.counts(0, "1", "codes").ravel()[:300].tolist()
        )


def test_a_pixel_is_measured(tab: Tab, explorer: Explorer) -> None:
    with shown(tab, explorer):
        tab.value("document.querySelector('.screen').focus()")
        for key in ("ArrowLeft", "ArrowDown", "ArrowDown"):
            tab.press(key)
        at = tab.value("state.at")
        image = explorer.counts(0, "0", "codes")
        assert at == [image.shape[1] // 2 - 1, image.shape[0] // 2 + 2]
        rows = (
            "[...panels[{}].rows.querySelectorAll('tr')].map((row) => [...row.cells].map((cell) => cell.textContent))"
        )
        for panel, rendering in enumerate(("codes", "colorimetric")):
            tab.wait_for(f"panels[{panel}].rows.textContent.includes('±')")
            image = explorer.counts(0, "0", rendering)
            for channel, (_, count, spread) in enumerate(tab.value(rows.format(panel))):
                mean, deviation = (float(part) for part in spread.split("±"))
                assert int(count) == image[at[1], at[0], channel]
                assert abs(int(count) - mean) < 5 * deviation
        middle = "[...panels[0].loupe.getContext('2d').getImageData(66, 66, 1, 1).data]"
        assert tab.value(middle) == tab.value(
            f"[...panels[0].canvas.getContext('2d').getImageData({at[0]}, {at[1]}, 1, 1).data]"
        )
        tab.value("pick(2)")
        tab.wait_for("panels[0].drawn === '0 2' && panels[0].rows.textContent.includes('±')")
        count, spread = tab.value(rows.format(0))[1][1:]
        assert int(count) == explorer.counts(0, "2", "codes")[at[1], at[0], 1]
        assert float(spread.split("±")[0]) == pytest.approx(explorer.pixel(0, "2", "codes", *at)["mean"][1], abs=0.06)


def shades(tab: Tab, view: str) -> np.ndarray[Any, Any]:
    """Return what the panel by codes shows, (H, W, 3) uint8."""
    tab.value(f"document.querySelector('input[value={view}]').click()")
    width, height = tab.value("[panels[0].canvas.width, panels[0].canvas.height]")
    data = "panels[0].canvas.getContext('2d').getImageData(0, 0, panels[0].canvas.width, panels[0].canvas.height).data"
    return np.array(tab.value(f"[...{data}]"), np.uint8).reshape(height, width, 4)[..., :3]


def test_views_are_what_they_say(tab: Tab, explorer: Explorer) -> None:
    white = explorer.lut.provenance.white_level
    image = explorer.counts(0, "0", "codes").astype(np.float64)
    with shown(tab, explorer):
        # The browser rounds halves its own way, and brightness is known there to a whole count.
        assert np.abs(shades(tab, "counts") - 255 * image / white).max() <= 0.51
        assert np.abs(shades(tab, "camera").astype(int) - flash(image / white)).max() <= 2
        truth = explorer.lut.white[0]
        assert np.abs(shades(tab, "balanced").astype(int) - flash(image / white * truth[1] / truth)).max() <= 2
        grey = image.reshape(-1, 3)[0] * truth[1] / truth
        assert grey[0] != pytest.approx(image[0, 0, 0])


def drop(tab: Tab, name: str, data: bytes) -> None:
    script = """
    (() => {
      const file = new File([Uint8Array.from(atob(DATA), (one) => one.charCodeAt(0))], NAME);
      const carried = new DataTransfer();
      carried.items.add(file);
      document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: carried, bubbles: true, cancelable: true }));
    })()
    """
    text = base64.b64encode(data).decode()
    tab.value(script.replace("DATA", json.dumps(text)).replace("NAME", json.dumps(name)))


def test_pictures_are_gone_through_and_dropped(tab: Tab, explorer: Explorer) -> None:
    with shown(tab, explorer):
        tab.value("document.getElementById('next').click()")
        tab.wait_for(f"shown.picture.name === 'other.png' && {DRAWN}")
        assert tab.value("[panels[0].canvas.width, panels[0].canvas.height]") == [100, 83]
        drop(tab, "mine.png", png(3, 80, 60))
        tab.wait_for(f"shown.picture.name === 'mine.png' && {DRAWN}")
        assert "(3 of 3)" in text_of(tab, "picture-name")
        assert "--sources mine.png" in text_of(tab, "command-codes")
        assert tab.value("[panels[0].canvas.width, panels[0].canvas.height]") == [80, 60]
        tab.value("document.getElementById('next').click()")
        tab.wait_for(f"state.picture === 0 && {DRAWN}")
    with shown(tab, explorer):
        drop(tab, "letter.txt", b"Dear Sir")
        tab.wait_for("document.getElementById('fault').textContent.includes('letter.txt')")
        assert tab.value("state.picture") == 0
        forget_refusals(tab)


def test_a_phone_is_shown_the_same_behind_the_token(tab: Tab, explorer: Explorer) -> None:
    with shown(tab, explorer, width=390, dark=True, host="0.0.0.0") as server:
        assert len(server.path) > 20
        drop(tab, "mine.png", png(3, 80, 60))
        tab.wait_for(f"shown.picture.name === 'mine.png' && {DRAWN}")
        assert tab.value(OUTSIDE) == []


def test_a_rendering_that_cannot_be_is_said_beside_the_other(
    tab: Tab, explorer: Explorer, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = explorer.counts

    def refused(number: int, chosen: str, rendering: Any) -> Any:
        if rendering == "colorimetric":
            raise QualityError("the print has no contrast; render by codes")
        return counts(number, chosen, rendering)

    monkeypatch.setattr(explorer, "counts", refused)
    with ExploreServer(explorer, "127.0.0.1", 0) as server:
        threading.Thread(target=lambda: server.serve_forever(0.01), daemon=True).start()
        tab.open(f"http://127.0.0.1:{server.port}/")
        tab.wait_for("typeof panels !== 'undefined' && panels[1]?.wait.textContent.includes('no contrast')")
        tab.wait_for("panels[0].drawn === '0 1'")
        assert tab.value("[panels[0].screen.hidden, panels[1].screen.hidden]") == [False, True]
        network = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        tab.call("Network.emulateNetworkConditions", offline=True, **network)
        tab.value("pick(2)")
        tab.wait_for("document.getElementById('fault').textContent.includes('still runs')")
        tab.call("Network.emulateNetworkConditions", offline=False, **network)
        tab.open("about:blank")
        server.shutdown()


def test_a_light_without_one_colour_is_balanced_as_well(tab: Tab, explorer: Explorer) -> None:
    image = explorer.counts(0, "0", "codes").astype(np.float64)
    with shown(tab, explorer):
        # As if the light had a thousandth of its blue: what is divided by that is brighter than any count.
        truth = explorer.lut.white[0] * [1, 1, 1e-3]
        tab.value(f"shown.truth = {json.dumps((truth / truth.sum()).tolist())}")
        wanted = flash(image / explorer.lut.provenance.white_level * truth[1] / truth)
        assert np.abs(shades(tab, "balanced").astype(int) - wanted).max() <= 2


def test_a_picture_that_cannot_be_read_is_named_and_passed(tab: Tab, explorer: Explorer, tmp_path: Path) -> None:
    with shown(tab, explorer):
        (tmp_path / "pictures" / "other.png").write_bytes(b"no picture")
        tab.value("document.getElementById('next').click()")
        tab.wait_for("document.getElementById('fault').textContent.includes('other.png')")
        tab.value("point([3, 4])")
        tab.wait_for("panels[0].rows.textContent.includes('±')")
        tab.value("document.getElementById('next').click()")
        tab.wait_for("document.getElementById('fault').hidden && state.picture === 0")
        forget_refusals(tab)


@pytest.mark.parametrize(("width", "dark"), [(390, True), (1280, False)])
def test_nothing_is_cut_faint_or_nameless(tab: Tab, explorer: Explorer, width: int, dark: bool) -> None:
    with shown(tab, explorer, width=width, dark=dark):
        tab.value("move([.25, .3])")
        tab.value("point([20, 20])")
        light(tab)
        tab.wait_for("panels.every((panel) => panel.rows.textContent.includes('±'))")
        for script in (TOO_WIDE, POOR_CONTRAST, NAMELESS):
            assert tab.value(script) == []
        assert tab.value("document.documentElement.scrollWidth") <= width
