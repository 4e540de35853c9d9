"""Full-screen presenter on X servers without a monitor, checked with independent screenshots."""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from drivers.display import fullscreen
from drivers.display.fullscreen import (
    Display,
    FullScreen,
    choose_display,
    display_warnings,
    identify_displays,
    list_displays,
)
from drivers.display.x11 import XScreen, is_dark
from drivers.presenter import BLACK, WHITE, Colour
from experiment.lights import plan_illuminants
from foundation.clock import SimulatedClock
from foundation.errors import ConfigurationError, DeviceError, DeviceRefused
from tests.contracts.presenter import Bench, PresenterContract
from tests.drivers.display.x_servers import Picture, VirtualScreen, screenshot, two_outputs, virtual_screen

pytestmark = pytest.mark.slow

PATIENCE_S = 20.0
"""For what must come; nothing waits this long unless it fails."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualScreen]:
    with virtual_screen(tmp_path_factory.mktemp("xvfb"), "640x360") as screen:
        yield screen


@pytest.fixture
def virtual(server: VirtualScreen, monkeypatch: pytest.MonkeyPatch) -> VirtualScreen:
    monkeypatch.setenv("DISPLAY", server.display)
    return server


@pytest.fixture(scope="module")
def xorg(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with two_outputs(tmp_path_factory.mktemp("xorg")) as display:
        yield display


@pytest.fixture
def outputs(xorg: str, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("DISPLAY", xorg)
    return xorg


@pytest.fixture
def screen(virtual: VirtualScreen) -> Iterator[FullScreen]:
    presenter = FullScreen()
    yield presenter
    presenter.close()


def plain(picture: Picture) -> Colour:
    """Return the only colour of an image."""
    code = int(picture[0, 0])
    assert np.all(picture == code)
    return Colour(code >> 16, code >> 8 & 255, code & 255)


class TestFullScreen(PresenterContract):
    @pytest.fixture
    def bench(self, screen: FullScreen, virtual: VirtualScreen) -> Bench:
        return Bench(screen, lambda: plain(virtual.picture()))


def test_reports_a_pop_up_by_name(screen: FullScreen, virtual: VirtualScreen) -> None:
    colour = Colour(255, 136, 0)
    screen.show(colour)
    screen.verify(colour)
    with messaging(virtual, "Low battery"):
        for use in (screen.verify, screen.show):
            with pytest.raises(DeviceError, match=r"“Low battery” \(Xmessage\)"):
                use(colour)
        picture = virtual.picture()
        assert np.count_nonzero(picture != 0xFF8800) > 100
    # The covered area stays wrong until it is painted again.
    until(lambda: "in front of it" not in covered(screen, colour))
    screen.show(colour)
    screen.verify(colour)


@contextlib.contextmanager
def window_manager() -> Generator[None]:
    openbox = shutil.which("openbox")
    if openbox is None:
        pytest.skip("openbox is not installed (Debian: openbox)")
    with running([openbox, "--sm-disable"]):
        until(lambda: "_NET_SUPPORTING_WM_CHECK" in properties())
        yield


def test_reports_a_framed_pop_up_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    colour = Colour(3, 99, 7)
    with virtual_screen(tmp_path, "640x360") as server:
        monkeypatch.setenv("DISPLAY", server.display)
        with window_manager(), contextlib.closing(FullScreen()) as presenter:
            presenter.show(colour)
            presenter.verify(colour)
            with messaging(server, "Updates are ready"):
                # It may be visible before it has its frame, and covered by our window until it is raised.
                until(lambda: "“Updates are ready” (Xmessage)" in covered(presenter, colour))
            until(lambda: shows(presenter, colour))
            presenter.verify(colour)


def test_fills_the_selected_display_under_a_window_manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    colour = Colour(3, 99, 7)
    with two_outputs(tmp_path) as server:
        monkeypatch.setenv("DISPLAY", server)
        with window_manager():
            for place in ("right", "left"):
                with contextlib.closing(FullScreen(place)) as presenter:
                    presenter.show(colour)
                    seen = screenshot(server, 1120, 360)
                    assert plain(seen[:270, 640:] if place == "right" else seen[:, :640]) == colour
                    assert np.count_nonzero(seen == seen[0, 640 if place == "right" else 0]) <= 640 * 360


def test_detects_a_changed_corner(screen: FullScreen, virtual: VirtualScreen) -> None:
    colour = Colour(10, 20, 30)
    screen.show(colour)
    with messaging(virtual, "speck", "+639+359"):
        message = covered(screen, colour)
    assert "in 1 of 230400 pixels" in message
    assert "within 1×1 px at +639+359; “speck” (Xmessage), " in message


def test_detects_another_colour_without_a_covering_window(screen: FullScreen) -> None:
    screen.show(Colour(10, 20, 30))
    with pytest.raises(DeviceError, match=r"\(10, 20, 30\).*\(10, 20, 31\) in 230400.*window"):
        screen.verify(Colour(10, 20, 31))


@contextlib.contextmanager
def running(command: list[str]) -> Generator[subprocess.Popen[bytes]]:
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()


@contextlib.contextmanager
def messaging(server: VirtualScreen, title: str, place: str = "+100+80") -> Generator[None]:
    """Show a window of another program in front; yield when it is visible."""
    program = shutil.which("xmessage")
    if program is None:
        pytest.skip("xmessage is not installed (Debian: x11-utils)")
    before = server.picture()
    with running([program, "-title", title, "-geometry", place, "look"]):
        until(lambda: not np.array_equal(server.picture(), before))
        yield


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "the condition was not met in time"
        time.sleep(0.005)


def covered(presenter: FullScreen, colour: Colour) -> str:
    """Return the error text of `verify`; empty without an error."""
    try:
        presenter.verify(colour)
    except DeviceError as error:
        return str(error)
    return ""


def properties() -> str:
    return subprocess.run(["xprop", "-root"], capture_output=True, text=True, check=True).stdout


def test_detects_pixels_that_opengl_did_not_draw(screen: FullScreen, virtual: VirtualScreen) -> None:
    import glfw

    prototype: Any = ctypes.CFUNCTYPE
    mask = prototype(None, *[ctypes.c_ubyte] * 4)(glfw.get_proc_address("glColorMask"))
    screen.show(Colour(1, 2, 3))
    mask(1, 0, 1, 1)
    with pytest.raises(
        DeviceError, match=r"OpenGL drew \(9, \d+, 9\) instead of \(9, 9, 9\) in 230400 of 230400 pixels"
    ):
        screen.show(Colour(9, 9, 9))
    mask(1, 1, 1, 1)
    screen.show(Colour(9, 9, 9))
    assert plain(virtual.picture()) == Colour(9, 9, 9)


def test_detects_a_disconnected_display(outputs: str) -> None:
    xrandr = shutil.which("xrandr")
    if xrandr is None:
        pytest.skip("xrandr is not installed (Debian: x11-xserver-utils)")
    presenter = FullScreen("right")
    try:
        presenter.show(WHITE)
        subprocess.run([xrandr, "--output", "DUMMY1", "--off"], check=True)
        for use in (presenter.show, presenter.verify):
            with pytest.raises(
                DeviceError, match=r"does not fill display 2: DUMMY1.*present displays: 1: DUMMY0|no area of 480"
            ):
                use(Colour(9, 9, 9))
        subprocess.run([xrandr, "--output", "DUMMY1", "--mode", "480x270", "--right-of", "DUMMY0"], check=True)
        until(lambda: shows(presenter, Colour(9, 9, 9)))
        presenter.verify(Colour(9, 9, 9))
        assert plain(screenshot(outputs, 1120, 360)[:270, 640:]) == Colour(9, 9, 9)
    finally:
        presenter.close()
        subprocess.run([xrandr, "--output", "DUMMY1", "--mode", "480x270", "--right-of", "DUMMY0"], check=True)
    with contextlib.closing(FullScreen("right")) as presenter:
        presenter.show(WHITE)


def shows(presenter: FullScreen, colour: Colour) -> bool:
    """Return whether a presenter can show a colour."""
    try:
        presenter.show(colour)
    except DeviceError:
        return False
    return True


def test_restores_a_moved_window(screen: FullScreen, virtual: VirtualScreen) -> None:
    import glfw

    glfw.set_window_monitor(glfw.get_current_context(), cast("Any", None), 10, 10, 300, 200, 0)
    with pytest.raises(DeviceError, match="display 1: screen 640×360"):
        screen.verify(BLACK)
    screen.show(WHITE)
    assert plain(virtual.picture()) == WHITE


def test_detects_a_display_in_power_saving(screen: FullScreen, monkeypatch: pytest.MonkeyPatch) -> None:
    # Servers without a monitor have no power saving, so only its absence can be tested.
    asked: list[bool] = []
    monkeypatch.setattr(fullscreen, "is_dark", lambda display: asked.append(is_dark(display)))  # pyrefly: ignore[implicit-any-lambda]
    screen.show(WHITE)
    assert asked == [False]
    monkeypatch.setattr(fullscreen, "is_dark", lambda display: True)  # pyrefly: ignore[implicit-any-lambda]
    for use in (screen.show, screen.verify):
        with pytest.raises(DeviceError, match=r"power saving.*640×360.*dark"):
            use(WHITE)


def test_refuses_calls_from_another_thread(screen: FullScreen, virtual: VirtualScreen) -> None:
    caught: list[str] = []

    def stray() -> None:
        try:
            screen.show(WHITE)
        except DeviceError as error:
            caught.append(str(error))

    thread = threading.Thread(target=stray)
    thread.start()
    thread.join()
    assert len(caught) == 1
    assert "thread" in caught[0]
    assert plain(virtual.picture()) == BLACK


def test_window_disappears_with_a_killed_process(virtual: VirtualScreen) -> None:
    program = (
        "from drivers.display.fullscreen import FullScreen; from drivers.presenter import Colour\n"
        "screen = FullScreen(); screen.show(Colour(250, 240, 230)); print('lit', flush=True); input()"
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"lit\n"
        assert plain(virtual.picture()) == Colour(250, 240, 230)
        process.kill()
    deadline = time.monotonic() + PATIENCE_S
    # During painting the image may have two colours.
    while np.any(virtual.picture()):
        assert time.monotonic() < deadline, "the window is still there"
    assert plain(virtual.picture()) == BLACK


def test_refuses_a_display_in_use_by_another_process(virtual: VirtualScreen) -> None:
    program = (
        "from drivers.display.fullscreen import FullScreen; from drivers.presenter import Colour\n"
        "screen = FullScreen(); screen.show(Colour(250, 240, 230)); print('lit', flush=True); input(); screen.close()"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"lit\n"
        for ask in (FullScreen, display_warnings, lambda: identify_displays(0.0)):
            with pytest.raises(DeviceRefused, match=f"process {process.pid}"):
                ask()
            assert plain(virtual.picture()) == Colour(250, 240, 230)
        process.communicate(b"\n")


def test_process_survives_the_end_of_the_server(tmp_path: Path) -> None:
    program = (
        "from foundation.errors import DeviceError; from drivers.display.fullscreen import FullScreen\nfrom "
        "drivers.presenter import WHITE\nscreen = FullScreen(); screen.show(WHITE); print('lit', flush=True); "
        "input()\nfor _ in range(2):\n    try: screen.show(WHITE)\n    except DeviceError as error: print(error, "
        "flush=True)\nscreen.close()"
    )
    with contextlib.ExitStack() as served:
        server = served.enter_context(virtual_screen(tmp_path, "320x200"))
        process = served.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env={**os.environ, "DISPLAY": server.display},
            )
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "lit\n"
        server.end()
        output, _ = process.communicate("\n", timeout=PATIENCE_S)
    assert process.returncode == 0
    assert output.count("the X server of display 1: screen 320×200 at +0+0, 0 Hz has ended (logout or crash)") == 2


def test_shows_all_codes_in_every_pixel_without_a_cursor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lights = [light.colour for light in plan_illuminants()]
    assert len(lights) == 707
    codes = [Colour(code, 255 - code, (code * 7) % 256) for code in range(256)]
    with virtual_screen(tmp_path, "160x100", cursor=True) as server:
        monkeypatch.setenv("DISPLAY", server.display)
        with contextlib.closing(FullScreen()) as presenter:
            for colour in lights + codes:
                presenter.show(colour)
                assert plain(server.picture()) == colour


def test_lists_displays_from_left_to_right(outputs: str) -> None:
    desk, projector = list_displays()
    assert (desk.number, desk.name, desk.position, desk.width, desk.height) == (1, "DUMMY0", "+0+0", 640, 360)
    assert (projector.number, projector.name, projector.position) == (2, "DUMMY1", "+640+0")
    assert (projector.width, projector.height) == (480, 270)
    # The pixel clock over the totals of the mode line: 12 MHz / (520 · 290).
    assert projector.refresh_hz == 80


@pytest.mark.parametrize("selection", ["right", 2])
def test_fills_only_the_selected_display(outputs: str, selection: str | int) -> None:
    before = screenshot(outputs, 640, 360)
    with contextlib.closing(FullScreen(selection)) as presenter:
        presenter.show(Colour(12, 200, 77))
        after = screenshot(outputs, 1120, 360)
        assert plain(after[:270, 640:]) == Colour(12, 200, 77)
        assert not np.any(after[270:, 640:] == 0x0CC84D)
        assert np.array_equal(after[:, :640], before)


def test_identifies_displays(outputs: str) -> None:
    class Onlooker(SimulatedClock):
        picture: Picture | None = None

        def sleep(self, seconds: float) -> None:
            super().sleep(seconds)
            self.picture = screenshot(outputs, 1120, 360)

    clock = Onlooker()
    assert [display.number for display in identify_displays(5.0, clock)] == [1, 2]
    assert clock.picture is not None
    # The digit 2 in 3×5 blocks of 38 px, a seventh of the projector's 270 px, rounded down.
    block, left, top = 38, 640 + (480 - 5 * 38) // 2 + 38, (270 - 7 * 38) // 2 + 38
    middles = clock.picture[top + block // 2 : top + 5 * block : block, left + block // 2 : left + 3 * block : block]
    rows = ["".join("#" if pixel == 0xFFFFFF else "." for pixel in row) for row in middles]
    assert rows == ["###", "..#", "###", "#..", "###"]
    assert set(np.unique(clock.picture[:, :640])) == {0, 0xFFFFFF}


def test_reports_a_bent_gamma_ramp(outputs: str) -> None:
    import glfw

    with contextlib.closing(FullScreen("right")) as presenter:
        desk, projector = sorted(glfw.get_monitors(), key=glfw.get_monitor_pos)
        glfw.set_gamma(projector, 1.0)
        assert ramps(presenter) == []
        glfw.set_gamma(desk, 1.2)
        assert ramps(presenter) == []
        glfw.set_gamma(projector, 1.2)
        (warning,) = ramps(presenter)
        # x^(1/1.2) − x is largest where its slope is 0, at x = 1.2^−6 = 0.33, and 0.07 there.
        assert "gamma ramp of DUMMY1 is not straight (red 0.33 becomes 0.40): switch off night light" in warning


def test_ignores_an_uninitialised_gamma_ramp(screen: FullScreen, monkeypatch: pytest.MonkeyPatch) -> None:
    import glfw

    straight = np.linspace(0, 1, 256)
    bend = np.sin(np.pi * straight) / 255
    # Some X servers return uninitialised memory. Drivers end a ramp at 255/256 or at 1; a deviation of two codes is
    # reported, and so are inverted colours.
    noise = np.random.default_rng(1).random(256)
    good, bad = (noise, straight * 255 / 256, straight - bend), (straight - 2 * bend, straight[::-1])
    for ramp in (*good, *bad):
        monkeypatch.setattr(glfw, "get_gamma_ramp", lambda monitor, ramp=ramp: [ramp] * 3)  # pyrefly: ignore[implicit-any-lambda]
        assert len(ramps(screen)) == any(ramp is one for one in bad)


def test_reports_a_colour_profile(outputs: str) -> None:
    if shutil.which("xprop") is None:
        pytest.skip("xprop is not installed: apt-get install x11-utils")
    with contextlib.closing(FullScreen("right")) as presenter:

        def told() -> list[str]:
            return [warning for warning in presenter.warnings() if "profile" in warning]

        def set_profile(name: str) -> None:
            subprocess.run(["xprop", "-root", "-f", name, "8s", "-set", name, "profile"], check=True)

        assert told() == []
        set_profile("_ICC_PROFILE")
        assert told() == [], "it belongs to the other display"
        set_profile("_ICC_PROFILE_1")
        (warning,) = told()
        assert "colour profile is set for DUMMY1" in warning


def test_reports_wayland(screen: FullScreen, monkeypatch: pytest.MonkeyPatch) -> None:
    """Xwayland has its own extension (xwayland-extension, version 23.1)."""
    asked: list[str] = []

    def has(_: XScreen, name: str) -> bool:
        asked.append(name)
        return name == "XWAYLAND"

    assert not [warning for warning in screen.warnings() if "Wayland" in warning]
    monkeypatch.setattr(XScreen, "has_extension", has)
    (warning,) = [warning for warning in screen.warnings() if "Wayland" in warning]
    assert "Xorg" in warning
    assert "XWAYLAND" in asked


def ramps(presenter: FullScreen) -> list[str]:
    return [warning for warning in presenter.warnings() if "gamma" in warning]


def test_suspends_the_screen_saver(virtual: VirtualScreen) -> None:
    screen = XScreen()
    assert screen.stays_awake == (ctypes.util.find_library("xcb-screensaver") is not None)
    assert screen.has_extension("MIT-SCREEN-SAVER")
    assert not screen.has_extension("NO-SUCH-THING")
    screen.close()
    screen.close()
    with pytest.raises(DeviceError):
        screen.read(0, 0, 1, 1)


def test_refuses_to_read_outside_the_screen(virtual: VirtualScreen) -> None:
    screen = XScreen()
    with pytest.raises(DeviceError, match=r"100×100 px at \+600\+0"):
        screen.read(600, 0, 100, 100)
    assert screen.read(0, 0, 100, 100).shape == (100, 100)
    screen.close()


@pytest.mark.skipif(sys.platform != "linux", reason="only there a missing DISPLAY is a missing desktop")
@pytest.mark.parametrize("display", [":4711", ""])
def test_refuses_without_a_desktop(monkeypatch: pytest.MonkeyPatch, display: str) -> None:
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(DeviceError, match=r"desktop.*\(DISPLAY") as caught:
        FullScreen()
    assert "b'" not in str(caught.value)
    with pytest.raises(DeviceError):
        list_displays()


DESK = Display(1, "DP-1", 0, 0, 2560, 1440, 60)
BEAMER = Display(2, "HDMI-1", 2560, 0, 1920, 1080, 60)
ABOVE = Display(2, "DP-1", 0, -1080, 1920, 1080, 60)


@pytest.mark.parametrize(
    ("displays", "selection", "expected"),
    [
        ((DESK,), None, DESK),
        ((DESK, BEAMER), "left", DESK),
        ((DESK, BEAMER), "right", BEAMER),
        ((DESK, BEAMER), "HDMI-1", BEAMER),
        ((DESK, BEAMER), "+2560+0", BEAMER),
        ((DESK, ABOVE), "+0-1080", ABOVE),
        ((DESK, BEAMER), 1, DESK),
        ((DESK, BEAMER), "2", BEAMER),
    ],
)
def test_selects_a_display_by_each_property(
    displays: tuple[Display, ...], selection: str | int | None, expected: Display
) -> None:
    assert choose_display(displays, selection) == expected


@pytest.mark.parametrize(
    ("displays", "selection", "reason"),
    [
        ((DESK, BEAMER), None, "display \\(not set\\): 2 displays match"),
        ((DESK, BEAMER), "HDMI-2", "display 'HDMI-2' is not connected"),
        ((DESK, BEAMER), "+1920+0", "not connected"),
        ((DESK, BEAMER), 3, "display 3 is not connected"),
        ((DESK, ABOVE), "DP-1", "display 'DP-1': 2 displays match, 1 expected"),
        ((DESK,), "right", "two displays side by side"),
        ((DESK, ABOVE), "left", "two displays side by side"),
        ((), None, r"not connected \(present: none\)"),
    ],
)
def test_refuses_an_ambiguous_or_missing_display(
    displays: tuple[Display, ...], selection: str | int | None, reason: str
) -> None:
    with pytest.raises(ConfigurationError, match=reason) as caught:
        choose_display(displays, selection)
    for display in displays:
        assert str(display) in str(caught.value)
