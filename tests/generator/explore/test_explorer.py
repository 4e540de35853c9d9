"""`generate explore`: the server, the page, and the command on the page."""

from __future__ import annotations

import base64
import http.client
import json
import shlex
import threading
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from foundation.errors import FormatError, InputError, QualityError
from generator.cli import main
from generator.dataset.reader import open_dataset
from generator.explore.explorer import Explorer, ExploreServer, sample_folder
from generator.files import flash
from generator.lights.gamut import black_body, rb_of
from generator.lights.lighting import parse_mixture
from generator.pictures.random_scenes import RandomScene
from generator.pictures.sources import Preparation, find_pictures, read_picture
from generator.rendering import Rendering
from tests.acquisition.monitor.browser import (
    NAMELESS,
    OUTSIDE,
    POOR_CONTRAST,
    TOO_WIDE,
    Tab,
    browser_tab,
)
from tests.generator.conftest import MakeLut
from tests.generator.explore.conftest import png
from tests.generator.rendering.conftest import MakeTable
from tests.pinned import Pinned
from tests.serving import serving

SIDE = 60


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def explorer(make_table: MakeTable, tmp_path: Path) -> Explorer:
    """Return an explorer of a print under three black bodies, with two pictures in a folder with spaces."""
    lut = make_table()
    folder = tmp_path / "my pictures"
    folder.mkdir()
    for number in range(2):
        (folder / f"it's {number}.png").write_bytes(png(number))
    return Explorer("lut", lut, find_pictures([str(folder)], Preparation(max_side=SIDE)), SIDE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "rendering"),
    [("1:.3+2:.7", "colorimetric"), ("r=.25,b=.3", "codes")],
)
def test_command_makes_displayed_image(explorer: Explorer, light: str, rendering: Rendering) -> None:
    record = explorer.show(1, light)
    image = explorer.counts(1, light, rendering).copy()
    assert image.shape == (round(SIDE * 5 / 9), SIDE, 3)
    arguments = shlex.split(record["commands"][rendering])
    assert arguments[0] == "generate"
    assert arguments[arguments.index("--sources") + 1] == "my pictures/it's 1.png", "relative to the working folder"
    assert main(arguments[1:]) == 0
    data_set = open_dataset("dataset")
    assert (data_set.read_image(data_set.entries[0]) == image).all()
    assert data_set.entries[0].truth == pytest.approx(record["truth"], abs=1e-9)
    assert [data_set.entries[0].lights[0], len(data_set.entries)] == [record["light"], 1]


@pytest.mark.slow
def test_command_of_upload_runs_in_picture_folder(explorer: Explorer, tmp_path: Path) -> None:
    number = explorer.add("/somewhere/-far .png", png(7))
    image = explorer.counts(number, "0", "codes").copy()
    assert not explorer.show(number, "0")["is_here"]
    (tmp_path / "-far .png").write_bytes(png(7))
    assert main(shlex.split(explorer.show(number, "0")["commands"]["codes"])[1:]) == 0
    data_set = open_dataset("dataset")
    assert (data_set.read_image(data_set.entries[0]) == image).all()


def test_escapes_lut_named_like_command(make_table: MakeTable, tmp_path: Path) -> None:
    (tmp_path / "cat.png").write_bytes(png(1))
    explorer = Explorer("explore", make_table(name="explore"), find_pictures("cat.png"), SIDE)
    assert main(shlex.split(explorer.show(0, "0")["commands"]["codes"])[1:]) == 0


def test_describes_lut(explorer: Explorer) -> None:
    answer = explorer.describe()
    lut = explorer.lut
    assert [light["label"] for light in answer["lights"]] == ["2000 K", "5600 K", "10000 K"]
    assert np.array([light["rb"] for light in answer["lights"]]) == pytest.approx(rb_of(lut.white))
    assert {tuple(point) for point in answer["hull"]} == {tuple(light["rb"]) for light in answer["lights"]}
    assert answer["first"] == 1, "the black body nearest to 5600 K"
    bodies = np.array(answer["black_bodies"])
    assert bodies[[0, -1], 0].tolist() == [2000, 10000]
    assert bodies[[0, -1], 1:] == pytest.approx(rb_of(lut.white[[0, 2]]))
    assert bodies[9, 1:] == pytest.approx(rb_of(black_body(lut, bodies[9, 0]).white(lut)))


