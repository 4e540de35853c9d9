"""A lens fitted to places known on both sides."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.registration.lens import fit_lens


def test_the_lens_is_found_exactly_without_noise() -> None:
    points = np.stack(np.meshgrid(np.linspace(0, 1189, 8), np.linspace(0, 841, 6)), axis=-1).reshape(-1, 2)
    x, y = ((points - (594, 420)) / 1500 * 2).T
    r2 = x * x + y * y
    radial = 1 - 0.04 * r2 + 0.02 * r2**2
    bent = np.stack([x * radial + 3e-4 * x * y, y * radial + 1.5e-4 * (r2 + 2 * y * y)], axis=-1)
    places = bent * 1500 + (1300, 866)
    lens, residual = fit_lens(points, places, (2601, 1733))
    assert np.abs(residual).max() < 0.02
    assert lens.to_pixels(points) == pytest.approx(places, abs=0.02)
