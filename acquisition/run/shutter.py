"""Shutter times under a projector: whole turns of its colour wheel.

A DLP projector shows its primaries one after another; a frame that catches part of a turn has a colour of its own. With
0.5 ms of jitter the standard deviation of R/G is 7 % at one turn of 1/60 s, 0.24 % at 0.5 s, 0.11 % at 1 s.
"""

from __future__ import annotations

from experiment.config import CameraSettings, LabSettings, ProjectorCable
from foundation.errors import ConfigurationError

MAX_TURN_ERROR = 0.005
"""How far a shutter time may lie from whole turns of the colour wheel, as a share: shutters are no more exact."""

ENGRAVED_S = (
    *(1 / 60, 1 / 50, 1 / 40, 1 / 30, 1 / 25, 1 / 20, 1 / 15, 1 / 13, 1 / 10, 1 / 8, 1 / 6, 1 / 5, 1 / 4),
    *(0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 15.0, 20.0, 25.0, 30.0),
)
"""Shutter times in thirds of a stop as cameras show them, seconds: what is named before a camera can be asked."""


def light_period_s(projector: ProjectorCable) -> float:
    """Return the seconds after which the projector's light repeats: a turn of its wheel, else a picture."""
    return 1 / (projector.colour_wheel_hz or projector.refresh_hz)


def wheel_of(settings: LabSettings) -> float:
    """Return the turns a second of the colour wheel before the camera; 0 where there is none, or it is not known."""
    if settings.rig == "simulated":
        return float(settings.simulated.room.get("wheel_hz", 0))
    return settings.lab.projector.colour_wheel_hz or 0.0 if settings.rig == "lab" else 0.0


def period_s(settings: LabSettings) -> float:
    """Return the seconds after which the light before the camera repeats: a turn of its wheel, or a picture."""
    wheel_hz = wheel_of(settings)
    return 1 / wheel_hz if wheel_hz else light_period_s(settings.lab.projector)


def holds_whole_turns(shutter_s: float, period_s: float) -> bool:
    """Return whether a shutter time is a whole number of periods, at least one, to `MAX_TURN_ERROR`."""
    turns = shutter_s / period_s
    # A time of one period and a little less may have been written with few digits.
    return round(turns) >= 1 and abs(turns - round(turns)) <= MAX_TURN_ERROR * max(turns, 1)


def require_whole_turns(camera: CameraSettings, projector: ProjectorCable) -> None:
    """Require that an exposure holds whole turns of the colour wheel, or whole pictures where there is no wheel."""
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
        f"frame must hold whole {unit}",
        remedy=f"set it to {near or f'a multiple of {period:.4g}'} s, better 0.5 s or more, or correct "
        f"lab.projector.{key}",
        value=shutter,
        expected=(below, above),
    )
