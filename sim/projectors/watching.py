"""Light on a simulated chart, calculated from the pixels of a real screen and from the state of a PJLink projector.

During an exposure, screenshots are taken repeatedly, converted to light and averaged. A projector that does not answer
gives no light, and a screen that cannot be read is black. Power saving and gamma tables of the monitor have no effect,
because screenshots do not show them.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.display.x11 import XScreen
from drivers.pjlink import PjLinkProjector
from drivers.projector import Power
from foundation.clock import Clock
from foundation.errors import DeviceError, InputError

# Interval of screenshots during an exposure, s. It is about one frame period of a screen.
SAMPLE_S: Final = 0.02

POLL_S: Final = 0.1  # Interval of queries of the projector, s.

FINEST_PX: Final = 480  # Maximum width of an averaged picture. One pixel is then 2.6 mm on an A0 chart.

# Relative light of a lamp during warm-up. A constant is assumed, because PJLink does not report the progress.
WARMING_SHARE: Final = 0.5

_INSTANT_S: Final = 1e-4  # An exposure ends if less than this time is left, s.

# Largest difference of light in a uniform picture. It is a ninth of the difference between the two highest codes.
_UNIFORM_TOLERANCE: Final = 1e-3

_PLACE = re.compile(r"(?P<display>[^,]*:\d+(?:\.\d+)?)?(?:,|^)?(?P<region>\d+x\d+\+\d+\+\d+)?")


@dataclass(frozen=True)
class ScreenPlace:
    """Projected part of an X screen."""

    display: str | None = None  # X server, such as ``:1``; None for the value of DISPLAY
    region: tuple[int, int, int, int] | None = None  # x, y, width and height, px; None for the whole screen

    @classmethod
    def parse(cls, text: str) -> ScreenPlace:
        """Parse ``:1``, ``1920x1080+2560+0``, or both with a comma."""
        match = _PLACE.fullmatch(text)
        if not text or match is None:
            raise InputError(
                f"the screen is {text!r}, expected DISPLAY, WIDTHxHEIGHT+X+Y or both, such as :1,640x360+0+0; correct "
                "it"
            )
        display, region = match["display"], match["region"]
        if region is None:
            return cls(display)
        width, height, x, y = (int(number) for number in re.split(r"[x+]", region))
        return cls(display, (x, y, width, height))


class Screenshots:
    """Screenshots of an X screen. It connects at the first call, and connects again after a failure."""

    def __init__(self, screen_place: ScreenPlace) -> None:
        self._place = screen_place
        self._screen: XScreen | None = None

    def take(self) -> NDArray[np.uint32]:
        """Return the pixels (height, width) uint32, 0xRRGGBB; the next call overwrites them."""
        if self._screen is None:
            self._screen = XScreen(self._place.display, keep_awake=False)
        try:
            x, y, width, height = self._place.region or (0, 0, *self._screen.size())
            return self._screen.read(x, y, width, height)
        except DeviceError:
            self.close()
            raise

    def close(self) -> None:
        """Disconnect; the next call connects again."""
        screen, self._screen = self._screen, None
        if screen is not None:
            screen.close()


@dataclass(frozen=True)
class LampState:
    """Reported state of a projector."""

    share: float  # Relative light output
    frozen: bool = False  # Whether the picture is frozen
    source: str | None = None  # Selected input; None if not reported
    trouble: str = ""  # Reason why the projector did not answer; empty if it answered


def lamp_state(projector: PjLinkProjector) -> LampState:
    """Return the state of a projector; without an answer, its light is 0."""
    try:
        power = projector.power()
        if power is Power.WARMING:
            return LampState(WARMING_SHARE)
        if power is not Power.ON or projector.muted():
            return LampState(0.0)
    except DeviceError as fault:
        return LampState(0.0, trouble=str(fault))
    frozen, source = False, None
    # PJLink class 1 has no freeze, and some projectors do not report their input.
    with contextlib.suppress(DeviceError):
        source = projector.input()
    with contextlib.suppress(DeviceError):
        frozen = bool(projector.frozen())
    return LampState(1.0, frozen, source)


@dataclass(frozen=True, eq=False)
class ProjectedLight:
    """Light on the chart during an exposure."""

    picture: NDArray[np.float32]  # (h, w, 3) float32, mean light of each primary, 0 to 1; (1, 1, 3) if always uniform
    lamp: float  # Mean relative light of the lamp

    def __str__(self) -> str:
        minimum, maximum = self.picture.min(axis=(0, 1)), self.picture.max(axis=(0, 1))
        mean = " ".join(f"{share:.3f}" for share in self.picture.mean(axis=(0, 1)))
        shape = "plain" if float((maximum - minimum).max()) < _UNIFORM_TOLERANCE else "not plain"
        return f"{shape} picture, mean light {mean}, lamp {self.lamp:.2f}"


class Beam:
    """Picture of a screen, projected by a lamp; in a `with` block, the projector is queried continuously.

    If `projector` is None, the lamp is always on. `light_of` converts the codes 0 to 255 to light, (256,) float64, 0 to
    1.
    """

    def __init__(
        self,
        pictures: Screenshots,
        projector: PjLinkProjector | None,
        light_of: Callable[[NDArray[np.int64]], NDArray[np.float64]],
        clock: Clock,
    ) -> None:
        self._pictures = pictures
        self._projector = projector
        self._light = light_of(np.arange(256)).astype(np.float32)
        self._clock = clock
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._state = LampState(1.0)
        self._screen_input: str | None = None
        self._frozen_picture: NDArray[np.float32] | None = None
        self._last_picture: NDArray[np.float32] = _BLACK
        self._thread = threading.Thread(target=self._poll, name="projector queries", daemon=True)

    def __enter__(self) -> Beam:
        if self._projector is not None:
            self._poll_once(self._projector)
            self._thread.start()
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._projector is not None:
            self._thread.join()
            self._projector.close()
        self._pictures.close()

    @property
    def trouble(self) -> str:
        """Reason why the projector did not answer the last query; empty if it answered."""
        with self._lock:
            return self._state.trouble

    def measure_exposure(self, seconds: float, halfway: Callable[[], None] = lambda: None) -> ProjectedLight:
        """Wait for the exposure time, and return the light on the chart during it; call `halfway` in the middle."""
        at = self._clock.monotonic()
        ends, half = at + seconds, at + seconds / 2
        total: NDArray[np.float64] = np.zeros((1, 1, 3))
        lit = 0.0
        while ends - at > _INSTANT_S:
            share, picture = self._current_light()
            self._clock.sleep(min(SAMPLE_S, max(ends - self._clock.monotonic(), 0.0)))
            # A picture represents the time until the next picture.
            end = min(self._clock.monotonic(), ends)
            lit += share * (end - at)
            total = _sum(total, picture.astype(np.float64) * (share * (end - at)))
            if at < half <= end:
                halfway()
            at = end
        # Without light the mean is undefined, so the picture is black.
        mean = total / lit if lit else total
        return ProjectedLight(mean.astype(np.float32), lit / seconds)

    def _current_light(self) -> tuple[float, NDArray[np.float32]]:
        with self._lock:
            state = self._state
            if self._frozen_picture is not None:
                return state.share, self._frozen_picture
            if state.source is not None and self._screen_input is not None and state.source != self._screen_input:
                return state.share, _BLACK
            return state.share, self._read_screen()

    def _read_screen(self) -> NDArray[np.float32]:
        try:
            self._last_picture = picture_light(self._pictures.take(), self._light)
        except DeviceError:
            self._last_picture = _BLACK
        return self._last_picture

    def _poll(self) -> None:
        assert self._projector is not None
        while not self._ended.wait(POLL_S):
            self._poll_once(self._projector)

    def _poll_once(self, projector: PjLinkProjector) -> None:
        state = lamp_state(projector)
        with self._lock:
            self._state = state
            if self._screen_input is None:
                # The screen is assumed to be connected to the first input that the projector reports.
                self._screen_input = state.source
            if state.frozen:
                self._frozen_picture = self._last_picture if self._frozen_picture is None else self._frozen_picture
            else:
                self._frozen_picture = None
                self._read_screen()


_BLACK: Final[NDArray[np.float32]] = np.zeros((1, 1, 3), dtype=np.float32)


def picture_light(pixels: NDArray[np.uint32], light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the light of the pixels of a screen, averaged to a width of `FINEST_PX` or less.

    `pixels`: (height, width) uint32, 0xRRGGBB. `light`: (256,) float32, 0 to 1, of each code. Returns (h, w, 3)
    float32, 0 to 1; (1, 1, 3) if all pixels are equal.
    """
    is_plain = bool((pixels == pixels[0, 0]).all())
    region = pixels[:1, :1] if is_plain else pixels
    picture = np.stack([light[region >> shift & 255] for shift in (16, 8, 0)], axis=-1)
    height, width = region.shape
    if width <= FINEST_PX:
        return picture
    size = FINEST_PX, max(round(height * FINEST_PX / width), 1)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _sum(total: NDArray[np.float64], addend: NDArray[np.float64]) -> NDArray[np.float64]:
    # The size may change with the mode of the screen; the larger size is used.
    if total.shape != addend.shape and (1, 1) not in (total.shape[:2], addend.shape[:2]):
        rows, columns = (max(sizes) for sizes in zip(total.shape[:2], addend.shape[:2], strict=True))
        total, addend = (np.asarray(cv2.resize(p, (columns, rows)), dtype=np.float64) for p in (total, addend))
    return total + addend
