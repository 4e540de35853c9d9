"""What the whites of a session show of its projector: whether its primaries add up, and how its lamp drifts.

Neither alters a table: each light's ground truth is measured in the frame of its samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from experiment.lights import Illumination

_Array = npt.NDArray[np.float64]


def additivity(
    lights: Sequence[Illumination], white: _Array, full_white: _Array | None, dark: _Array, gains: _Array
) -> _Array | None:
    """Return by how much the primaries together differ from white, per channel, relative to white.

    red + green + blue − 2 black = white where light adds: each of the three brings the projector's black along. A
    projector with a white segment on its wheel, or one that processes colours, gives more or less. It harms no table,
    since each light's ground truth is measured; it means that a light cannot be predicted from its codes.

    `lights`: L lights; used are the three with one full primary, and full white if `full_white` is None. `white`: (L,
    3) their ground truths. `full_white`: (3,) paper under full white from the white frames, None without. `dark`: (3,)
    paper in the dark frames; zeros where already subtracted. `gains`: (L, 3) the lamp's drift at each light, of which
    white frames are free; `drift_gains`. Returns (3,) float64; None when a primary or white is missing.
    """
    found: dict[tuple[int, int, int], _Array] = {}
    for light in lights:
        found[light.codes] = white[light.index] / gains[light.index]
    total = full_white if full_white is not None else found.get((255, 255, 255))
    primaries = [found.get(code) for code in ((255, 0, 0), (0, 255, 0), (0, 0, 255))]
    red, green, blue = primaries
    if total is None or red is None or green is None or blue is None or not np.isfinite(dark).all():
        return None
    return (red + green + blue - 2 * dark) / total - 1


def drift_gains(at_s: _Array, white_at_s: _Array, white: _Array) -> _Array:
    """Return the lamp's light at times over that of the first white frame, linear between white frames.

    `at_s`: (L,) when each light was taken. `white_at_s`, `white`: (W,) and (W, 3) when the white frames were taken,
    rising, and paper in them. Returns (L, 3) float64; ones where there are fewer than two white frames.
    """
    if len(white) < 2:
        return np.ones((len(at_s), 3))
    gains = np.ones((len(at_s), 3))
    for channel in range(3):
        gains[:, channel] = np.interp(at_s, white_at_s, white[:, channel] / white[0, channel])
    return gains
