"""Shutter times under a projector: whole turns of its colour wheel, and which time to try for a better exposure.

A DLP projector shows its primaries one after another; a frame that catches part of a turn has a colour of its own. With
0.5 ms of jitter the standard deviation of R/G is 7 % at one turn of 1/60 s, 0.24 % at 0.5 s, 0.11 % at 1 s.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from acquisition.config import CameraSettings, ProjectorCable
from foundation.errors import ConfigurationError

MAX_TURN_ERROR = 0.005
"""How far a shutter time may lie from whole turns of the colour wheel, as a share: shutters are no more exact."""

ENGRAVED_S = (
    *(1 / 60, 1 / 50, 1 / 40, 1 / 30, 1 / 25, 1 / 20, 1 / 15, 1 / 13, 1 / 10, 1 / 8, 1 / 6, 1 / 5, 1 / 4),
    *(0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 15.0, 20.0, 25.0, 30.0),
)
"""Shutter times in thirds of a stop as cameras show them, seconds: what is named before a camera can be asked."""

TARGET_LEVEL = 0.75
"""Paper white under white as a share of the sensor's range: below the 0.8 at which a session is sure not to clip."""

GOOD_LEVELS = (0.3, 0.8)
"""Between these shares the exposure is left as it is: a stop and a half of room, and no light of the plan clips."""


def light_period_s(projector: ProjectorCable) -> float:
    """Return the seconds after which the projector's light repeats: a turn of its wheel, else a picture."""
    return 1 / (projector.colour_wheel_hz or projector.refresh_hz)


def holds_whole_turns(shutter_s: float, period_s: float) -> bool:
    """Return whether a shutter time is a whole number of periods, at least one, to `MAX_TURN_ERROR`."""
    turns = shutter_s / period_s
    # A time of one period and a little less may have been written with few digits.
    return round(turns) >= 1 and abs(turns - round(turns)) <= MAX_TURN_ERROR * max(turns, 1)


def require_whole_turns(camera: CameraSettings, projector: ProjectorCable) -> None:
    """Require that an exposure holds whole turns of the colour wheel, or whole pictures where there is no wheel.

    Raises
    ------
    ConfigurationError
        The shutter time is no whole multiple; the message names the nearest that cameras have.
    """
    period = light_period_s(projector)
    shutter = camera.shutter_s
    if holds_whole_turns(shutter, period):
        return
    fitting = [time for time in ENGRAVED_S if holds_whole_turns(time, period)]
    below = max((time for time in fitting if time < shutter), default=None)
    above = min((time for time in fitting if time > shutter), default=None)
    near = " or ".join(f"{time:.4g}" for time in (below, above) if time is not None)
    unit, of, key = "turns", "the colour wheel", "colour_wheel_hz"
    if not projector.colour_wheel_hz:
        unit, of, key = "pictures", "the projector", "refresh_hz"
    raise ConfigurationError(
        f"camera.shutter_s = {shutter:g} is {shutter / period:.2f} {unit} of {of} ({1 / period:g} a second), and a "
        f"frame must hold whole {unit}; set it to {near or f'a multiple of {period:.4g}'} s, better 0.5 s or more, or "
        f"correct lab.projector.{key}"
    )


def better_shutter(level: float, shutter_s: float, offered_s: Iterable[float], period_s: float) -> float | None:
    """Return the shutter time, of those that a camera offers, that exposes paper white best.

    Parameters
    ----------
    level
        Paper white as a share of the sensor's range at `shutter_s`, 0 … 1; 1 is clipped, and the truth may be more.
    shutter_s
        The present shutter time, seconds.
    offered_s
        What the camera offers, seconds.
    period_s
        Of the projector's light; only whole multiples are returned.

    Returns
    -------
    float or None
        The time whose exposure is nearest to `TARGET_LEVEL`, in stops; None where none leads into `GOOD_LEVELS`.
    """
    per_second = max(level, 1e-3) / shutter_s
    low, high = GOOD_LEVELS
    fitting = [time for time in offered_s if low <= time * per_second <= high and holds_whole_turns(time, period_s)]
    return min(fitting, key=lambda time: abs(math.log(time * per_second / TARGET_LEVEL)), default=None)


def exposure_advice(level: float, shutter_s: float, offered_s: Iterable[float], period_s: float) -> str:
    """Return what to change for a better exposure, as a clause of a sentence; empty where it is good.

    Parameters are those of `better_shutter`.
    """
    low, high = GOOD_LEVELS
    if low <= level <= high:
        return ""
    better = better_shutter(level, shutter_s, offered_s, period_s)
    wanted = f"{low:.0%} to {high:.0%} wanted"
    if better is not None:
        return f"{wanted}, try camera.shutter_s = {better:.4g}"
    aperture, speed = ("higher", "lower") if level > high else ("lower", "higher")
    return (
        f"{wanted}, and no shutter time that the camera offers and that is a whole multiple of {period_s:.4g} s, after "
        f"which the projector's light repeats, leads there: set a {aperture} f-number or a {speed} ISO speed"
    )
