"""How much of a picture the print cannot show, for the records of a dataset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from generator.rendering.cell_mixtures import CellMixtures


@dataclass(frozen=True)
class GamutSummary:
    """What a print makes of the colours of a picture.

    - `outside`: share of the pixels whose colour cells near to it cannot show, 0 … 1.
    - `distance_deg`: mean angle between what the cells show and what the camera should see, degrees, over all pixels.
    """

    outside: float
    distance_deg: float


def summarise(mixtures: CellMixtures, shares: npt.NDArray[np.float64]) -> GamutSummary:
    """Return what a print makes of a picture.

    Parameters
    ----------
    mixtures
        Of the light of the image: 32768.
    shares
        (32768,) float64 ≥ 0, how often each source node occurs, as from
        `dithering.nearest_nodes`; of any sum above 0.

    Examples
    --------
    >>> cells, seen = np.zeros((32768, 16), np.uint16), np.full((32768, 3), 0.5, np.float32)
    >>> wanted = seen.copy()
    >>> wanted[32767] = 1, 0.5, 0.5
    >>> shares = np.zeros(32768)
    >>> shares[[0, 32767]] = 3, 1
    >>> summary = summarise(CellMixtures(cells, seen, wanted), shares)
    >>> summary.outside, round(summary.distance_deg, 3)
    (0.25, 4.868)
    """
    weights = shares / shares.sum()
    return GamutSummary(float(weights @ mixtures.outside), float(weights @ mixtures.distance))
