"""Colour matrices of cameras: from linear sRGB to the camera's own RGB, for the naive baseline.

A manufacturer's matrix leads from XYZ to camera RGB under D65. After that of sRGB (IEC 61966-2-1), which is of D65 too,
and with rows scaled to sum 1, white becomes (1, 1, 1), so that the light can be multiplied in.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError

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
"""XYZ under D65 to camera RGB, row by row in ten-thousandths: the numbers that Adobe's DNG converter writes as
ColorMatrix2, as the tables `adobe_coeff` of dcraw 9.28 and LibRaw (src/tables/colordata.cpp, commit e419de0) list them;
the two agree on all that both have. The 5DS R has that of the 5DS."""

SOURCE: Final = "ColorMatrix2 as listed by dcraw 9.28 and LibRaw (adobe_coeff)"
"""Where the matrices of named cameras come from."""

_SRGB_TO_XYZ: Final = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Linear sRGB to XYZ, white D65: IEC 61966-2-1:1999, clause 5.2."""

_LEAST_SUM: Final = 1e-6
"""Least sum of a row: that of a row that leaves white black cannot be made 1."""

_LARGEST: Final = 1e6
"""Largest number of a matrix in a file: rows in ten-thousandths have some 10⁴, and sums of such are exact enough."""


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

    Examples
    --------
    >>> camera_matrix("eos 550d").rows.round(3)
    array([[0.577, 0.344, 0.079],
           [0.087, 0.674, 0.238],
           [0.035, 0.217, 0.748]])
    >>> camera_matrix("Pinhole") is None
    True
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

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "camera.txt"
    ...     _ = path.write_text("# mine\n2 1 1\n0, 3, 1\n0 0 1\n")
    ...     read_matrix(path).rows
    array([[0.5 , 0.25, 0.25],
           [0.  , 0.75, 0.25],
           [0.  , 0.  , 1.  ]])
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
    """Return a camera's name without the maker, blanks, hyphens and capitals."""
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
