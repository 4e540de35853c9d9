"""Arrays from outside: bring them into the byte order and memory layout of this machine."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def native(values: npt.ArrayLike) -> npt.NDArray[Any]:
    """Return an array with the same values in native byte order and C order; a copy only if needed.

    FITS and big-endian TIFF or NumPy files give arrays in the other byte order. OpenCV and compiled functions read
    their bytes in native order, so the values would be wrong.

    Examples
    --------
    >>> native(np.array([1, 2], ">u2")).dtype.isnative
    True
    """
    array = np.asarray(values)
    return np.asarray(array, dtype=array.dtype.newbyteorder("="), order="C")
