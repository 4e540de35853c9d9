"""Wavelength grids: what a measured spectrum must cover, and how it comes to another grid.

What stands on a finer grid is not picked at the new grid's wavelengths but gathered: a line of a lamp that lies between
two of them must not be lost. What stands on a coarser or the same grid is joined by straight lines.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError

NEEDED_NM: Final = (400.0, 700.0)
"""Wavelengths that must be covered: beyond them a camera with its infrared filter sees under 2 % of its light."""

WIDEST_STEP_NM: Final = 20.0
"""Distance of two wavelengths that may be bridged by a straight line: filters' edges rise over some 40 nm, and bench
measurements are taken every 5 or 10 nm."""

_Array = npt.NDArray[np.float64]


def require_grid(wavelengths_nm: _Array, where: str) -> None:
    """Refuse wavelengths (W,), ascending, that do not cover the visible range without gaps.

    `wavelengths_nm`: (W,) float64.
    """
    low, high = NEEDED_NM
    if len(wavelengths_nm) < 2 or wavelengths_nm[0] > low or wavelengths_nm[-1] < high:
        span = "none" if not len(wavelengths_nm) else f"{wavelengths_nm[0]:g} to {wavelengths_nm[-1]:g}"
        raise FormatError(
            f"{where}: its wavelengths are {span}, {low:g} to {high:g} nm at least expected; "
            "convert them to nanometres if they are not, or measure the rest"
        )
    steps = np.diff(wavelengths_nm)
    if steps.min() <= 0:
        raise FormatError(f"{where}: {wavelengths_nm[int(steps.argmin())]:g} nm stands there twice; leave one out")
    inside = (wavelengths_nm[:-1] < high) & (wavelengths_nm[1:] > low)
    if steps[inside].max() > WIDEST_STEP_NM:
        at = int(np.flatnonzero(inside)[steps[inside].argmax()])
        raise FormatError(
            f"{where}: there is a gap from {wavelengths_nm[at]:g} to {wavelengths_nm[at + 1]:g} nm, "
            f"{WIDEST_STEP_NM:g} nm at most expected; measure what lies between"
        )


def regridded(wavelengths_nm: _Array, curves: _Array, onto_nm: _Array) -> _Array:
    """Return curves on another grid.

    `wavelengths_nm`: (W,) float64, ascending. `curves`: (W, N) float64, per nanometre. `onto_nm`: (M,) float64,
    ascending in even steps. Returns (M, N) float64; 0 beyond the given wavelengths. If some of these are nearer to each
    other than those of the new grid, each of its values is the mean of the curve weighted by a triangle that reaches to
    the neighbouring wavelengths, which leaves the curve's integral as it is; else the curve's own value.

    Examples
    --------
    >>> line = np.zeros((401, 1)); line[202] = 5.0  # 582 nm, on a grid of 1 nm
    >>> on_5 = regridded(np.arange(380.0, 781.0), line, np.arange(380.0, 781.0, 5.0))
    >>> on_5[40:42, 0].round(3).tolist(), round(float(on_5.sum() * 5), 3)
    ([0.6, 0.4], 5.0)
    """
    step = float(onto_nm[1] - onto_nm[0])
    found = np.zeros((len(onto_nm), curves.shape[1]))
    if float(np.diff(wavelengths_nm).min()) > 0.999 * step:
        for number in range(curves.shape[1]):
            found[:, number] = np.interp(onto_nm, wavelengths_nm, curves[:, number], left=0, right=0)
        return found
    if float(np.diff(wavelengths_nm).max()) > 0.999 * step:
        # Where steps are wider, a wavelength would stand for nodes that lie between it and the next.
        wavelengths_nm, curves = _filled(wavelengths_nm, curves, step)
    # Each wavelength stands for half the way to its neighbours.
    edges = np.concatenate([wavelengths_nm[:1], (wavelengths_nm[1:] + wavelengths_nm[:-1]) / 2, wavelengths_nm[-1:]])
    share = np.clip(1 - np.abs(onto_nm[:, None] - wavelengths_nm[None]) / step, 0, None)
    weights = share * np.diff(edges)[None] / step
    return np.asarray(weights @ curves, dtype=np.float64)


def _filled(wavelengths_nm: _Array, curves: _Array, step: float) -> tuple[_Array, _Array]:
    """Return wavelengths (V,) and curves (V, N) with the gaps of an uneven grid filled to steps below `step` / 4."""
    parts = np.maximum(np.ceil(4 * np.diff(wavelengths_nm) / step), 1).astype(np.int64)
    starts = np.repeat(wavelengths_nm[:-1], parts)
    widths = np.repeat(np.diff(wavelengths_nm) / parts, parts)
    within = np.arange(len(starts)) - np.repeat(np.cumsum(parts) - parts, parts)
    filled = np.append(starts + within * widths, wavelengths_nm[-1])
    found = np.empty((len(filled), curves.shape[1]))
    for number in range(curves.shape[1]):
        found[:, number] = np.interp(filled, wavelengths_nm, curves[:, number])
    return filled, found
