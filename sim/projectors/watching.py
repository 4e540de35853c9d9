"""What a projector throws on the chart: the pixels of a real screen, through the lamp of a projector that is asked.

The screen is read as a screenshot program reads it, several times while the shutter is open; codes become light before
they are averaged. A projector that does not answer gives no light; a screen that cannot be read is black. What only the
monitor knows cannot be seen: power saving and gamma ramps act behind the screen's memory.
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

# Pause between two looks at the screen while the shutter is open: about a refresh, so that no window comes and goes
# between two looks that a camera would have seen for more than a few per cent of its exposure.
SAMPLE_S: Final = 0.02

POLL_S: Final = 0.1  # Pause between two questions to the projector

# Pixels across that a picture is averaged to, at most; on an A0 chart that is 2.6 mm, less than a cell.
FINEST_PX: Final = 480

# Light of a lamp that warms up, over its full light: its control port does not tell how far it has come (chosen).
WARMING_SHARE: Final = 0.5

_INSTANT_S: Final = 1e-4  # Time that clocks, which count in whole microseconds, need not tell from none

_ALIKE: Final = 1e-3  # Difference of light below which a picture is called plain: a quarter of a code at the bright end

_PLACE = re.compile(r"(?P<display>[^,]*:\d+(?:\.\d+)?)?(?:,|^)?(?P<region>\d+x\d+\+\d+\+\d+)?")


@dataclass(frozen=True)
class ScreenPlace:
    """Which part of which X screen is projected.

    - `display`: the server, such as ``:1``; None: what DISPLAY names.
    - `region`: x, y, width and height, px; None: the whole screen, whatever its size is.
    """

    display: str | None = None
    region: tuple[int, int, int, int] | None = None

    @classmethod
    def parse(cls, text: str) -> ScreenPlace:
        """Return the place that ``:1``, ``1920x1080+2560+0``, or both with a comma between them name."""
        found = _PLACE.fullmatch(text)
        if not text or found is None:
            raise InputError(
                f"{text!r} is no screen; expected DISPLAY, WIDTHxHEIGHT+X+Y or both, such as :1,640x360+0+0"
            )
        display, region = found["display"], found["region"]
        if region is None:
            return cls(display)
        width, height, x, y = (int(number) for number in re.split(r"[x+]", region))
        return cls(display, (x, y, width, height))


class Screenshots:
    """Pictures of an X screen. Reaches the server when it is first asked, and again after it was gone."""

    def __init__(self, place: ScreenPlace) -> None:
        self._place = place
        self._screen: XScreen | None = None

    def take(self) -> NDArray[np.uint32]:
        """Return what the screen shows: (height, width) uint32, 0xRRGGBB; the next call writes over it."""
        if self._screen is None:
            self._screen = XScreen(self._place.display, keep_awake=False)
        try:
            x, y, width, height = self._place.region or (0, 0, *self._screen.size())
            return self._screen.read(x, y, width, height)
        except DeviceError:
            self.close()
            raise

    def close(self) -> None:
        """Hang up; the next look connects anew."""
        screen, self._screen = self._screen, None
        if screen is not None:
            screen.close()


@dataclass(frozen=True)
class LampState:
    """What a projector says of itself.

    - `share`: of its full light.
    - `frozen`: whether its picture is.
    - `source`: its input; None where it does not say.
    - `trouble`: why it could not be asked, so that it gives no light; empty where it could.
    """

    share: float
    frozen: bool = False
    source: str | None = None
    trouble: str = ""


def ask(projector: PjLinkProjector) -> LampState:
    """Return a projector's state; one that does not answer gives no light."""
    try:
        power = projector.power()
        if power is Power.WARMING:
            return LampState(WARMING_SHARE)
        if power is not Power.ON or projector.muted():
            return LampState(0.0)
    except DeviceError as fault:
        return LampState(0.0, trouble=str(fault))
    frozen, source = False, None
    # Class 1 knows no freeze, and some projectors no input.
    with contextlib.suppress(DeviceError):
        source = projector.input()
    with contextlib.suppress(DeviceError):
        frozen = bool(projector.frozen())
    return LampState(1.0, frozen, source)


@dataclass(frozen=True, eq=False)
class ThrownLight:
    """What reached the chart while the shutter was open.

    - `picture`: (h, w, 3) float32, mean light of each primary, 0 … 1 of the full; (1, 1, 3) where it was plain
      throughout.
    - `lamp`: mean share of the lamp's light.
    """

    picture: NDArray[np.float32]
    lamp: float

    def __str__(self) -> str:
        least, most = self.picture.min(axis=(0, 1)), self.picture.max(axis=(0, 1))
        mean = " ".join(f"{share:.3f}" for share in self.picture.mean(axis=(0, 1)))
        shape = "plain" if float((most - least).max()) < _ALIKE else "not plain"
        return f"{shape} picture, mean light {mean}, lamp {self.lamp:.2f}"


