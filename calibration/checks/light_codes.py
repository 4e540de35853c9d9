"""Whether each light's white is what its codes give: a frame that bears another light's name.

The ground truth is measured and stays true whatever a light is called; its codes and temperature do not. So whites are
compared with codes, with nothing assumed of the projector but smoothness: the light is a sum of functions of the red,
the green and the blue code, and of the lesser of two and of three codes, for a wheel with white, yellow, cyan or
magenta segments adds light where the primaries overlap. The functions are polynomials, fitted on all lights, robustly,
so that a few that do not fit are outliers; if most bear wrong names, no such functions exist, and there are many.

Not detected are exchanged neighbours, and codes that are exchanged alike for all lights, red for green. The frames of
the primaries (`calibration.radiometry.primaries`) are not used as a basis: they may be the ones that bear wrong names.

Why so: `docs/decisions/0015-lights-are-held-against-their-codes.md`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from acquisition.lights.illuminations import Illumination
from acquisition.measures.least_squares import product
from foundation.angles import angles_deg
from foundation.robust import huber_weights, sigma_of

DEGREE = 4
"""Describes a gamma of 1.8 to 2.6, sRGB and an S-shaped curve to a hundredth of a degree of the lights' direction."""

LIGHTS_A_TERM = 3
"""With fewer lights for each coefficient, what is wrong would be fitted."""

_ROUNDS = 15
"""Reweighted solutions in a row: many, as the brightness of each light is estimated anew in each."""

_LEAST_OTHERS = 0.1
"""Least share of a light's fit that is taken to come from the other lights, so that its residual stays finite."""

_FLICKER = 1.25
"""Factor by which the lamp may make a light brighter or darker than another of its codes."""

_CERTAIN = 4.0
"""Standard errors of a ground truth that are taken off its angle, so that noise is not taken for a wrong name."""

_Array = npt.NDArray[np.float64]


def angles_off_codes_deg(lights: Sequence[Illumination], white: _Array, errors_deg: _Array) -> _Array | None:
    """Return the angle between each white and the one that its codes give, beyond four standard errors.

    Iteratively reweighted least squares with Huber's weights squared; residuals are those of a light as predicted
    from the others (divided by 1 − its leverage).

    Parameters
    ----------
    lights
        L lights.
    white
        (L, 3) > 0, their ground truths, linear camera RGB, the lamp's drift taken out, all exposed alike.
    errors_deg
        (L,) standard error of each white's direction, degrees.

    Returns
    -------
    ndarray or None
        (L,) float64 degrees, ≥ 0; None where there are fewer than `LIGHTS_A_TERM` lights for each coefficient.
    """
    terms = _terms(np.array([light.codes for light in lights]))
    if len(lights) < LIGHTS_A_TERM * terms.shape[1]:
        return None
    length = np.linalg.norm(white, axis=1)
    # Each light counts alike, however bright.
    design, seen = terms / length[:, None], white / length[:, None]
    weights = np.ones(len(lights))
    given, targets = seen, seen
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, None]
        rooted = design * root
        inverse: _Array = np.asarray(np.linalg.pinv(rooted), dtype=np.float64)
        given = product(design, inverse @ (targets * root))
        # As predicted from the other lights: a primary, alone in its corner, draws the fit to itself.
        leverage = np.einsum("lt,tl->l", rooted, inverse)
        residual = np.linalg.norm(targets - given, axis=1) / np.maximum(1 - leverage, _LEAST_OTHERS)
        usual = max(sigma_of(residual), 1e-9)
        weights = huber_weights(residual, usual) ** 2
        # Each light's brightness is free: else a lamp that flickers by a hundredth would look like wrong names.
        brightness = (given * seen).sum(axis=1, keepdims=True)
        targets = seen * np.clip(brightness, 1 / _FLICKER, _FLICKER)
    return np.maximum(angles_deg(given, seen) - _CERTAIN * errors_deg, 0)


def _terms(codes: npt.NDArray[np.integer]) -> _Array:
    """Return the basis (L, terms) of codes (L, 3)."""
    overlaps = (0,), (1,), (2,), (0, 1), (1, 2), (0, 2), (0, 1, 2)
    parts: list[_Array] = [(codes[:, channels] / 255).min(axis=1) for channels in overlaps]
    powers = [part**power for part in parts for power in range(1, DEGREE + 1)]
    return np.column_stack([np.ones(len(codes)), *powers])
