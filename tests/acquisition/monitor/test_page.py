"""The page in a browser: a run that is active, pauses and is killed, and its report."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from acquisition.monitor.serving import MonitorServer, open_monitor
from acquisition.monitor.view import write_session_report
from experiment.lights import plan_illuminants
from tests.acquisition.monitor.browser import (
    NAMELESS,
    OUTSIDE,
    POOR_CONTRAST,
    Tab,
    browser_tab,
    needs_chromium,
)
from tests.acquisition.monitor.made_up import LIGHTS, MadeUpRun
from tests.serving import serving

pytestmark = [pytest.mark.slow, needs_chromium]
ROOT = Path(__file__).parents[3]
WEB = ROOT / "acquisition" / "monitor" / "web"
JUDGE_PAGE = ROOT / "docs" / "reference" / "judge.md"
HOSTILE = '<img src=x onerror="window.hacked=1"><script>window.hacked=1</script>\'"&{data}'

KILLED_RUN = """
import sys, time
from pathlib import Path
from tests.acquisition.monitor.made_up import MadeUpRun
run = MadeUpRun.begin(Path(sys.argv[1]))
for step in run.steps[:4]:
    run.take(step)
run.expose(run.steps[4])
print("taken", flush=True)
time.sleep(600)
"""


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    with browser_tab() as opened:
        yield opened


@pytest.fixture(autouse=True)
def _no_errors(tab: Tab) -> Iterator[None]:
    tab.errors.clear()
    yield
    tab.value("1")
    assert tab.errors == []


@pytest.fixture
def run(tmp_path: Path) -> Iterator[MadeUpRun]:
    """Return a run of 27 illuminants with a third of its frames, one refused, and one active."""
    name = f"night {HOSTILE}".replace("/", "|")
    new_run = MadeUpRun.begin(tmp_path / name, plan_illuminants(5, (3000, 6500)), response=True)
    new_run.journal.record(f"camera {HOSTILE}", HOSTILE)
    new_run.journal.note(new_run.clock, "warning", HOSTILE)
    for step in new_run.steps[:28]:
        if step.number == 20:
            new_run.take(step, f"the light is another one {HOSTILE}; close what covers it", value=9.0)
        new_run.take(step)
    new_run.expose(new_run.steps[28])
    yield new_run
    new_run.journal.close()


@contextmanager
def shown(
    tab: Tab, folder: Path, *, width: int = 1280, dark: bool = False, host: str = "127.0.0.1"
) -> Generator[MonitorServer]:
    with serving(open_monitor(folder, 0, host)) as server:
        try:
            tab.open(f"http://127.0.0.1:{server.port}/{server.path}", width=width, dark=dark)
            tab.wait_for("document.readyState === 'complete' && typeof model !== 'undefined' && model.cursor !== ''")
            yield server
        finally:
            tab.open("about:blank")


def marks(tab: Tab, plane: str, state: str) -> int:
    return tab.value(f"document.querySelectorAll('#{plane} .mark.{state}').length")


def test_follows_run_frame_by_frame(tab: Tab, run: MadeUpRun) -> None:
    with shown(tab, run.folder):
        assert tab.value("document.getElementById('state').textContent") == "▶ running"
        lights = sum(step.kind == "light" for step in run.steps[:28])
        assert marks(tab, "planned", "accepted") == lights
        assert marks(tab, "planned", "shown") == 1
        assert marks(tab, "planned", "planned") == 23 - lights - 1
        assert marks(tab, "seen", "accepted") == lights
        run.take(run.steps[29])
        tab.wait_for(f"document.querySelectorAll('#planned .mark.accepted').length === {lights + 1}")
        assert f"illuminants {lights + 1} of 23" in " ".join(tab.text().split())
        assert tab.value("document.querySelectorAll('.plot').length") >= 8
        heads = tab.value("[...document.querySelectorAll('.plot-head')].map((one) => [one.innerText, one.title])")
        assert all(explanation and "_" not in title for title, explanation in heads)
        assert tab.value("document.getElementById('wall').textContent") == "Between two frames"
        assert tab.value("getComputedStyle(document.getElementById('wall-card')).display") != "none"
        following = run.steps[30].colour
        run.expose(run.steps[30])
        codes = f"{following.red} {following.green} {following.blue}"
        tab.wait_for(f"document.querySelector('#wall b')?.textContent === '{codes}'")
        swatch = tab.value("getComputedStyle(document.getElementById('swatch')).backgroundColor")
        assert swatch == f"rgb({codes.replace(' ', ', ')})"
        tab.wait_for("document.getElementById('picture').naturalWidth === 360")
        assert tab.value(OUTSIDE) == []
        assert "NaN" not in tab.value("document.body.innerHTML")
        assert "undefined" not in tab.value("document.querySelector('main').innerHTML")


def test_flat_plots_are_folded_until_opened(tab: Tab, run: MadeUpRun) -> None:
    titles = "[...document.querySelectorAll('.flat .plot-head b')].map((one) => one.textContent)"
    steady = """
        for (const frame of model.frames.values())
          for (const check of frame.checks ?? []) if (check[0] === "blur") check[2] = VALUE;
        drawSeries(inOrder());
    """
    with shown(tab, run.folder):
        tab.value(steady.replace("VALUE", "0.1"))
        assert "Change of focus" in tab.value(titles)
        tab.value("document.querySelector('.flat summary').click()")
        tab.wait_for("flatOpen")
        tab.value("drawSeries(inOrder())")
        assert tab.value("document.querySelector('.flat').open"), "new frames leave it open"
        tab.value(steady.replace("VALUE", "frame.id / 100"))
        assert "Change of focus" not in tab.value(titles)


def test_every_check_has_a_title() -> None:
    checks = re.findall(r"`(\w+)`", "".join(re.findall(r"(?m)^\| (`\w+`(?:, `\w+`)*) \|", JUDGE_PAGE.read_text())))
    assert len(checks) > 15
    script = (WEB / "page.js").read_text()
    assert [name for name in checks if f"  {name}: [" not in script] == []


def test_session_texts_are_never_code(tab: Tab, run: MadeUpRun) -> None:
    run.beat("paused", f"the camera: {HOSTILE}; mend it {HOSTILE}")
    with shown(tab, run.folder):
        tab.wait_for("document.getElementById('state').textContent === '‖ paused'")
        tab.value("choose(21)")
        assert tab.value("window.hacked") is None
        text = tab.text()
        assert text.count("<script>window.hacked=1</script>") >= 6
        assert tab.value("document.querySelectorAll('img[src=x]').length") == 0
    script = "".join(path.read_text() for path in WEB.glob("*.js"))
    for way in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "new Function"):
        assert way not in script


def test_shows_pause_with_remedy_and_countdown(tab: Tab, run: MadeUpRun) -> None:
    fault = "the camera: it does not answer"
    run.beat("paused", f"{fault}; see to its cable (paused for 20 s; goes on by itself, ends in 9 min 40 s)")
    with shown(tab, run.folder):
        tab.wait_for("!document.getElementById('banner').hidden")
        assert tab.value("document.querySelector('#banner-text strong').textContent") == fault
        assert tab.value("document.getElementById('banner-text').lastChild.textContent") == "see to its cable"
        assert "ends in 9 min 40 s" in tab.value("document.getElementById('countdown').textContent")
        assert tab.value("document.title").startswith("‖")
        run.beat("running", "goes on")
        tab.wait_for("document.getElementById('banner').hidden")


def test_reports_killed_run(tab: Tab, tmp_path: Path) -> None:
    folder = tmp_path / "night"
    child = subprocess.Popen([sys.executable, "-c", KILLED_RUN, str(folder)], stdout=subprocess.PIPE, cwd=ROOT)
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == b"taken\n"
        with shown(tab, folder):
            assert tab.value("document.getElementById('state').textContent") == "▶ running"
            assert marks(tab, "planned", "shown") == 1
            child.send_signal(signal.SIGKILL)
            child.wait(30)
            tab.wait_for("document.getElementById('state').textContent === '✕ stopped'")
            banner = tab.value("document.getElementById('banner').innerText")
            assert "killed or power lost" in banner
            assert "run the same command again" in banner
            assert tab.value("document.getElementById('wall').textContent") == "Unknown: no run is active"
            assert "no run active" in tab.text()
            assert marks(tab, "planned", "shown") == 0
    finally:
        child.kill()
        child.wait(30)
        assert child.stdout is not None
        child.stdout.close()


def test_shows_refused_frames_with_picture_and_reason(tab: Tab, run: MadeUpRun) -> None:
    with shown(tab, run.folder):
        card = "document.querySelector('.refusal')"
        assert "the light is another one" in tab.value(f"{card}.innerText")
        assert "repeated and accepted" in tab.value(f"{card}.innerText")
        tab.value(f"{card}.querySelector('button').click()")
        assert tab.value("document.getElementById('frame-title').textContent") == "Chosen frame"
        assert tab.value("document.querySelector('#checks tr.bad th').textContent") == "✕ Colour of the illuminant"


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("state", ["running", "paused"])
def test_text_has_contrast(tab: Tab, run: MadeUpRun, dark: bool, state: str) -> None:
    run.beat(state, "the camera: it does not answer; see to its cable (paused for 20 s)")
    with shown(tab, run.folder, dark=dark):
        assert tab.value(POOR_CONTRAST) == []


def test_is_accessible_to_screen_readers(tab: Tab, run: MadeUpRun) -> None:
    with shown(tab, run.folder):
        assert tab.value(NAMELESS) == []
        assert tab.value("document.documentElement.lang") == "en"
        assert tab.value("document.getElementById('progress').getAttribute('aria-valuetext')") == (
            f"28 of {len(run.steps)} frames"
        )
        run.beat("paused", "the camera is gone; find it")
        tab.wait_for("document.getElementById('said').textContent.includes('paused')")


def test_reports_missing_answers(tab: Tab, run: MadeUpRun) -> None:
    with shown(tab, run.folder):
        assert tab.value("document.getElementById('offline').hidden")
        tab.value("answeredAt -= 60000; drawClock()")
        assert "has not answered since" in tab.value("document.getElementById('offline').innerText")


def test_waits_for_session(tab: Tab, tmp_path: Path) -> None:
    with shown(tab, tmp_path / "later"):
        assert tab.value("document.getElementById('state').textContent") == "… not started"
        assert "waits for it" in tab.value("document.getElementById('banner').innerText")
        for key in ("ArrowLeft", "ArrowRight", "Escape"):
            tab.press(key)
        new_run = MadeUpRun.begin(tmp_path / "later")
        tab.wait_for("document.getElementById('state').textContent === '▶ running'")
        assert marks(tab, "planned", "planned") == len(LIGHTS)
        tab.press("ArrowLeft")
        new_run.take(new_run.steps[0])
        tab.wait_for("document.getElementById('frame-caption').innerText.includes('white frame 0')")
        new_run.journal.close()


def test_serves_phone_with_token(tab: Tab, run: MadeUpRun) -> None:
    with shown(tab, run.folder, width=390, dark=True, host="0.0.0.0") as server:
        assert len(server.path) > 20
        assert marks(tab, "planned", "shown") == 1
        tab.wait_for("document.getElementById('picture').naturalWidth === 360")


def test_report_shows_same_content(tab: Tab, run: MadeUpRun, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_session_report(run.folder, path)
    tab.open(path.as_uri())
    tab.wait_for("document.readyState === 'complete' && document.querySelectorAll('#planned .mark').length > 0")
    assert tab.value("window.hacked") is None
    assert marks(tab, "planned", "accepted") == sum(step.kind == "light" for step in run.steps[:28])
    tab.wait_for("document.getElementById('picture').naturalWidth === 360")
    assert tab.value("document.querySelector('.refusal img').src").startswith("data:image/jpeg")
    times = tab.value("[...document.querySelectorAll('#events td:first-child')].map((one) => one.textContent)")
    assert times
    assert [time for time in times if not re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", time)] == []
    assert re.search(r"at \d{4}-\d\d-\d\d \d\d:\d\d:\d\d: accepted", tab.text())
    assert tab.value("document.getElementById('timings').textContent").endswith("wait 0 s")
    assert tab.value(OUTSIDE) == []
    assert tab.value("document.getElementById('sound').hidden")
    tab.open("about:blank")
