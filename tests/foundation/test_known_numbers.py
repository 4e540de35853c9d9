"""Numbers of colour, of robust weights and of figures, and texts for readers, as they were before."""

from __future__ import annotations

import numpy as np

from foundation.colorimetry import (
    angles_deg,
    decode_srgb,
    encode_srgb,
    linear_srgb,
    observer_cie_1931,
    planck,
    srgb_codes,
    xyz_of,
)
from foundation.robust import biweight, huber_weights, sigma_of
from tests.pinned import Pinned


def test_numbers_of_colour(pinned: Pinned) -> None:
    """To more digits than others, since the two parts of sRGB's curve differ by little where they meet."""
    light = np.array([-0.1, 0, 0.001, 0.0031307, 0.0031308, 0.0031309, 0.04, 0.18, 0.5, 1, 1.5])
    codes = np.array([0, 0.01, 0.0404, 0.04045, 0.0405, 0.25, 0.5, 1, 1.2])
    wavelengths = np.array([300.0, 380, 400.5, 555, 700, 900])
    rng = np.random.default_rng(19)
    one, other = rng.uniform(0, 1, (2, 6, 3))
    found = {
        "encoded": encode_srgb(light),
        "decoded": decode_srgb(codes),
        "codes": srgb_codes(light),
        "angles": [angles_deg(one, other), angles_deg(one, one), angles_deg(one, -one), angles_deg(one[0], other)],
        "planck": [planck(wavelengths, kelvin) * 1e6 for kelvin in (2000.0, 5600.0, 12000.0)],
        "xyz": [xyz_of(wavelengths, power) for power in (np.ones(6), planck(wavelengths, 6500.0))],
        "linear": linear_srgb(one),
        "observer": observer_cie_1931(),
        "weights": [huber_weights(light, 0.02), biweight(light, 0.1), biweight(light, 0.1, 2.0), sigma_of(light)],
    }
    pinned("numbers of colour", found, same=1e-8, nothing=1e-12)
