"""Figures derived from other measurements."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.measurements import GreyMeasurements, LightMeasurements, LinearityMeasurements, TableMeasurements
from calibration.sampling import bleed


def test_tints_use_light_with_most_of_each_channel() -> None:
    white = np.array([[9000.0, 0.0, 0.0], [500.0, 500.0, 500.0]])
    values = np.array([[[90.0, 1.0, 80.0]], [[50.0, 50.0, 50.0]]])
    assert GreyMeasurements(("grey",), values, values).tints_deg(white) == pytest.approx([0], abs=1e-5)
    assert GreyMeasurements((), np.zeros((2, 0, 3)), np.zeros((2, 0, 3))).tints_deg(white).shape == (0,)


def table(whites: list[list[float]], **more: object) -> TableMeasurements:
    """Return a table with white frames, each with its own file."""
    frames = [
        SimpleNamespace(
            record=SimpleNamespace(kind="white", file=f"{number}"), paper=SimpleNamespace(white=np.array(white)),
            shift=SimpleNamespace(length_px=0.1 * number), blur_px=0.5 + 0.1 * number,
        )
        for number, white in enumerate(whites)
    ]  # fmt: skip
    light = SimpleNamespace(kind="light", file="light")
    frames.append(SimpleNamespace(record=light, shift=frames[0].shift, blur_px=0.5))
    measurements = object.__new__(TableMeasurements)
    measurements.__dict__.update({"frames": tuple(frames)} | more)
    return measurements


def test_white_drift_and_scatter() -> None:
    whites = [[100.0, 200, 50], [104.0, 200, 50], [102.0, 206, 50], [102.0, 200, 49]]
    assert table(whites).white_drift == pytest.approx(4 / 102)
    assert table(whites[:1]).white_drift == 0
    sums = np.sum(whites, axis=1)
    deviations = [sums[1] - (sums[0] + sums[2]) / 2, sums[2] - (sums[1] + sums[3]) / 2]
    # A difference from the mean of both neighbours has 1.5 times the variance.
    assert table(whites).white_scatter == pytest.approx(np.sqrt(np.mean(np.square(deviations)) / 1.5) / sums.mean())
    assert table(whites[:3]).white_scatter == pytest.approx(abs(deviations[0]) / np.sqrt(1.5) / sums[:3].mean())
    assert table(whites[:2]).white_scatter == 0.001, "of two it is not known"


def test_dark_light_is_relative_to_white_or_brightest() -> None:
    dark = SimpleNamespace(light=np.array([1.0, -3, 0.5]), lights=[np.array([1.0, 2, 0.5]), np.array([1.5, -4, 0.5])],
                           blacks=())  # fmt: skip
    measurements = table([[100.0, 200, 50], [300.0, 400, 50]], dark_frames=dark)
    assert (measurements.dark_share, measurements.dark_change) == pytest.approx((0.01, 0.02))
    lights = LightMeasurements(
        np.array([[10.0, 20, 5], [30.0, 10, 5]]), np.ones((2, 3)), np.ones((2, 3)), None, np.zeros(2), None, None, None
    )
    alone = object.__new__(TableMeasurements)
    alone.__dict__.update({"frames": (), "dark_frames": dark, "lights": lights})
    assert lights.brightest.tolist() == [30, 10, 5]
    assert (alone.dark_share, alone.dark_change) == pytest.approx((0.3, 0.6))
    dark.light, dark.lights = np.full(3, np.nan), dark.lights[:1]
    assert np.isnan(measurements.dark_share)
    assert np.isnan(measurements.dark_change)


def test_primaries_have_one_full_code() -> None:
    def lights(*codes: tuple[int, int, int]) -> tuple[int, ...]:
        return table([[1.0, 1, 1]], session=SimpleNamespace(codes=codes)).primary_lights

    red, green, blue = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    assert lights(blue, (255, 255, 255), red, green) == (2, 3, 0)
    assert lights(blue, red, (0, 254, 0)) == ()


def test_compares_frames_with_first_registered() -> None:
    registration = SimpleNamespace(cell_px=9.0, blur_px=0.6)
    session = SimpleNamespace(registered_file="1")
    measurements = table([[1.0, 1, 1]] * 4, registration=registration, cells=SimpleNamespace(window=5), session=session)
    assert measurements.registered_frame is measurements.frames[1]
    assert measurements.added_bleed(measurements.frames[3]) == pytest.approx(bleed(9.0, 0.8) - bleed(9.0, 0.6))
    assert measurements.largest_shift_px == pytest.approx(0.3)
    session.registered_file = "gone"
    assert measurements.registered_frame is measurements.frames[0]


def test_exchanged_lights_deviate_by_their_angle() -> None:
    exchanges = (SimpleNamespace(one=1, other=3, angle_deg=5.0), SimpleNamespace(one=2, other=7, angle_deg=1.0))
    codes: Any = SimpleNamespace(off_deg=np.array([0.0, 2, 3, 9]), exchanges=exchanges)
    none = np.zeros((4, 3))
    lights = LightMeasurements(none, none, none, None, np.zeros(4), None, codes, None)
    deviations = lights.off_codes_deg
    assert deviations is not None
    # Light 7 is a white frame.
    assert deviations.tolist() == [0, 5, 3, 9]
    assert lights.lights_off_codes(3.0) == [3, 1]
    assert codes.off_deg.tolist() == [0, 2, 3, 9], "left as it was"


def test_linearity_is_worst_measured_level() -> None:
    deviation = np.array([[np.nan, 0.01, np.nan, np.nan], [np.nan, np.nan, -0.03, np.nan], [np.nan] * 4])
    series = LinearityMeasurements(("a", "b"), np.array([0.05, 0.2, 0.6, 0.9]), deviation)
    assert (series.worst, series.range) == (0.03, (0.2, 0.6))
    assert series.to_json()[1:3] == [(0.2, [0.01, None, None]), (0.6, [None, -0.03, None])]
