"""Colour matrices of cameras: from linear sRGB to the camera's own RGB.

A manufacturer's matrix leads from XYZ to camera RGB under D65. After that of sRGB (IEC 61966-2-1), which is of D65
too, and with rows scaled to sum 1, white becomes (1, 1, 1), so that the light can be multiplied in.

For cameras whose matrix is not known it comes from the table itself. The chart's cells were printed from sRGB codes.
If the print shop's machine shows them as sRGB, the camera's colours of the cells are C · linear sRGB of their codes,
and least squares give C. A print whose colours were not managed shows other colours than its codes say: then C holds
the print's faults as well as the camera, mostly as colours that are too pale. How well C fits is said in its source,
so that one can see it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg, decode_srgb
from foundation.errors import InputError
from generator.kernels.choice import channels_of
from generator.rendering.print_profiles import PrintProfile, profile_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut


# XYZ under D65 to camera RGB, row by row in ten-thousandths: the numbers that Adobe's DNG converter writes as
# ColorMatrix2, as the tables `adobe_coeff` of dcraw 9.28 and LibRaw (src/tables/colordata.cpp, commit e419de0) list
# them; the two agree on all that both have. The 5DS R has that of the 5DS.
_TO_CAMERA: Final = {
    "Canon EOS 550D": (6941, -1164, -857, -3825, 11597, 2534, -416, 1540, 6039),
    "Canon EOS 600D": (6461, -907, -882, -4300, 12184, 2378, -819, 1944, 5931),
    "Canon EOS 6D Mark II": (6875, -970, -932, -4691, 12459, 2501, -874, 1953, 5809),
    "Canon EOS-1Ds Mark III": (5859, -211, -930, -8255, 16017, 2353, -1732, 1887, 7448),
    "Canon EOS 5DS": (6250, -711, -808, -5153, 12794, 2636, -1249, 2198, 5610),
    "Canon EOS 5DS R": (6250, -711, -808, -5153, 12794, 2636, -1249, 2198, 5610),
    "Canon EOS 5D Mark II": (4716, 603, -830, -7798, 15474, 2480, -1496, 1937, 6651),
    "Canon EOS 200D": (7377, -742, -998, -4235, 11981, 2549, -673, 1918, 5538),
}

# Where the matrices of named cameras come from.
SOURCE: Final = "ColorMatrix2 as listed by dcraw 9.28 and LibRaw (adobe_coeff)"

# Linear sRGB to XYZ, white D65: IEC 61966-2-1:1999, clause 5.2.
_SRGB_TO_XYZ: Final = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])

_LEAST_SUM: Final = 1e-6  # Least sum of a row: that of a row that leaves white black cannot be made 1

# Largest number of a matrix in a file: rows in ten-thousandths have some 10⁴, and sums of such are exact enough.
_LARGEST: Final = 1e6


@dataclass(frozen=True, eq=False)
class ColourMatrix:
    """A colour matrix and where it comes from.

    - `name`: the camera, or the file.
    - `rows`: (3, 3) float64, linear sRGB to camera RGB; each row has sum 1.
    - `source`: where the numbers come from, for notes below tables.
    """

    name: str
    rows: npt.NDArray[np.float64]
    source: str


def cameras() -> tuple[str, ...]:
    """Return the names of the cameras whose matrices are known."""
    return tuple(_TO_CAMERA)


def camera_matrix(camera: str) -> ColourMatrix | None:
    """Return the matrix of a camera by its name, or None if it is not known.

    Upper and lower case, blanks, hyphens and the maker's name make no difference.
    """
    wanted = _bare(camera)
    for name, coefficients in _TO_CAMERA.items():
        if wanted and wanted in (_bare(name), _bare(name).removeprefix("eos")):
            to_camera = np.array(coefficients, dtype=np.float64).reshape(3, 3) / 10_000
            return ColourMatrix(name, _normalised(to_camera @ _SRGB_TO_XYZ, name), SOURCE)
    return None


def read_matrix(path: Path) -> ColourMatrix:
    r"""Return the matrix of a text file: three rows of three numbers, linear sRGB to camera RGB, `#` for remarks.

    Blanks, commas and semicolons part numbers. Rows are scaled to sum 1.
    """
    expected = "expected three rows of three numbers, linear sRGB to camera RGB"
    try:
        lines = [line.partition("#")[0] for line in path.read_text(encoding="utf-8-sig").splitlines()]
        rows = [[float(number) for number in line.replace(",", " ").replace(";", " ").split()] for line in lines]
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is no colour matrix: {error}; {expected}") from error
    rows = [row for row in rows if row]
    if [len(row) for row in rows] != [3, 3, 3]:
        raise InputError(f"{path} is no colour matrix: its rows have {[len(row) for row in rows]} numbers; {expected}")
    if not np.abs(rows).max() <= _LARGEST:
        raise InputError(f"{path} is no colour matrix: its numbers are {rows}, up to {_LARGEST:g} expected; {expected}")
    return ColourMatrix(path.name, _normalised(np.array(rows), str(path)), f"the file {path.name}")


def choose_matrix(text: str) -> ColourMatrix | None:
    """Return the matrix that an option names: a camera, a file, or None for the word `none`."""
    if text.strip().lower() == "none":
        return None
    found = camera_matrix(text)
    if found is None and Path(text).is_file():
        return read_matrix(Path(text))
    if found is None:
        raise InputError(
            f"{text!r} is neither a file nor a camera whose colour matrix is known; the cameras are "
            f"{', '.join(_TO_CAMERA)}; for another write its 3 x 3 numbers, linear sRGB to camera RGB, into a file"
        )
    return found


def _bare(camera: str) -> str:
    return "".join(camera.lower().replace("-", " ").split()).removeprefix("canon")


def _normalised(rows: npt.NDArray[np.float64], name: str) -> npt.NDArray[np.float64]:
    """Return `rows` (3, 3) float64 with sums of 1."""
    sums = rows.sum(axis=1, keepdims=True)
    if sums.min() < _LEAST_SUM:
        raise InputError(
            f"{name}: the rows of the colour matrix have sums {' '.join(f'{part:g}' for part in sums[:, 0])}, expected "
            "sums above 0: what the camera sees of white"
        )
    return rows / sums


# Temperature of the light for the fit, kelvin: sRGB's white is D65 (IEC 61966-2-1, clause 4.1).
DAYLIGHT_K: Final = 6500.0

TABLE: Final = "table"  # The word that asks for the matrix from the table


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
