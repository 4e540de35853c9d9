"""Colour matrices of cameras, from linear sRGB to camera RGB.

A listed matrix converts XYZ to camera RGB under D65. It is multiplied by the matrix from sRGB to XYZ (IEC 61966-2-1),
which is for D65, too. Rows are scaled to sum 1: white becomes (1, 1, 1), which is then multiplied by the illuminant.

A computed look-up table (LUT) records a matrix that `sim table` calculated from the sensitivities of its camera. It is
used if the camera has no listed matrix.

For other cameras the matrix C is fitted to the LUT. The patches were printed from sRGB codes. If the print shop
reproduces sRGB, the camera RGB of the patches is C · linear sRGB, and least squares give C. If the print was not
colour-managed, C also contains the errors of the print, mostly colours that are too pale. The `source` of the matrix
reports the residual.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg, decode_srgb, fit_white_matrix
from foundation.errors import FormatError, InputError
from generator.kernels.choice import channels_of
from generator.rendering.print_profiles import PrintProfile, profile_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut


# XYZ under D65 to camera RGB, row by row, in 1/10000: ColorMatrix2 of Adobe's DNG converter, from the tables
# `adobe_coeff` of dcraw 9.28 and LibRaw (src/tables/colordata.cpp, commit e419de0). The two agree on all cameras that
# both list. The 5DS R has the matrix of the 5DS.
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

# Source of the matrices of listed cameras.
SOURCE: Final = "ColorMatrix2 as listed by dcraw 9.28 and LibRaw (adobe_coeff)"

# Linear sRGB to XYZ, white D65: IEC 61966-2-1:1999, clause 5.2.
_SRGB_TO_XYZ: Final = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])

_SMALLEST_ROW_SUM: Final = 1e-6  # Smallest allowed sum of a row; smaller sums cannot be scaled to 1

# Largest allowed number of a matrix in a file. In units of 1/10000, its numbers are about 10⁴.
_LARGEST: Final = 1e6


@dataclass(frozen=True, eq=False)
class ColourMatrix:
    """A colour matrix and its source.

    - `name`: name of the camera or file.
    - `rows`: (3, 3) float64, linear sRGB to camera RGB; each row has sum 1.
    - `source`: where the numbers come from, for notes below tables.
    """

    name: str
    rows: npt.NDArray[np.float64] = field(repr=False)
    source: str


def cameras() -> tuple[str, ...]:
    """Return the names of the cameras with a listed matrix."""
    return tuple(_TO_CAMERA)


def camera_matrix(camera: str) -> ColourMatrix | None:
    """Return the matrix of a camera by its name, or None if it is not listed.

    Case, blanks, hyphens and the name of the maker are ignored.
    """
    simplified_name = _simplified_name(camera)
    for name, coefficients in _TO_CAMERA.items():
        if simplified_name and simplified_name in (_simplified_name(name), _simplified_name(name).removeprefix("eos")):
            to_camera = np.array(coefficients, dtype=np.float64).reshape(3, 3) / 10_000
            return ColourMatrix(name, _normalised(to_camera @ _SRGB_TO_XYZ, name), SOURCE)
    return None


def read_matrix(path: Path) -> ColourMatrix:
    """Return the matrix of a text file: three rows of three numbers, linear sRGB to camera RGB, `#` for comments.

    Numbers are separated by blanks, commas or semicolons. Rows are scaled to sum 1.
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
    """Return the matrix of a camera or a file, or None for the word `none`."""
    if text.strip().lower() == "none":
        return None
    matrix = camera_matrix(text)
    if matrix is None and Path(text).is_file():
        return read_matrix(Path(text))
    if matrix is None:
        raise InputError(
            f"{text!r} is neither a file nor a camera with a listed colour matrix, expected one of "
            f"{', '.join(_TO_CAMERA)}; for another camera write 3 × 3 numbers, linear sRGB to camera RGB, into a file"
        )
    return matrix


def _simplified_name(camera: str) -> str:
    return "".join(camera.lower().replace("-", " ").split()).removeprefix("canon")


def _normalised(rows: npt.NDArray[np.float64], name: str) -> npt.NDArray[np.float64]:
    sums = rows.sum(axis=1, keepdims=True)
    if sums.min() < _SMALLEST_ROW_SUM:
        raise InputError(
            f"{name}: the rows of the colour matrix have sums {' '.join(f'{row_sum:g}' for row_sum in sums[:, 0])}, "
            "expected sums > 0, because they are the camera RGB of white"
        )
    return rows / sums


# Temperature of the illuminant for the fit, K: the white of sRGB is D65 (IEC 61966-2-1, clause 4.1).
DAYLIGHT_K: Final = 6500.0

