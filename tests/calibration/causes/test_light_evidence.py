"""What is gathered of primaries that do not add up to white, and of what files state."""

from __future__ import annotations

from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from calibration.causes.gathering import sum_evidence
from calibration.causes.rules import COLOUR_WHEEL, MIXED, OTHER_BRIGHTNESS, UNKNOWN, Cause, decide
from calibration.checks.frame_consistency import origin_figures
from calibration.measurements import TableMeasurements
from drivers.raw.rawfile import FrameOrigin
from experiment.session.records import ACCEPTED, FrameRecord

STEADY = np.ones((3, 3))
TO_AND_FRO = np.array([[1, 1, 1], [1.02, 1, 0.98], [1, 1, 1]])


def record(light: int) -> FrameRecord:
    """Return a light's record."""
    at = datetime(2024, 3, 1, tzinfo=UTC)
    return FrameRecord("light", light, f"frames/{light}.dng", f"{light}", at, 0.5, ACCEPTED, light)


def table(off: tuple[float, float, float], white: np.ndarray[Any, Any] = STEADY) -> TableMeasurements:
    """Return of a table what the primaries' evidence is gathered from: full white has `off` of red, green and blue."""
    frames = [SimpleNamespace(record=record(light), exposure=0.5) for light in range(3)]
    whites = [SimpleNamespace(paper=SimpleNamespace(white=1000 * row)) for row in white]
    lights = SimpleNamespace(additivity=SimpleNamespace(amounts=np.array(off)))
    made = SimpleNamespace(frames=frames, white_frames=whites, lights=lights, primary_lights=(0, 1, 2))
    return cast("TableMeasurements", made)


@pytest.mark.parametrize(
    ("off", "white", "cause", "light"),
    [
        # A tenth of the light lacks in the frame of red, or is too much in that of blue.
        ((1.11, 1.0, 1.0), STEADY, OTHER_BRIGHTNESS, 0),
        ((1.0, 1.002, 0.91), STEADY, OTHER_BRIGHTNESS, 2),
        # A twentieth of blue stands for as much of red in the frame of red; the lamp has 1 % more in white.
        ((1.063, 1.01, 0.957), STEADY, MIXED, 0),
        ((0.95, 1.05, 1.0), STEADY, MIXED, 1),
        # Three primaries that differ in no such way.
        ((1.05, 1.0, 0.98), STEADY, UNKNOWN, None),
        ((1.0, 1.0, 1.0), STEADY, UNKNOWN, None),
        # White itself differs by as much.
        ((1.03, 1.0, 1.0), TO_AND_FRO, COLOUR_WHEEL, None),
        ((1.03, 1.0, 0.97), TO_AND_FRO, COLOUR_WHEEL, None),
    ],
)
def test_a_primary_s_frame_is_told_by_how_white_differs(
    off: tuple[float, float, float], white: np.ndarray[Any, Any], cause: Cause, light: int | None
) -> None:
    gathered = sum_evidence(table(off, white), 0.02)
    assert decide("sum", gathered.evidence).cause is cause
    if light is not None:
        assert [one.illumination for one in gathered.frames] == [light]


@pytest.mark.parametrize(
    ("speeds", "asked", "others"),
    [
        ((200, 200, 200), 100, [0, 1, 2]),
        ((200, 200, 200), None, []),
        ((100, 100, 200), 100, [2]),
        ((100, 200, 200), None, [0]),
        # A file that states none is no other.
        ((100, None, 100), 100, []),
    ],
)
def test_frames_of_another_iso_speed_are_held_against_the_settings(
    speeds: tuple[int | None, ...], asked: int | None, others: list[int]
) -> None:
    frames = [(record(number), FrameOrigin(iso=iso)) for number, iso in enumerate(speeds)]
    assert [one.record.illumination for one in origin_figures(frames, asked).other_iso] == others
