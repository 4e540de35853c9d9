"""The grey references: what each printed level gives under each light, compared with bare paper.

Rules that hold inside:

- A level is the mean of its patches after the field is divided out, without outliers; its standard error is that of
  the mean.
- White is the ground truth; a grey has the light's chromaticity only as far as the print is neutral. How far it is not
  is the print's tint, an angle between camera RGB of grey and white.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiment.chart.model import Reference
from foundation.colorimetry import angles_deg
from foundation.robust import MAD_TO_SIGMA

COLUMNS = ("light", "name", "r", "g", "b", "r_error", "g_error", "b_error")
"""Columns of `references.csv` (docs/formats.md)."""

_OUTLIER_SIGMAS = 6.0
"""Robust standard deviations from the median beyond which a patch is covered or dirty."""

_FEW_PATCHES = 4
"""Patches up to which none is left out: of so few, none is surely the one that is wrong."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GreyLevels:
    """The printed levels of grey of a chart.

    - `names`: one for each level, brightest first.
    - `level`: (N,) int64, the level of each grey reference.
    """

    names: tuple[str, ...]
    level: npt.NDArray[np.int64]

    @classmethod
    def of(cls, references: Sequence[Reference]) -> GreyLevels:
        """Return the levels among references, one for each printed code."""
        codes = sorted({reference.rgb for reference in references}, reverse=True)
        first = {reference.rgb: reference.name for reference in reversed(references)}
        return cls(
            tuple(first[code] for code in codes),
            np.array([codes.index(reference.rgb) for reference in references], dtype=np.int64),
        )

    def read(self, seen: _Array, field: _Array) -> tuple[_Array, _Array]:
        """Return the value and standard error (G, 3) float64 of each level, counts, NaN where no patch can be used.

        `seen`: (N, 3) mean counts above black of each patch, NaN where it cannot be used. `field`: (N, 3) the field at
        each patch.
        """
        flat = seen / field
        value, error = np.full((len(self.names), 3), np.nan), np.full((len(self.names), 3), np.nan)
        for number in range(len(self.names)):
            patches = flat[self.level == number]
            patches = patches[np.isfinite(patches).all(axis=1)]
            if len(patches) == 0:
                continue
            middle = np.median(patches, axis=0)
            scale = MAD_TO_SIGMA * np.median(np.abs(patches - middle), axis=0) + 1e-9
            near = (np.abs(patches - middle) < _OUTLIER_SIGMAS * scale).all(axis=1)
            kept = patches[near] if len(patches) > _FEW_PATCHES else patches
            value[number] = kept.mean(axis=0)
            error[number] = kept.std(axis=0, ddof=1) / np.sqrt(len(kept)) if len(kept) > 1 else np.nan
        return value, error


def references_csv(names: Sequence[str], white: _Array, white_error: _Array, greys: _Array, errors: _Array) -> str:
    """Return the text of `references.csv`: every light's white, then its greys.

    `white`, `white_error`: (L, 3), units of the samples. `greys`, `errors`: (L, G, 3), the same units; NaN is left
    empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)

    def row(light: int, name: str, value: _Array, error: _Array) -> None:
        writer.writerow([light, name, *("" if np.isnan(v) else f"{v:.6f}" for v in (*value.tolist(), *error.tolist()))])

    for light in range(len(white)):
        row(light, "white", white[light], white_error[light])
        for number, name in enumerate(names):
            row(light, name, greys[light, number], errors[light, number])
    return text.getvalue()


def tint_deg(white: _Array, greys: _Array) -> _Array:
    """Return the angle (..., G) float64, degrees, between camera RGB of greys (..., G, 3) and of white (..., 3)."""
    return angles_deg(np.broadcast_to(white[..., None, :], greys.shape), greys)
