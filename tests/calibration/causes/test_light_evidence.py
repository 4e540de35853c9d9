"""What is gathered of primaries that do not add up to white, and of what files state."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from calibration.causes.gathering import name_evidence, sum_evidence
from calibration.causes.rules import COLOUR_WHEEL, MIXED, OTHER_BRIGHTNESS, UNKNOWN, Cause, decide
from calibration.checks.frame_consistency import origin_figures
from calibration.measurements import TableMeasurements
from drivers.raw.rawfile import FrameOrigin
from experiment.session.records import ACCEPTED, FrameRecord

STEADY = np.ones((3, 3))
TO_AND_FRO = np.array([[1, 1, 1], [1.02, 1, 0.98], [1, 1, 1]])
AWAY = np.array([[1, 1, 1], [1.01, 1, 1], [1.02, 1, 1]])


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
        # White's own colour goes two thirds as far.
        ((1.03, 1.0, 1.0), AWAY, UNKNOWN, None),
        ((1.05, 1.0, 1.0), AWAY, OTHER_BRIGHTNESS, 0),
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


@pytest.mark.parametrize(
    ("off_codes", "seen_as", "exchanges", "named", "right"),
    [
        # Light 1 is far from its codes and another's; 2 is as far as is allowed.
        ((0.0, 9.0, 2.0), (-1, 0, 1), [], ["light 1"], False),
        ((0.0, 9.0, 2.0), (-1, -1, -1), [], ["light 1"], True),
        # The fourth and fifth are white frames.
        (None, (-1, -1, -1), [(0, 4)], ["light 0", "white 1"], False),
        ((0.0, 0.0, 9.0), (-1, -1, -1), [(0, 3)], ["light 0", "light 2", "white 0"], False),
    ],
)
def test_lights_that_are_not_what_their_codes_give_are_named(
    off_codes: tuple[float, ...] | None,
    seen_as: tuple[int, ...],
    exchanges: list[tuple[int, int]],
    named: list[str],
    right: bool,
) -> None:
    whites = [SimpleNamespace(record=replace(record(number), kind="white", illumination=None)) for number in range(2)]
    for number, frame in enumerate(whites):
        frame.record = replace(frame.record, file=f"white {number}")
        frame.paper = SimpleNamespace(white=np.ones(3))
        frame.exposure = 0.5
    lights = [SimpleNamespace(record=replace(record(light), file=f"light {light}"), exposure=0.5) for light in range(3)]
    codes = SimpleNamespace(
        exchanges=tuple(SimpleNamespace(one=one, other=other) for one, other in exchanges),
        seen_as=np.array(seen_as),
        off_deg=np.array([0.5, 9.5, 2.5]),
    )
    made: Any = SimpleNamespace(
        frames=[*lights, *whites],
        white_frames=whites,
        session=SimpleNamespace(lights=3),
        lights=SimpleNamespace(codes=codes, off_codes_deg=None if off_codes is None else np.array(off_codes)),
    )
    gathered = name_evidence(made, 2.0)
    assert [one.file for one in gathered.frames] == named
    assert gathered.evidence.off_codes_deg == 9.5
    assert (gathered.evidence.named_right == 0) == (not right)
