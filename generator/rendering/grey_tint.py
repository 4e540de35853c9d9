"""How far the greys of a print are from the light that falls on them: what rendering by codes makes of a picture's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from calibration.radiometry.greys import tint_deg

if TYPE_CHECKING:
    from calibration.table.lut import Lut

DARKEST: Final = 0.1
"""Share of white below which a grey is left out: the tint of ink black is not what a picture's greys suffer from."""


def grey_tint_deg(lut: Lut) -> tuple[float, int] | None:
    """Return the largest angle between a grey of the print and the light, and the light it was found under.

    Greys are the chart's cells with three equal codes between black and white, as the camera sees them under the light
    of the table that is brightest in its darkest channel; cells that are unfit or dark are left out.

    Returns the angle in degrees, and the number of the light; None where the chart has no such grey.

    Examples
    --------
    >>> from pathlib import Path
    >>> from calibration.table.lut import open_lut
    >>> angle, light = grey_tint_deg(open_lut(Path("lut")))
    >>> round(angle, 1), light
    (0.6, 0)
    """
    bits, light = lut.provenance.bits, int(np.argmax(lut.white.min(axis=1)))
    levels = np.arange(1, (1 << bits) - 1)
    cells = levels * (1 | 1 << bits | 1 << 2 * bits)
    unfit = [cell.colour for cell in lut.provenance.unfit]
    cells = cells[~np.isin(cells, unfit)]
    white = lut.white[light]
    greys = lut.samples[light, cells].mean(axis=1, dtype=np.float64)
    greys = greys[(greys / white).min(axis=1) > DARKEST]
    return (float(tint_deg(white, greys).max()), light) if len(greys) else None
