"""The uncertainty budget of known figures, and the frames that are compared."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.pipeline import table_figures
from calibration.pipeline.table_figures import budget_of
from calibration.radiometry.superposition import Superposition
from calibration.spread.added_light import AddedLight

_Array = npt.NDArray[np.float64]

WHITE = np.array([[1000.0, 2000, 500], [200, 100, 400]])
BRIGHTEST = np.array([1000.0, 2000, 500])
LEVELS = np.array([[0.9, 0.8, 0.5], [0.02, 0.05, 1e-5], [0.1, 0.3, 0.2], [1.2, 0.5, 0.4]])
PLACES = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])


def table(**more: object) -> Any:
    """Return the figures of a table for a budget: two lights and four cells."""

    def uncertainty_px(places: _Array) -> _Array:
        return np.linspace(0.1, 0.4, len(places))

    paper = SimpleNamespace(field=SimpleNamespace(coefficients=[[np.ones(4), np.ones(9)]]))
    result: dict[str, Any] = {
        "frames": tuple(SimpleNamespace(black=np.full((2, 2), level), paper=paper) for level in (100.0, 101.0, 99.0)),
        "lights": SimpleNamespace(
            white=WHITE, white_error=0.001 * WHITE * [[1, 2, 3]], brightest=BRIGHTEST, subtracted=None, additivity=None,
            stray=None,
        ),
        "cells": SimpleNamespace(
            levels=LEVELS, window=5, added=AddedLight(np.full((4, 3), 0.002), np.full((4, 3), 0.001)),
            stains=SimpleNamespace(places_mm=PLACES),
        ),
        "lens": SimpleNamespace(
            measured=True, why_not="", white_covariance=np.diag([1e-6, 2e-6, 3e-6]), cells_error=np.full((4, 3), 0.003)
        ),
        "dark_frames": SimpleNamespace(
            lights=[], light=np.array([10.0, 20, -5]), error=np.array([0.1, 0.2, 0.3])
        ),
        "sensor": SimpleNamespace(
            transfer=SimpleNamespace(response=np.array([0.004, 0.0, 0.001])), superposition=Superposition.usual(4000.0)
        ),
        "registration": SimpleNamespace(blur_px=0.7, cell_px=9.0, uncertainty_px=uncertainty_px),
        "white_scatter": np.array([0.001, 0.002, 0.0]),
    }  # fmt: skip
    return SimpleNamespace(**result | more)


def of(name: str, given: Any = None) -> Any:
    (result,) = [one for one in budget_of(given or table()).components if one.name == name]
    return result


def frame(white: tuple[float, float, float] = (100.0, 200, 50), at_s: float = 0, exposure: float = 0.5) -> Any:
    return SimpleNamespace(
        paper=SimpleNamespace(white=np.array(white), error=np.ones(3)),
        record=SimpleNamespace(taken_at=datetime(2024, 3, 1, tzinfo=UTC) + timedelta(seconds=at_s)),
        origin=SimpleNamespace(exposure=exposure),
    )


def test_scales_frames_to_median_exposure() -> None:
    def factors(*exposures: float) -> list[float]:
        frames = [frame(exposure=one) for one in exposures]
        return table_figures._to_one_exposure(frames).ravel().tolist()

    assert factors(0.5, 0.25, 1.0, 0.0) == [1, 2, 0.5, 1]
    assert factors(0.0, 0.0) == [1, 1]


@pytest.mark.parametrize(
    ("white", "is_drift"),
    [
        ((100.0, 200, 50), True),
        ((114.9, 229.8, 57.45), True),
        ((115.1, 230.2, 57.55), False),
        ((85.1, 170.2, 42.55), True),
        ((84.9, 169.8, 42.45), False),
        # Green 7 % less turns white by 1.8°, 8.5 % by 2.2°.
        ((100.0, 186, 50), True),
        ((100.0, 183, 50), False),
    ],
)
def test_drift_has_limits_of_brightness_and_colour(white: tuple[float, float, float], is_drift: bool) -> None:
    # The median of three is what two of them have.
    frames = [frame(), frame(white), frame()]
    assert table_figures._differ_only_by_drift(frames) is is_drift
    assert table_figures._differ_only_by_drift([frame(white)])


def test_times_start_at_first_white_frame() -> None:
    at, white_at = table_figures._times_s([frame(at_s=10), frame(at_s=60)], [frame(at_s=10), frame(at_s=110)])
    assert (at.tolist(), white_at.tolist()) == ([0, 50], [0, 100])