def test_gamut_of_two_lights_is_a_line(make_lut: MakeLut) -> None:
    lut = make_lut(lights=2)
    answer = Explorer("lut", lut, ()).describe()
    assert np.sort(answer["hull"], axis=0) == pytest.approx(np.sort(rb_of(lut.white), axis=0))
    assert answer["black_bodies"] == []


def test_gamut_of_one_light_is_a_point(make_lut: MakeLut) -> None:
    explorer = Explorer("lut", make_lut(lights=1), ())
    assert explorer.describe()["hull"] == [explorer.describe()["lights"][0]["rb"]]


def test_replaces_light_outside_gamut_by_nearest(explorer: Explorer) -> None:
    record = explorer.show(0, "r=.9,b=.05")
    assert record["light"] == "0"
    with pytest.raises(InputError):
        explorer.show(0, "sunny")


def test_pixel_noise_matches_lut(explorer: Explorer) -> None:
    picture = read_picture(Path("my pictures") / "it's 0.png", SIDE)
    answer = explorer.pixel(0, "1", "codes", 3, 20)
    assert answer["codes"] == picture[20, 3].tolist()
    bits = [int(code) >> 5 for code in picture[20, 3]]
    cell = np.asarray(explorer.lut.samples[1, bits[0] << 6 | bits[1] << 3 | bits[2]], np.float64)
    # Means of 256 samples have a standard error of 1/16 of the deviation; four of these are allowed.
    assert np.abs(np.array(answer["mean"]) - cell.mean(axis=0)).max() < (cell.std(axis=0) / 4).max()
    assert np.array(answer["deviation"]) == pytest.approx(cell.std(axis=0), rel=0.25)
    with pytest.raises(InputError, match="the pixel 60, 3 is outside"):
        explorer.pixel(0, "1", "codes", 60, 3)


def test_refuses_unreadable_pictures(explorer: Explorer) -> None:
    with pytest.raises(FormatError, match=r"^cannot read letter\.txt"):
        explorer.add("letter.txt", b"Dear Sir")
    with pytest.raises(InputError, match="no picture 99"):
        explorer.show(99, "0")


