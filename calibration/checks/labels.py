"""Whether each light's white is what its codes give: a frame that bears another light's name.

The ground truth is measured and holds whatever a light is called; its codes and temperature are not. So whites are held
against codes, with nothing assumed of the projector but smoothness: the light is a sum of functions of the red, the
green and the blue code, and of the lesser of two and of three codes, for a wheel with white, yellow, cyan or magenta
segments adds light where the primaries overlap. The functions are polynomials, fitted on all lights, robustly, so that
a few that do not fit stand out; if most bear wrong names, no such functions exist, and many stand out.

What cannot be told: exchanged neighbours, and names that are exchanged alike for all lights, red for green. The
primaries' own frames are not asked for (`calibration.radiometry.primaries`): they may be the ones that bear wrong
names.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from acquisition.lights.illuminations import Illumination
from calibration.radiometry.fitting import product
from foundation.angles import angles_deg
from foundation.robust import huber_weights, sigma_of

DEGREE = 4
"""Describes a gamma of 1.8 to 2.6, sRGB and an S-shaped curve to a hundredth of a degree of the lights' direction."""

LIGHTS_A_TERM = 3
"""With fewer lights for each coefficient, what is wrong would be fitted."""

_ROUNDS = 15
_LEAST_OTHERS = 0.1
_FLICKER = 1.25
"""Factor by which the lamp may make a light brighter or darker than another of its codes."""

_CERTAIN = 4.0
"""Standard errors of a ground truth that are taken off its angle."""

_Array = npt.NDArray[np.float64]


def angles_off_codes_deg(lights: Sequence[Illumination], white: _Array, errors_deg: _Array) -> _Array | None:
    """Return how far each white's direction is off what its codes give (L,), degrees, beyond four standard errors.

    Parameters
    ----------
    lights
        L lights.
    white
        (L, 3) > 0, their ground truths, the lamp's drift taken out, all exposed alike.
    errors_deg
        (L,) standard error of each white's direction.

    Returns
    -------
    ndarray or None
        None where the lights are too few to tell.
    """
    terms = _terms(np.array([(light.colour.red, light.colour.green, light.colour.blue) for light in lights]))
    if len(lights) < LIGHTS_A_TERM * terms.shape[1]:
        return None
    length = np.linalg.norm(white, axis=1)
    # Each light counts alike, however bright.
    design, seen = terms / length[:, None], white / length[:, None]
    weights = np.ones(len(lights))
    given, aims = seen, seen
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, None]
        rooted = design * root
        inverse: _Array = np.asarray(np.linalg.pinv(rooted), dtype=np.float64)
        given = product(design, inverse @ (aims * root))
        # As seen from the other lights: a primary alone in its corner draws the fit to itself, whatever it shows.
        own = np.einsum("lt,tl->l", rooted, inverse)
        residual = np.linalg.norm(aims - given, axis=1) / np.maximum(1 - own, _LEAST_OTHERS)
        usual = max(sigma_of(residual), 1e-9)
        weights = huber_weights(residual, usual) ** 2
        # A light's brightness is its own: a lamp that flickers by a hundredth would else look like wrong names.
        brightness = (given * seen).sum(axis=1, keepdims=True)
        aims = seen * np.clip(brightness, 1 / _FLICKER, _FLICKER)
    return np.maximum(angles_deg(given, seen) - _CERTAIN * errors_deg, 0)


def _terms(codes: npt.NDArray[np.integer]) -> _Array:
    """Return the basis (L, terms) of codes (L, 3)."""
    overlaps = (0,), (1,), (2,), (0, 1), (1, 2), (0, 2), (0, 1, 2)
    parts: list[_Array] = [(codes[:, channels] / 255).min(axis=1) for channels in overlaps]
    powers = [part**power for part in parts for power in range(1, DEGREE + 1)]
    return np.column_stack([np.ones(len(codes)), *powers])
