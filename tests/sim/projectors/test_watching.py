"""A watched screen illuminates the chart with its pixels, at their positions and for their time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.links.link import PeerLink
from drivers.pjlink import PjLinkProjector
from drivers.projector import Power
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, DeviceRefused, InputError, LinkClosed
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import ProjectorTraits, SimulatedProjector
from sim.projectors.watching import (
    FINEST_PX,
    SAMPLE_S,
    WARMING_SHARE,
    Beam,
    LampState,
    ScreenPlace,
    Screenshots,
    lamp_state,
    picture_light,
)
from sim.world.world import Room
from tests.drivers.display.x_servers import virtual_screen

WHITE, RED = 0xFFFFFF, 0xFF0000
LINEAR = np.linspace(0, 1, 256, dtype=np.float32)


def light_of(codes: NDArray[np.int64]) -> NDArray[np.float64]:
    return codes / 255


@dataclass
class Shown(Screenshots):
    """A screen whose pixels are a function of time."""

    clock: SimulatedClock
    pixels: Callable[[float], NDArray[np.uint32]]
    looks: list[float] = field(default_factory=list)

    def take(self) -> NDArray[np.uint32]:
        self.looks.append(self.clock.monotonic())
        return self.pixels(self.clock.monotonic())

    def close(self) -> None:
        self.looks.append(-1.0)


def plain(code: int) -> NDArray[np.uint32]:
    return np.full((9, 16), code, dtype=np.uint32)


def thrown(pixels: Callable[[float], NDArray[np.uint32]], seconds: float = 0.5) -> tuple[NDArray[np.float32], float]:
    clock = SimulatedClock()
    with Beam(Shown(clock, pixels), None, light_of, clock) as beam:
        light = beam.measure_exposure(seconds)
    return light.picture, light.lamp


def test_uniform_screen_is_uniform_light() -> None:
    picture, lamp = thrown(lambda at: plain(0x336699))
    np.testing.assert_allclose(picture, [[[0x33 / 255, 0x66 / 255, 0x99 / 255]]], rtol=1e-6)
    assert lamp == pytest.approx(1.0)


def test_window_counts_for_its_share_of_the_exposure() -> None:
    def pixels(at: float) -> NDArray[np.uint32]:
        screen = plain(WHITE)
        if 0.1 <= at < 0.3:
            screen[2:5, 3:9] = RED
        return screen

    picture, _ = thrown(pixels, 0.5)
    expected = np.ones((9, 16, 3))
    expected[2:5, 3:9, 1:] = 0.6
    np.testing.assert_allclose(picture, expected, atol=SAMPLE_S / 0.5)


def test_averages_light_not_codes() -> None:
    clock = SimulatedClock()
    screen = Shown(clock, lambda at: plain(WHITE if at < 0.5 else 0))
    with Beam(screen, None, Room().light_of, clock) as beam:
        picture = beam.measure_exposure(1.0).picture
    np.testing.assert_allclose(picture, 0.5, atol=SAMPLE_S)


def test_ends_in_time_and_reports_the_middle_once() -> None:
    clock = SimulatedClock()
    screen = Shown(clock, lambda at: plain(WHITE))
    halves: list[float] = []
    with Beam(screen, None, light_of, clock) as beam:
        beam.measure_exposure(0.5, lambda: halves.append(clock.monotonic()))
    assert clock.monotonic() == pytest.approx(0.5)
    assert halves == [pytest.approx(0.25, abs=SAMPLE_S)]
    assert screen.looks[-1] == -1.0, "the screen is released"


def test_unreadable_screen_is_black() -> None:
    def pixels(at: float) -> NDArray[np.uint32]:
        if at < 0.25:
            return plain(WHITE)
        raise DeviceError("gone")

    picture, lamp = thrown(pixels)
    np.testing.assert_allclose(picture, 0.5, atol=SAMPLE_S / 0.5)
    assert lamp == pytest.approx(1.0), "the lamp still burns, and leaks"


def test_accepts_a_change_of_mode() -> None:
    def pixels(at: float) -> NDArray[np.uint32]:
        screen = np.full((9, 16) if at < 0.25 else (18, 20), WHITE, dtype=np.uint32)
        screen[0, 0] = 0
        return screen

    picture, _ = thrown(pixels)
    assert picture.shape == (18, 20, 3)
    np.testing.assert_allclose(picture[9:, 10:], 1, atol=1e-6)


def test_averages_large_pictures_in_light() -> None:
    pixels = np.zeros((1080, 1920), dtype=np.uint32)
    pixels[::2] = WHITE
    picture = picture_light(pixels, LINEAR)
    assert picture.shape == (270, FINEST_PX, 3)
    np.testing.assert_allclose(picture, 0.5, atol=1e-6)
    assert picture_light(np.full((1080, 1920), RED, dtype=np.uint32), LINEAR).tolist() == [[[1.0, 0.0, 0.0]]]


@dataclass
class Answers(PjLinkProjector):
    """A projector with given answers; a test changes them and waits for the next query."""

    state: Power = Power.ON
    is_muted: bool = False
    is_frozen: bool | None = False
    source: str | None = "31"
    gone: bool = False
    queries: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    def power(self) -> Power:
        if self.gone:
            raise LinkClosed("nobody there")
        return self.state

    def muted(self) -> bool:
        return self.is_muted

    def input(self) -> str:
        if self.source is None:
            raise DeviceRefused("ERR1")
        return self.source

    def frozen(self) -> bool:
        self.queries.release()
        if self.is_frozen is None:
            raise DeviceRefused("class 1")
        return self.is_frozen

    def close(self) -> None:
        pass

    def await_questions(self) -> None:
        """Wait until the current answers were requested and used."""
        # The first answer may have been under way; the second comes after the first was taken in.
        for _ in range(3):
            self.queries.acquire()


@pytest.mark.parametrize(
    ("answers", "state"),
    [
        (Answers(), LampState(1.0, False, "31")),
        (Answers(is_muted=True), LampState(0.0)),
        (Answers(state=Power.STANDBY), LampState(0.0)),
        (Answers(state=Power.COOLING), LampState(0.0)),
        (Answers(state=Power.WARMING), LampState(WARMING_SHARE)),
        (Answers(gone=True), LampState(0.0, trouble="nobody there")),
        (Answers(is_frozen=None, source=None), LampState(1.0)),
        (Answers(is_frozen=True), LampState(1.0, True, "31")),
    ],
)
def test_light_follows_the_reported_state(answers: Answers, state: LampState) -> None:
    assert lamp_state(answers) == state


@pytest.mark.parametrize("pjlink_class", [1, 2])
def test_queries_projectors_of_both_classes(pjlink_class: int) -> None:
    device = SimulatedProjector(SimulatedClock(), Power.ON, ProjectorTraits(pjlink_class=pjlink_class))
    peer = PjLinkPeer(device)
    projector = PjLinkProjector(lambda: PeerLink(peer))
    assert lamp_state(projector) == LampState(1.0, False, "31")
    device.set_frozen(True)
    assert lamp_state(projector).frozen == (pjlink_class == 2)
    device.set_muted(True)
    assert lamp_state(projector).share == 0


@pytest.mark.slow
def test_frozen_picture_stays_and_other_input_is_black() -> None:
    clock, answers = SimulatedClock(), Answers()
    codes = [RED]
    with Beam(Shown(clock, lambda at: plain(codes[0])), answers, light_of, clock) as beam:

        def seen() -> list[float]:
            answers.await_questions()
            return beam.measure_exposure(0.1).picture[0, 0].tolist()

        assert seen() == [1.0, 0.0, 0.0]
        answers.is_frozen = True
        assert seen() == [1.0, 0.0, 0.0]
        codes[0] = WHITE
        assert seen() == [1.0, 0.0, 0.0]
        answers.is_frozen = False
        assert seen() == [1.0, 1.0, 1.0]
        answers.source = "32"
        assert seen() == [0.0, 0.0, 0.0]
        answers.source = "31"
        assert seen() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("text", ["", "1", ":", "640x360", ":1,640x360", ":1;640x360+0+0", "HDMI-1"])
def test_refuses_wrong_screen_names(text: str) -> None:
    with pytest.raises(InputError, match="DISPLAY"):
        ScreenPlace.parse(text)


def test_screenshots_reconnect_to_the_server(tmp_path: Path) -> None:
    with virtual_screen(tmp_path, "64x48", cursor=True) as server:
        full_screen = Screenshots(ScreenPlace(server.display))
        region = Screenshots(ScreenPlace(server.display, (8, 4, 20, 10)))
        outside = Screenshots(ScreenPlace(server.display, (60, 4, 20, 10)))
        picture = server.picture()
        np.testing.assert_array_equal(full_screen.take()[:20, :20], picture[:20, :20])
        assert full_screen.take().shape == (48, 64)
        np.testing.assert_array_equal(region.take(), picture[4:14, 8:28])
        with pytest.raises(DeviceError, match="no area of 20×10 px"):
            outside.take()
        server.end()
        with pytest.raises(DeviceError):
            full_screen.take()
        with pytest.raises(DeviceError, match=f"check {server.display}"):
            full_screen.take()
