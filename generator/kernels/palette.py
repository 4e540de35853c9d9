"""Colours of a source picture that the table cannot stand for, and what stands in for them.

A table lists the cells whose samples must not be used. A pixel of such a colour takes the nearest fit colour, and the
number of those pixels is told and recorded with the dataset; nothing is replaced in silence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from drivers.errors import InputError, QualityError

if TYPE_CHECKING:
    from calibration.lut import Provenance


def bits_of(colours: int) -> int:
    """Return the bits a channel of a table with `colours` = 8**bits colours.

    Raises
    ------
    InputError
        No table has that many colours.
    """
    for bits in range(1, 6):
        if colours == 8**bits:
            return bits
    raise InputError(f"the samples are of {colours} colours, expected 8, 64, 512, 4096 or 32768")


def channels_of(colours: npt.ArrayLike, bits: int) -> npt.NDArray[np.int64]:
    """Return the codes (..., 3) int64, 0 … 2**bits − 1, of colour indices 0 … 8**bits − 1."""
    colours = np.asarray(colours, dtype=np.int64)
    mask = (1 << bits) - 1
    return np.stack([colours >> 2 * bits & mask, colours >> bits & mask, colours & mask], axis=-1)


def stand_ins(unfit: npt.ArrayLike, bits: int) -> npt.NDArray[np.int64]:
    """Return for each unfit colour the nearest fit one.

    Nearest by Euclidean distance of the codes; of several equally near the lowest index.

    Parameters
    ----------
    unfit
        (N,) int, distinct colour indices 0 … 8**bits − 1.
    bits
        Bits kept of each channel.

    Returns
    -------
    ndarray
        (N,) int64 colour indices, none of them unfit.

    Raises
    ------
    QualityError
        No colour is fit.
    """
    unfit = np.asarray(unfit, dtype=np.int64)
    is_fit = np.ones(8**bits, dtype=bool)
    is_fit[unfit] = False
    fit = np.flatnonzero(is_fit)
    if not fit.size:
        raise QualityError(f"all {8**bits} colours of the table are unfit for use; build the table again")
    codes = channels_of(fit, bits)
    nearest = [
        fit[np.argmin(((codes - channel) ** 2).sum(axis=1))] for channel in channels_of(unfit, bits).reshape(-1, 3)
    ]
    return np.array(nearest, dtype=np.int64).reshape(unfit.shape)


def fit_picture(picture: npt.NDArray[np.uint8], provenance: Provenance) -> tuple[npt.NDArray[np.uint8], int]:
    """Return `picture` with unfit colours replaced, and the number of pixels replaced.

    Parameters
    ----------
    picture
        (H, W, 3) uint8 sRGB codes.
    provenance
        The table's description with its unfit colours.

    Returns
    -------
    tuple
        (H, W, 3) uint8, the same array if nothing had to be replaced; and the count.
    """
    unfit = np.unique([cell.colour for cell in provenance.unfit]).astype(np.int64)
    if not unfit.size:
        return picture, 0
    bits = provenance.bits
    shift = 8 - bits
    top = (picture >> shift).astype(np.uint16)
    colours = (top[..., 0] << 2 * bits) | (top[..., 1] << bits) | top[..., 2]
    is_unfit = np.zeros(8**bits, dtype=bool)
    is_unfit[unfit] = True
    rows, columns = np.nonzero(is_unfit[colours])
    if not rows.size:
        return picture, 0
    instead = np.zeros(8**bits, dtype=np.int64)
    instead[unfit] = stand_ins(unfit, bits)
    replaced = picture.copy()
    replaced[rows, columns] = channels_of(instead[colours[rows, columns]], bits) << shift
    return replaced, int(rows.size)