def test_refuses_picture_with_too_many_pixels(explorer: Explorer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("generator.explore.explorer.MOST_UPLOADED_PIXELS", 90 * 50 - 1)
    with pytest.raises(FormatError):
        explorer.add("large.png", png(1))


@pytest.mark.slow
def test_sample_pictures(tmp_path: Path, pinned: Pinned) -> None:
    samples = sample_folder(tmp_path)
    original_times = {path.name: path.stat().st_mtime_ns for path in samples.iterdir()}
    assert len(original_times) == 3
    assert sample_folder(tmp_path) == samples
    assert original_times == {path.name: path.stat().st_mtime_ns for path in samples.iterdir()}
    codes = read_picture(samples / "balls.png").astype(np.int64)
    assert codes.shape == (600, 900, 3)
    squares = codes.reshape(20, 30, 30, 30, 3).sum(axis=(1, 3))
    # Powers may be rounded differently on another processor, in one code of a million.
    pinned("sample pictures", [codes, *squares.transpose(2, 0, 1)], same=2e-5)
    # The red ball: its surface in the middle, brighter towards the lamp on the upper left than away from it.
    x, y, radius = 160, 395, 130
    middle, near, far = (codes[y + direction * radius // 2, x + direction * radius // 2] for direction in (0, -1, 1))
    assert middle.argmax() == 0
    assert near.sum() > middle.sum() > far.sum()
    # The highlight is half way between the lamp and the viewer and has the colour of the lamp.
    lamp = np.array([-0.5, -0.65, 0.57]) / np.linalg.norm([-0.5, -0.65, 0.57])
    half = lamp + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    shiny = codes[round(y + half[1] * radius), round(x + half[0] * radius)]
    assert shiny.min() > 180
    patches = read_picture(samples / "patches.png")[75::150, 75::150].astype(np.int64)
    *hues, greys = patches
    # sRGB codes of i / 5 to the power of 2.2.
    assert greys.tolist() == [[code] * 3 for code in (0, 48, 102, 154, 205, 255)]
    # Red, yellow, green, cyan, blue, magenta; from row to row less saturated.
    for row in hues:
        assert [(patch > patch.mean()).tolist() for patch in row] == [
            [hue in (0, 1, 5), hue in (1, 2, 3), hue in (3, 4, 5)] for hue in range(6)
        ]
    assert (np.diff([np.ptp(row, axis=1) for row in hues], axis=0) < 0).all()
    blocks = read_picture(samples / "random.png").reshape(60, 10, 90, 10, 3)
    assert (blocks == blocks[:, :1, :, :1]).all()
    assert np.unique(blocks).size == 256


PNG = cv2.imencode(".png", RandomScene(0, 40, 30).read().picture)[1].tobytes()


def served(explorer: Explorer, host: str = "127.0.0.1") -> AbstractContextManager[ExploreServer]:
    return serving(ExploreServer(explorer, host, 0))


@pytest.fixture
def server(make_lut: MakeLut) -> Iterator[ExploreServer]:
    with served(Explorer("lut", make_lut(), ())) as opened:
        yield opened


def ask(
    server: ExploreServer, path: str, body: bytes | None = None, method: str | None = None, **headers: str
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Return status, headers and body of the answer; a request with a body uses PUT."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    try:
        method = method or ("GET" if body is None else "PUT")
        connection.request(method, path, body, {name.replace("_", "-"): text for name, text in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def test_uploads_and_shows_picture(server: ExploreServer) -> None:
    status, _, body = ask(server, "/picture?name=a.png", PNG)
    assert (status, json.loads(body)) == (200, {"picture": 0})
    status, headers, body = ask(server, "/counts?picture=0&light=1&rendering=codes")
    assert (status, headers["Content-Type"]) == (200, "application/octet-stream")
    assert np.frombuffer(body[:8], "<u4").tolist() == [30, 40]
    explorer = server._explorer
    image = explorer.counts(0, "1", "codes")
    assert body[8:] == image.astype("<u2").tobytes()
    answer = json.loads(ask(server, "/shown.json?picture=0&light=0:.5%2B2:.5")[2])
    assert answer["light"] == "0:0.5+2:0.5"
    pixel = json.loads(ask(server, "/pixel.json?picture=0&light=1&rendering=codes&x=2&y=3")[2])
    assert pixel["draws"] == 256


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/counts?picture=-1&light=1", 422),
        ("/counts?picture=%D9%A1&light=1", 422),
        ("/counts", 422),
        ("/pixel.json?picture=0&light=1&x=40&y=0", 422),
        ("/picture", 404),
        ("/templates/explore.html", 404),
        ("/../lut/lut.json", 404),
    ],
)
def test_reports_invalid_requests(server: ExploreServer, path: str, status: int) -> None:
    ask(server, "/picture?name=a.png", PNG)
    answered_status, headers, body = ask(server, path)
    assert (answered_status, headers["Content-Type"]) == (status, "text/plain; charset=utf-8")
    assert b"Traceback" not in body
    assert len(body) > 10


def test_page_loads_nothing_external(server: ExploreServer) -> None:
    status, headers, body = ask(server, "/")
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    for elsewhere in (b'src="http', b'href="http', b"@import", b"url("):
        assert elsewhere not in body


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "evil.example"}, 421),
        ({"Content_Length": "0"}, 413),
        ({"Content_Length": "1" * 30}, 413),
        ({"Content_Length": "-5"}, 413),
        ({"Transfer_Encoding": "chunked"}, 413),
    ],
)
def test_refuses_foreign_and_too_large_uploads(server: ExploreServer, headers: dict[str, str], status: int) -> None:
    body = b"" if set(headers) & {"Content_Length", "Transfer_Encoding"} else PNG
    answered_status, answered, _ = ask(server, "/picture?name=a.png", body, "PUT", **headers)
    assert (answered_status, answered["Connection"]) == (status, "close")
    assert ask(server, "/shown.json?picture=0&light=1")[0] == 422, "no picture was stored"


def test_accepts_uploads_only_by_put(server: ExploreServer) -> None:
    assert ask(server, "/", PNG)[0] == 404
    for method in ("POST", "PATCH", "OPTIONS", "DELETE"):
        assert ask(server, "/picture?name=a.png", PNG, method)[0] == 405
    own = f"http://127.0.0.1:{server.port}"
    assert ask(server, "/picture?name=a.png", PNG, Origin=own)[0] == 200
    assert ask(server, "/picture?name=a.png", b"no picture")[0] == 422