TABLE: Final = "table"  # Word for the matrix fitted to the LUT


def matrix_for(lut: Lut, text: str | None = None) -> ColourMatrix:
    """Return the colour matrix for a LUT.

    `text`: name of a camera, a file, `table` for the matrix fitted to the LUT, or `none` for the identity. None: the
    listed matrix of the LUT's camera, else the one that a computed LUT records, else the fitted one.
    """
    if text is None:
        return camera_matrix(lut.provenance.camera) or recorded_matrix(lut) or fitted_matrix(lut)
    if text.strip().lower() == TABLE:
        return fitted_matrix(lut)
    return choose_matrix(text) or ColourMatrix("none", np.eye(3), "no matrix: linear sRGB is used as camera RGB")


def recorded_matrix(lut: Lut) -> ColourMatrix | None:
    """Return the matrix of the sensitivities of a computed LUT, or None if the LUT records none."""
    record = (lut.provenance.computed or {}).get("matrix")
    if record is None:
        return None
    try:
        rows, source = np.array(record["rows"], np.float64), str(record["source"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{lut.folder}: computed.matrix of lut.json is {record!r}; {_RECORDED}") from error
    if rows.shape != (3, 3) or not np.abs(rows).max() <= _LARGEST:
        raise FormatError(f"{lut.folder}: computed.matrix of lut.json is {record!r}; {_RECORDED}")
    return ColourMatrix(lut.provenance.camera, _normalised(rows, str(lut.folder)), source)


_RECORDED: Final = "expected 3 x 3 numbers as rows, and their source; compute the LUT again"
# Linear sRGB to XYZ with white D50, by Bradford's adaptation: the sRGB profile of the International Color Consortium.
_SRGB_TO_XYZ_D50: Final = np.array(
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)


def dng_matrices(lut: Lut) -> tuple[list[list[float]], list[list[float]]]:
    """Return ColorMatrix and ForwardMatrix of the camera of a LUT under D65, as DNG 1.7.1 defines them.

    ColorMatrix converts XYZ to camera RGB. Without a listed matrix of the camera, it maps D65 to the white of the LUT.
    ForwardMatrix converts white-balanced camera RGB to XYZ with white D50.
    """
    camera = camera_matrix(lut.provenance.camera)
    rows = matrix_for(lut).rows
    if camera is not None:
        to_camera = np.array(_TO_CAMERA[camera.name]).reshape(3, 3) / 10_000
    else:
        white = lut.white[_daylight(lut)]
        to_camera = (white / white.max())[:, None] * rows @ np.linalg.inv(_SRGB_TO_XYZ)
    return to_camera.round(6).tolist(), (_SRGB_TO_XYZ_D50 @ np.linalg.inv(rows)).round(6).tolist()


def _daylight(lut: Lut) -> int:
    # The black body nearest to 6500 K; if there is none, the illuminant with the most even white.
    bodies = [(abs(light.cct_k - DAYLIGHT_K), light.index) for light in lut.illuminations if light.cct_k is not None]
    return min(bodies)[1] if bodies else int(np.ptp(np.log(lut.white), axis=1).argmin())


def fitted_matrix(lut: Lut) -> ColourMatrix:
    """Return the colour matrix fitted to the colours of a LUT under its illuminant nearest to 6500 K.

    If the LUT has no black body, the illuminant with the most even white is used.
    """
    light = _daylight(lut)
    rows, residual = fit_matrix(profile_of(lut, light))
    source = f"least squares over the LUT's colours under illuminant {light}; median residual {residual:.1f} degrees"
    return ColourMatrix(TABLE, rows, source)


def fit_matrix(profile: PrintProfile) -> tuple[npt.NDArray[np.float64], float]:
    """Return the matrix (3, 3) float64 with rows of sum 1 from linear sRGB codes to colours, and its residual, degrees.

    Colours are scaled between the print's black and paper, channel by channel, for `fit_white_matrix`. The residual is
    the median angle between predicted and recorded colours.
    """
    bits = profile.bits
    codes = channels_of(np.flatnonzero(profile.usable), bits) / (2.0**bits - 1)
    linear = decode_srgb(codes)
    colours = profile.colours[profile.usable]
    black = profile.colours[0] if profile.usable[0] else np.full(3, profile.black)
    paper = profile.colours[-1] if profile.usable[-1] else np.full(3, profile.white)
    span = np.maximum(paper - black, 1e-6)
    reflectances = (colours - black) / span
    rows = fit_white_matrix(linear, reflectances)
    predicted = black + span * np.clip(linear @ rows.T, 0, 1)
    return rows, float(np.median(angles_deg(predicted, colours)))
