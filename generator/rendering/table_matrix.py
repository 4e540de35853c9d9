"""A colour matrix from the table itself, for cameras whose matrix is not known.

The chart's cells were printed from sRGB codes. If the print shop's machine shows them as sRGB, the camera's colours
of the cells are C · linear sRGB of their codes, and least squares give C. A print whose colours were not managed
shows other colours than its codes say: then C holds the print's faults as well as the camera, mostly as colours that
are too pale. How well C fits is said in its source, so that one can see it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg, decode_srgb
from generator.kernels.palette import channels_of
from generator.rendering.matrices import ColourMatrix, camera_matrix, choose_matrix
from generator.rendering.print_profiles import PrintProfile, profile_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut

DAYLIGHT_K: Final = 6500.0
"""Temperature of the light for the fit, kelvin: sRGB's white is D65 (IEC 61966-2-1, clause 4.1)."""

TABLE: Final = "table"
"""The word that asks for the matrix from the table."""


def matrix_for(lut: Lut, text: str | None = None) -> ColourMatrix:
    """Return the colour matrix that an option names, or the one for a table's camera.

    `text`: A camera's name, a file, `table` for the one fitted from the table, or `none` for linear sRGB as it is.
    None: that of the table's camera, or, where it is not known, the fitted one.
    """
    if text is None:
        return camera_matrix(lut.provenance.camera) or fitted_matrix(lut)
    if text.strip().lower() == TABLE:
        return fitted_matrix(lut)
    return choose_matrix(text) or ColourMatrix("none", np.eye(3), "none asked for: linear sRGB taken for camera RGB")


def fitted_matrix(lut: Lut) -> ColourMatrix:
    """Return the colour matrix that explains a table's colours best, under its light nearest to 6500 K.

    A table without black bodies is fitted under the light whose white has the most equal shares of brightness.
    """
    bodies = [(abs(light.cct_k - DAYLIGHT_K), light.index) for light in lut.illuminations if light.cct_k is not None]
    light = min(bodies)[1] if bodies else int(np.ptp(np.log(lut.white), axis=1).argmin())
    rows, residual = fit_matrix(profile_of(lut, light))
    source = f"least squares over the table's colours under light {light}; {residual:.1f} degrees off in the median"
    return ColourMatrix(TABLE, rows, source)


def fit_matrix(profile: PrintProfile) -> tuple[npt.NDArray[np.float64], float]:
    """Return the matrix (3, 3) float64, rows of sum 1, from linear sRGB of the codes to colours, and its residual.

    Colours are taken between the print's black cell and its paper, channel by channel. Least squares with rows bound
    to sum 1 are those without bounds of differences to green: a - G = c_r (R - G) + c_b (B - G). The residual is the
    median angle in degrees between what the matrix gives, on the print, and what the camera sees.
    """
    bits = profile.bits
    codes = channels_of(np.flatnonzero(profile.usable), bits) / (2.0**bits - 1)
    linear = decode_srgb(codes)
    colours = profile.colours[profile.usable]
    black = profile.colours[0] if profile.usable[0] else np.full(3, profile.black)
    paper = profile.colours[-1] if profile.usable[-1] else np.full(3, profile.white)
    span = np.maximum(paper - black, 1e-6)
    seen = (colours - black) / span
    differences = linear[:, [0, 2]] - linear[:, [1]]
    found = np.asarray(np.linalg.lstsq(differences, seen - linear[:, [1]], rcond=None)[0], np.float64).T
    rows = np.stack([found[:, 0], 1 - found.sum(axis=1), found[:, 1]], axis=1)
    shown = black + span * np.clip(linear @ rows.T, 0, 1)
    return rows, float(np.median(angles_deg(shown, colours)))