def test_other_machines_need_token(make_lut: MakeLut) -> None:
    with served(Explorer("lut", make_lut(), ()), "0.0.0.0") as server:
        for path in ("/", "/table.json", "/x/table.json"):
            assert ask(server, path)[0] == 403
        assert ask(server, "/picture?name=a.png", PNG)[0] == 403
        assert ask(server, f"/{server.path}table.json")[0] == 200
        assert ask(server, f"/{server.path}picture?name=a.png", PNG)[0] == 200


@pytest.mark.slow
@pytest.mark.usefixtures("table_and_picture")
def test_command_prints_address_and_stops_with_ctrl_c(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(server: ThreadingHTTPServer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", interrupt)
    assert main(["explore", "lut", "--sources", "cat.png", "--port", "0"]) == 0
    printed = capsys.readouterr()
    assert "http://127.0.0.1:" in printed.out
    assert printed.err == ""
    assert main(["-q", "explore", "lut", "--sources", "cat.png", "--port", "0"]) == 0
    assert main(["explore", "lut", "--sources", "dog.png"]) == 2
    assert "dog.png does not exist" in capsys.readouterr().err
    assert main(["explore", "nothing"]) == 2
    assert main(["explore"]) == 2


HOSTILE = "<img src=x onerror='window.hacked=1'>&{data}.png"

# Both renderings of the selection are drawn.
DRAWN = "panels.length === 2 && panels.every((panel) => panel.drawn === `${state.picture} ${shown?.light}`)"


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    with browser_tab() as opened:
        yield opened


@pytest.fixture
def page(make_table: MakeTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Explorer:
    """Return an explorer of a print under three black bodies, with two pictures; one name is markup."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / HOSTILE.replace("/", "|")).write_bytes(png(1, 160, 90))
    (folder / "other.png").write_bytes(png(2, 120, 100))
    return Explorer("lut", make_table(), find_pictures([str(folder)], Preparation(max_side=100)), 100)


@contextmanager
def shown(
    tab: Tab, page: Explorer, *, width: int = 1280, dark: bool = False, host: str = "127.0.0.1"
) -> Generator[ExploreServer]:
    with serving(ExploreServer(page, host, 0)) as server:
        try:
            tab.errors.clear()
            tab.open(f"http://127.0.0.1:{server.port}/{server.path}", width=width, dark=dark)
            # The page starts with the black body nearest to 5600 K, tests with the reddest illuminant.
            tab.wait_for(f"document.readyState === 'complete' && {DRAWN} && shown.light === '1'")
            tab.value("pick(0)")
            tab.wait_for(f"{DRAWN} && shown.light === '0'")
            yield server
        finally:
            errors = list(tab.errors)
            tab.open("about:blank")
        assert errors == []


def text_of(tab: Tab, element_id: str) -> str:
    return tab.value(f"document.getElementById('{element_id}').textContent")


def place_in_plane(tab: Tab, rb: list[float]) -> tuple[float, float]:
    """Return the position of a chromaticity in the window, px."""
    x, y = tab.value(
        f"(() => {{ const [x, y] = plane.place({json.dumps(rb)}); "
        "const at = new DOMPoint(x, y).matrixTransform(plane.svg.getScreenCTM()); return [at.x, at.y]; })()"
    )
    return x, y


def light(tab: Tab) -> str:
    """Return the displayed illuminant after both renderings are drawn."""
    return tab.wait_for(f"!document.hidden && {DRAWN} && shown.light")


def histogram(tab: Tab, panel: int) -> list[list[int]]:
    """Return the nonempty bins of the drawn histogram for red, green and blue."""
    paths = tab.value(f"[...panels[{panel}].histogram.querySelectorAll('path')].map((one) => one.getAttribute('d'))")
    heights = [[float(point.split()[1]) for point in path[1:].split("L")][:96] for path in paths]
    return [[bin_ for bin_, height in enumerate(curve) if height < 110] for curve in heights]


@pytest.mark.slow
def test_page_shows_lut_and_first_picture(tab: Tab, page: Explorer) -> None:
    with shown(tab, page):
        assert tab.value("document.querySelectorAll('circle.light').length") == 3
        assert tab.value("state.at.map((at, axis) => at / Object.values(shown.picture)[axis + 1])") == [0.5, 0.5]
        tab.wait_for("panels.every((panel) => panel.rows.textContent.includes('±'))")
        assert tab.value("document.querySelector('#commands code').id") == "command-colorimetric"
        assert text_of(tab, "command-codes").endswith("--max-side 100 --light 0 --rendering codes")
        assert text_of(tab, "command-colorimetric").endswith("--max-side 100 --light 0")
        truth = page.lut.white[0] / page.lut.white[0].sum()
        assert all(f"{number:.3f}" in text_of(tab, "light-facts") for number in truth)
        for panel, rendering in enumerate(("colorimetric", "codes")):
            image = page.counts(0, "0", rendering)
            assert tab.value(f"[...panels[{panel}].counts.slice(0, 600)]") == image.ravel()[:600].tolist()
            label = tab.value(f"panels[{panel}].histogram.querySelector('svg').getAttribute('aria-label')")
            assert f"up to {image.max()} of {page.lut.provenance.white_level}" in label
            assert histogram(tab, panel) == [
                np.histogram(image[..., channel], 96, (0, page.lut.provenance.white_level))[0].nonzero()[0].tolist()
                for channel in range(3)
            ]
        assert tab.value(OUTSIDE) == []
        assert "NaN" not in tab.value("document.body.innerHTML")
        assert "undefined" not in tab.value("document.querySelector('main').innerHTML")
        assert HOSTILE.replace("/", "|") in text_of(tab, "picture-name")
        assert tab.value("window.hacked") is None
        for function in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "new Function"):
            assert function not in tab.value("document.querySelector('script').textContent")


@pytest.mark.slow
def test_selects_light_by_click_drag_and_keys(tab: Tab, page: Explorer) -> None:
    rb = rb_of(page.lut.white)
    with shown(tab, page):
        tab.drag([place_in_plane(tab, rb[2].tolist())])
        tab.wait_for("shown.light === '2'")
        assert tab.value("document.getElementById('light').value") == "2"
        middle = rb.mean(axis=0).tolist()
        tab.drag([place_in_plane(tab, point) for point in (rb[2].tolist(), (rb[:2].mean(axis=0)).tolist(), middle)])
        tab.wait_for("shown.parts.length === 3")
        # The chromaticity has five decimals, and a pixel is about 0.001.
        tab.wait_for(f"Math.hypot(shown.rb[0] - {middle[0]}, shown.rb[1] - {middle[1]}) < .004")
        data_set = rb_of(parse_mixture(light(tab)).white(page.lut)).tolist()
        assert tab.value("plane.chosen") == pytest.approx(data_set)
        tab.value("document.getElementById('plane').focus()")
        tab.press("ArrowRight")
        tab.wait_for(f"Math.abs(shown.rb[0] - {data_set[0] + 0.001}) < 2e-5")
        tab.press("PageDown")
        tab.wait_for("shown.light === '1'")
        far = (place_in_plane(tab, rb[0].tolist())[0] + 40, place_in_plane(tab, rb[0].tolist())[1])
        tab.drag([far])
        tab.wait_for("document.getElementById('light-facts').textContent.includes('nearest')")


def clear_refused_requests(tab: Tab) -> None:
    """Clear errors that the browser logs for refused requests."""
    assert tab.errors
    assert all("status of 422" in error for error in tab.errors)
    tab.errors.clear()


@pytest.mark.slow
def test_mixes_two_lights(tab: Tab, page: Explorer) -> None:
    with shown(tab, page):
        tab.value(
            "(() => { const other = $('other'); other.value = '2'; other.dispatchEvent(new Event('change')); })()"
        )
        tab.wait_for("shown.light === '0:0.5+2:0.5'")
        tab.value("(() => { $('share').value = '.2'; $('share').dispatchEvent(new Event('input')); })()")
        tab.wait_for("shown.light === '0:0.8+2:0.2'")
        assert light(tab) == "0:0.8+2:0.2"
        assert text_of(tab, "share-text") == "20 %"
        for share, light_number in (("0", "0"), ("1", "2")):
            tab.value(f"(() => {{ $('share').value = '{share}'; $('share').dispatchEvent(new Event('input')); }})()")
            tab.wait_for(f"shown.light === '{light_number}'")
        tab.value("(() => { $('text').value = '4000K'; $('write').requestSubmit(); })()")
        tab.wait_for("shown.parts.length === 2 && shown.parts[1][0] === 1")
        tab.value("(() => { $('text').value = 'sunny'; $('write').requestSubmit(); })()")
        tab.wait_for("!document.getElementById('fault').hidden")
        assert "sunny" in text_of(tab, "fault")
        clear_refused_requests(tab)


@pytest.mark.slow
def test_shows_last_of_many_selections(tab: Tab, page: Explorer) -> None:
    with shown(tab, page):
        tab.value("(() => { for (let i = 0; i < 60; i++) pick(i % 3); pick(1); })()")
        tab.wait_for("shown.light === '1'")
        light(tab)
        assert tab.value("[...panels[1].counts.slice(0, 300)]") == page.counts(0, "1", "codes").ravel()[:300].tolist()


@pytest.mark.slow
def test_measures_pixel(tab: Tab, page: Explorer) -> None:
    with shown(tab, page):
        tab.value("document.querySelector('.screen').focus()")
        for key in ("ArrowLeft", "ArrowDown", "ArrowDown"):
            tab.press(key)
        pixel = tab.value("state.at")
        image = page.counts(0, "0", "codes")
        assert pixel == [image.shape[1] // 2 - 1, image.shape[0] // 2 + 2]
        rows = (
            "[...panels[{}].rows.querySelectorAll('tr')].map((row) => [...row.cells].map((cell) => cell.textContent))"
        )
        for panel, rendering in enumerate(("colorimetric", "codes")):
            tab.wait_for(f"panels[{panel}].rows.textContent.includes('±')")
            image = page.counts(0, "0", rendering)
            for channel, (_, count, spread) in enumerate(tab.value(rows.format(panel))):
                mean, deviation = (float(number) for number in spread.split("±"))
                assert int(count) == image[pixel[1], pixel[0], channel]
                assert abs(int(count) - mean) < 5 * deviation
        middle = "[...panels[1].loupe.getContext('2d').getImageData(66, 66, 1, 1).data]"
        assert tab.value(middle) == tab.value(
            f"[...panels[1].canvas.getContext('2d').getImageData({pixel[0]}, {pixel[1]}, 1, 1).data]"
        )
        tab.value("pick(2)")
        tab.wait_for("panels[1].drawn === '0 2' && panels[1].rows.textContent.includes('±')")
        count, spread = tab.value(rows.format(1))[1][1:]
        assert int(count) == page.counts(0, "2", "codes")[pixel[1], pixel[0], 1]
        assert float(spread.split("±")[0]) == pytest.approx(page.pixel(0, "2", "codes", *pixel)["mean"][1], abs=0.06)


def shades(tab: Tab, view: str) -> np.ndarray[Any, Any]:
    """Return the image in the panel for codes, (H, W, 3) uint8."""
    tab.value(f"document.querySelector('input[value={view}]').click()")
    width, height = tab.value("[panels[1].canvas.width, panels[1].canvas.height]")
    data = "panels[1].canvas.getContext('2d').getImageData(0, 0, panels[1].canvas.width, panels[1].canvas.height).data"
    return np.array(tab.value(f"[...{data}]"), np.uint8).reshape(height, width, 4)[..., :3]


@pytest.mark.slow
def test_views(tab: Tab, page: Explorer) -> None:
    white = page.lut.provenance.white_level
    image = page.counts(0, "0", "codes").astype(np.float64)
    with shown(tab, page):
        # The browser rounds halves differently and uses brightness rounded to counts.
        assert np.abs(shades(tab, "counts") - 255 * image / white).max() <= 0.51
        assert np.abs(shades(tab, "camera").astype(int) - flash(image / white)).max() <= 2
        truth = page.lut.white[0]
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


@pytest.mark.slow
def test_browses_and_drops_pictures(tab: Tab, page: Explorer) -> None:
    with shown(tab, page):
        tab.value("document.getElementById('next').click()")
        tab.wait_for(f"shown.picture.name === 'other.png' && {DRAWN}")
        assert tab.value("[panels[1].canvas.width, panels[1].canvas.height]") == [100, 83]
        drop(tab, "mine.png", png(3, 80, 60))
        tab.wait_for(f"shown.picture.name === 'mine.png' && {DRAWN}")
        assert "(3 of 3)" in text_of(tab, "picture-name")
        assert "--sources mine.png" in text_of(tab, "command-codes")
        assert tab.value("[panels[1].canvas.width, panels[1].canvas.height]") == [80, 60]
        tab.value("document.getElementById('next').click()")
        tab.wait_for(f"state.picture === 0 && {DRAWN}")
    with shown(tab, page):
        drop(tab, "letter.txt", b"Dear Sir")
        tab.wait_for("document.getElementById('fault').textContent.includes('letter.txt')")
        assert tab.value("state.picture") == 0
        clear_refused_requests(tab)


@pytest.mark.slow
def test_phone_with_token(tab: Tab, page: Explorer) -> None:
    with shown(tab, page, width=390, dark=True, host="0.0.0.0") as server:
        assert len(server.path) > 20
        drop(tab, "mine.png", png(3, 80, 60))
        tab.wait_for(f"shown.picture.name === 'mine.png' && {DRAWN}")
        assert tab.value(OUTSIDE) == []


@pytest.mark.slow
def test_failed_rendering_is_reported_in_its_panel(tab: Tab, page: Explorer, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = page.counts

    def refused(number: int, light: str, rendering: Any) -> Any:
        if rendering == "colorimetric":
            raise QualityError("the print has no contrast; render by codes")
        return counts(number, light, rendering)

    monkeypatch.setattr(page, "counts", refused)
    with ExploreServer(page, "127.0.0.1", 0) as server:
        threading.Thread(target=lambda: server.serve_forever(0.01), daemon=True).start()
        tab.open(f"http://127.0.0.1:{server.port}/")
        tab.wait_for("typeof panels !== 'undefined' && panels[0]?.wait.textContent.includes('no contrast')")
        tab.wait_for("panels[1].drawn === '0 1'")
        assert tab.value("[panels[0].screen.hidden, panels[1].screen.hidden]") == [True, False]
        network = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        tab.call("Network.emulateNetworkConditions", offline=True, **network)
        tab.value("pick(2)")
        tab.wait_for("document.getElementById('fault').textContent.includes('is running')")
        tab.call("Network.emulateNetworkConditions", offline=False, **network)
        tab.open("about:blank")
        server.shutdown()


@pytest.mark.slow
def test_balances_light_without_blue(tab: Tab, page: Explorer) -> None:
    image = page.counts(0, "0", "codes").astype(np.float64)
    with shown(tab, page):
        # Blue of the ground truth is reduced to 1/1000, so balanced values exceed all counts.
        truth = page.lut.white[0] * [1, 1, 1e-3]
        tab.value(f"shown.truth = {json.dumps((truth / truth.sum()).tolist())}")
        expected = flash(image / page.lut.provenance.white_level * truth[1] / truth)
        assert np.abs(shades(tab, "balanced").astype(int) - expected).max() <= 2


@pytest.mark.slow
def test_unreadable_picture_is_reported_and_skipped(tab: Tab, page: Explorer, tmp_path: Path) -> None:
    with shown(tab, page):
        (tmp_path / "pictures" / "other.png").write_bytes(b"no picture")
        tab.value("document.getElementById('next').click()")
        tab.wait_for("document.getElementById('fault').textContent.includes('other.png')")
        tab.value("point([3, 4])")
        tab.wait_for("panels[1].rows.textContent.includes('±')")
        tab.value("document.getElementById('next').click()")
        tab.wait_for("document.getElementById('fault').hidden && state.picture === 0")
        clear_refused_requests(tab)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "dark"), [(390, True), (1280, False)])
def test_layout_contrast_and_labels(tab: Tab, page: Explorer, width: int, dark: bool) -> None:
    with shown(tab, page, width=width, dark=dark):
        tab.value("move([.25, .3])")
        tab.value("point([20, 20])")
        light(tab)
        tab.wait_for("panels.every((panel) => panel.rows.textContent.includes('±'))")
        for script in (TOO_WIDE, POOR_CONTRAST, NAMELESS):
            assert tab.value(script) == []
        assert tab.value("document.documentElement.scrollWidth") <= width
