"""What was done to the counts of a table, in words and numbers, as `lut.json` records it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from experiment.framing.planes import CLIPPING_SHARE
from experiment.measures.paper import FlatField

_Array = npt.NDArray[np.float64]


def corrections(
    page_mm: tuple[float, float],
    black: _Array,
    saturation_counts: int,
    fields: Sequence[FlatField],
    *,
    measured: bool = False,
    gains: _Array | None = None,
    subtracted: _Array | None = None,
    at_zero: _Array | None = None,
) -> list[dict[str, Any]]:
    """Return what was done to the counts, in order, for `lut.json`.

    `black`: (L, 2, 2) float64 counts, black level of each light's frame. `saturation_counts`: raw count of saturation.
    `gains`: (L, 3) the lamp's drift at each light; None without white frames. `subtracted`: (L, 3) counts, dark light
    of bare paper that was subtracted; None where none was to be. `at_zero`: (L,) share of each light's samples that are
    0; None where it was not counted.
    """
    done: list[dict[str, Any]] = [
        {
            "name": "black",
            "how": "subtracted: mean of the frame's masked border for each position of the 2x2 block, "
            "or the metadata's where no border is masked",
            "unit": "counts",
            "per_light": np.round(black, 3).tolist(),
        },
        {
            "name": "half size",
            "how": "R, mean of both G, B of each 2x2 block; nothing interpolated",
        },
        *([] if subtracted is None else [_dark_correction(subtracted)]),
        {
            "name": "saturation",
            "how": f"cells with a count of {CLIPPING_SHARE:g} of it or more are unfit",
            "unit": "raw counts",
            "value": saturation_counts,
            "from": "measured: photosites of this session reached it"
            if measured
            else "the raw files' statement, which may be too high, as no photosite of a cell came near; "
            "no sample is affected, but white_level may be",
        },
        {
            "name": "field",
            "how": "samples and ground truth divided by F(x, y), the value at the cell's centre for its 25 samples; "
            "F is the product of its factors, each sum c[k] P_i(u) P_j(v) over total orders 0, 1, 2 ..., "
            "(i, j) = (n, 0), (n-1, 1) ... (0, n) within an order n, P Legendre, u = 2x/w - 1, v = 2y/h - 1, "
            "x, y millimetres on a page of w x h; mean of F over the cells' centres = 1; multiply to undo",
            "page_mm": list(page_mm),
            "per_light": [field.parameters() for field in fields],
        },
        {
            "name": "rounding",
            "how": "to the nearest integer, negative values to 0, which lifts the mean of cells as dark as their "
            "noise, by 0.4 standard deviations of a sample at most; the ground truth is neither rounded nor cut",
            **({} if at_zero is None else {"share_at_zero": np.round(at_zero, 6).tolist()}),
        },
    ]
    if gains is not None:
        done.append(
            {
                "name": "drift",
                "applied": False,
                "how": "the lamp's light over that of the first white frame, linear in time between white frames; "
                "not applied: divide samples and ground truth of a light by it to have all lights of one lamp",
                "per_light": np.round(gains, 6).tolist(),
            }
        )
    return done


def applied_drift(gains: _Array) -> dict[str, Any]:
    """Return the entry of a drift that was taken out, gains (L, 3) float64, which stands last as it was done last."""
    return {
        "name": "drift",
        "applied": True,
        "how": "samples, ground truth and references of a light divided by it, channel by channel: the lamp's light "
        "over that of the brightest white frame, linear in time between white frames, 1 at most; the k-th of S samples "
        "v became floor(v / gain + ((11 k mod S) + 0.5) / S), which no other v becomes, so that it can be undone "
        "exactly (calibration.radiometry.drift.as_measured)",
        "per_light": gains.tolist(),
    }


def _dark_correction(subtracted: _Array) -> dict[str, Any]:
    return {
        "name": "dark",
        "how": "subtracted from samples, ground truth and references before the field is divided out: the light of the "
        "last dark frame before (projector's leak and the room's), which is at a patch that of bare paper times the "
        "dark frame's field times the patch's reflectance under white, corrected by what patches show beyond that in "
        "the dark frames so far, as far as it is more than noise; here that of bare paper, field divided out",
        "unit": "counts",
        "per_light": np.round(subtracted, 4).tolist(),
    }
