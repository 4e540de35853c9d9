"""Read and check variables of MATLAB files, in which data sets store their ground truths."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError


def read_mat(path: Path) -> Mapping[str, Any]:
    """Return the variables of a MATLAB file up to version 7 by name."""
    from scipy.io import loadmat

    try:
        return loadmat(path)
    except NotImplementedError as error:
        raise FormatError(f"{path} has MATLAB version 7.3, expected 7 or older; save it with -v7") from error
    except Exception as error:
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise FormatError(f"{path} cannot be read: {reason}; restore it from the data set's archive") from error


def numeric_table(content: Mapping[str, Any], name: str, path: Path, columns: int) -> npt.NDArray[np.float64]:
    """Return a variable as a finite array (N, columns) float64."""
    try:
        values = np.asarray(_variable(content, name, path), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FormatError(f"{path}: {name} is not numeric, expected numbers; restore the file") from error
    if values.ndim != 2 or values.shape[1] != columns or not np.isfinite(values).all():
        raise FormatError(
            f"{path}: {name} is {values.shape}, expected (images, {columns}) finite numbers; restore the file"
        )
    return values


def scalar(content: Mapping[str, Any], name: str, path: Path) -> float:
    """Return a variable that is one number ≥ 0."""
    values = np.asarray(_variable(content, name, path))
    if values.size != 1 or values.dtype.kind not in "iuf" or not np.isfinite(values).all() or values.min() < 0:
        raise FormatError(f"{path}: {name} is {values.tolist()}, expected one number of 0 or more; restore the file")
    return float(values.reshape(-1)[0])


def names_or_none(content: Mapping[str, Any], name: str, path: Path) -> list[str] | None:
    """Return a cell array of names, or None if the variable does not exist."""
    if name not in content:
        return None
    names: list[str] = []
    for cell in np.asarray(content[name], dtype=object).reshape(-1):
        value: Any = cell
        while isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        if not isinstance(value, str):
            raise FormatError(f"{path}: {name} contains {value!r}, expected names of images; restore the file")
        names.append(value.strip())
    return names


def _variable(content: Mapping[str, Any], name: str, path: Path) -> Any:
    if name not in content:
        existing = ", ".join(key for key in content if not key.startswith("__"))
        raise FormatError(f"{path} has the variables {existing or 'none'}, expected also {name}; restore the file")
    return content[name]
