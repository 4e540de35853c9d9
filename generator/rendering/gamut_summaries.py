"""How much of a picture the print cannot show, for the records of a dataset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from generator.rendering.cell_mixtures import CellMixtures
from generator.rendering.source_colours import NODE_BITS, NODES

PIXELS: Final = 1 << 16
"""Pixels of a picture that are looked at, on a grid: a share is then known to a fifth of a percent."""


@dataclass(frozen=True)
class GamutSummary:
    """What a print makes of the colours of a picture.

    Attributes
    ----------
    outside
        Share of the pixels whose colour cells near to it cannot show, 0 … 1.
    distance_deg
        Mean angle between what the cells show and what the camera should see, degrees, over all pixels.
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
        (32768,) float64 ≥ 0, how often each source node occurs, as from `node_shares`; of any sum above 0.

    Examples
    --------
    >>> cells, seen = np.zeros((32768, 32), np.uint16), np.full((32768, 3), 0.5, np.float32)
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


def node_shares(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Return how a picture is shared out among the source nodes, on a grid of at most `PIXELS` of its pixels.

    Each code of a channel lies between two nodes and goes to either in proportion to its distance from the other, so a
    pixel has up to eight nodes.

    Parameters
    ----------
    picture
        (H, W, 3) uint8, sRGB codes, H and W ≥ 1.

    Returns
    -------
    ndarray
        (32768,) float64, sum 1.

    Examples
    --------
    >>> shares = node_shares(np.full((4, 4, 3), (255, 0, 4), np.uint8))
    >>> {int(node): round(float(shares[node]), 3) for node in np.flatnonzero(shares)}
    {31744: 0.514, 31745: 0.486}
    """
    step = max(1, math.ceil(math.sqrt(picture.shape[0] * picture.shape[1] / PIXELS)))
    seen = picture[step // 2 :: step, step // 2 :: step].reshape(-1, 3)
    if not len(seen):
        seen = picture[::step, ::step].reshape(-1, 3)
    last = (1 << NODE_BITS) - 1
    places = seen.astype(np.float64) * (last / 255)
    lower = np.minimum(places.astype(np.int64), last - 1)
    upper = places - lower
    shares = np.zeros(NODES)
    for corner in range(8):
        up = np.array([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
        codes = lower + up
        nodes = codes[:, 0] << 2 * NODE_BITS | codes[:, 1] << NODE_BITS | codes[:, 2]
        shares += np.bincount(nodes, np.where(up == 1, upper, 1 - upper).prod(axis=1), NODES)
    return shares / len(seen)
