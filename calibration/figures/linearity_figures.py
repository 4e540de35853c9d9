"""How a sensor's counts follow the light, by a series of exposures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearityFigures:
    """Deviation of counts from proportion to the light (EMVA 1288, release 4.0, linearity error).

    - `files`: the frames, by rising exposure.
    - `exposure_s`: (K,) float64 s, as the files state them.
    - `level`: (B,) float64, shares of saturation, rising.
    - `deviation`: (3, B) float64, relative, of R, G and B from the straight line that fits best; NaN where no patch has
      data.
    """

    files: tuple[str, ...]
    exposure_s: _Array
    level: _Array
    deviation: _Array

    @property
    def worst(self) -> float:
        """The largest deviation, a share."""
        return float(np.nanmax(np.abs(self.deviation)))

    @property
    def range(self) -> tuple[float, float]:
        """The lowest and the highest share of saturation for which a channel has data."""
        measured = np.flatnonzero(np.isfinite(self.deviation).any(axis=0))
        return float(self.level[measured[0]]), float(self.level[measured[-1]])

    def to_json(self) -> list[tuple[float, list[float | None]]]:
        """Return each level with the deviations of R, G and B, None where there are no data; for `report.json`."""

        def rounded(values: _Array) -> list[float | None]:
            return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]

        levels = self.level.tolist()
        return [(float(f"{level:.4g}"), rounded(self.deviation[:, number])) for number, level in enumerate(levels)]