class Beam:
    """A screen's picture, through a projector's lamp; use it in a `with` block, which asks the projector all the time.

    `projector`: what is asked for the lamp; None: a lamp that always burns. `light_of`: returns the light (256,)
    float64, 0 … 1, of the codes 0 … 255.
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
        self._looking = threading.Lock()
        self._ended = threading.Event()
        self._state = LampState(1.0)
        self._wired: str | None = None
        self._held: NDArray[np.float32] | None = None
        self._seen: NDArray[np.float32] = _BLACK
        self._thread = threading.Thread(target=self._ask_on, name="asking the projector", daemon=True)

    def __enter__(self) -> Beam:
        if self._projector is not None:
            self._ask_once(self._projector)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._projector is not None:
            self._thread.join()
            self._projector.close()
        self._pictures.close()

    @property
    def trouble(self) -> str:
        """Why the projector could not be asked when it last was, so that it gives no light; empty where it could."""
        with self._looking:
            return self._state.trouble

    def gather(self, seconds: float, halfway: Callable[[], None] = lambda: None) -> ThrownLight:
        """Return what reaches the chart from now on, for so many seconds; returns when they are over."""
        at = self._clock.monotonic()
        ends, half = at + seconds, at + seconds / 2
        total: NDArray[np.float64] = np.zeros((1, 1, 3))
        lit = 0.0
        while ends - at > _INSTANT_S:
            share, picture = self._thrown()
            self._clock.sleep(min(SAMPLE_S, max(ends - self._clock.monotonic(), 0.0)))
            # A look stands for the time until the next one.
            until = min(self._clock.monotonic(), ends)
            lit += share * (until - at)
            total = _added(total, picture.astype(np.float64) * (share * (until - at)))
            if at < half <= until:
                halfway()
            at = until
        # What is dark has no picture.
        mean = total / lit if lit else total
        return ThrownLight(mean.astype(np.float32), lit / seconds)

    def _thrown(self) -> tuple[float, NDArray[np.float32]]:
        with self._looking:
            state = self._state
            if self._held is not None:
                return state.share, self._held
            if state.source is not None and self._wired is not None and state.source != self._wired:
                return state.share, _BLACK
            return state.share, self._look()

    def _look(self) -> NDArray[np.float32]:
        try:
            self._seen = picture_light(self._pictures.take(), self._light)
        except DeviceError:
            self._seen = _BLACK
        return self._seen

    def _ask_on(self) -> None:
        assert self._projector is not None
        while not self._ended.wait(POLL_S):
            self._ask_once(self._projector)

    def _ask_once(self, projector: PjLinkProjector) -> None:
        state = ask(projector)
        with self._looking:
            self._state = state
            if self._wired is None:
                # The screen hangs at the input that is shown when the projector is first seen lit.
                self._wired = state.source
            if state.frozen:
                self._held = self._seen if self._held is None else self._held
            else:
                self._held = None
                self._look()


_BLACK: Final[NDArray[np.float32]] = np.zeros((1, 1, 3), dtype=np.float32)


def picture_light(pixels: NDArray[np.uint32], light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the light of a screen's pixels, averaged to `FINEST_PX` across at most.

    `pixels`: (height, width) uint32, 0xRRGGBB. `light`: (256,) float32, 0 … 1, of each code. Returns (h, w, 3) float32,
    0 … 1; (1, 1, 3) where all pixels are alike.
    """
    plain = bool((pixels == pixels[0, 0]).all())
    some = pixels[:1, :1] if plain else pixels
    picture = np.stack([light[some >> shift & 255] for shift in (16, 8, 0)], axis=-1)
    height, width = some.shape
    if width <= FINEST_PX:
        return picture
    size = FINEST_PX, max(round(height * FINEST_PX / width), 1)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _added(total: NDArray[np.float64], part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of two pictures; where a change of mode gave them different sizes, in the larger one's."""
    if total.shape != part.shape and (1, 1) not in (total.shape[:2], part.shape[:2]):
        rows, columns = (max(one, other) for one, other in zip(total.shape[:2], part.shape[:2], strict=True))
        total, part = (np.asarray(cv2.resize(one, (columns, rows)), dtype=np.float64) for one in (total, part))
    return total + part
