"""Subtract the black of the print from samples.

A print is never black: its surface scatters a few percent of the light, which is added to every colour. Let b be the
counts of the black patch under an illuminant and W the white of the illuminant. A share v of b is subtracted from a
sample x, channel by channel::

    y = (x - v b) / (1 - v b / W)

W is unchanged, so the ground truth is the same. With v = 1 the mean of black becomes 0. Signal and noise are multiplied
by the same factor 1 / (1 - v b / W), which is a few percent above 1. If W exceeds the saturation level, the saturation
level is used instead of W, so that saturated samples stay saturated.

If images are rendered by codes, b is the mean of the black patch, including its tint. If they are rendered by colour,
black was mapped to the darkest grey of the print, and b is this grey under the illuminant of the image. A share of 1
then reverses the mapping, and greys stay grey.

If several illuminants are mixed, the black of each is subtracted before mixing. Subtraction after mixing gives the same
result if b / W is equal for all of them. For b / W of 0.03 and 0.045, it differs by less than 0.0005 of white.

Source: black point compensation (ISO 18619:2015, clause 5.2), here in linear counts of a camera.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from foundation.errors import InputError, QualityError
from generator import philox
from generator.kernels.unfit import nearest_fit_colours

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.lights.lighting import Mixture

# Default of the largest random share. In earlier work, it gave the lowest errors of learned methods on real photographs
# (docs/transfer.md). It is below 1 because real scenes have some stray light, too.
LARGEST_SHARE: Final = 0.97

_BISECTIONS: Final = 40  # Bisection steps for the offset in `_clipping_offset`: resolution 2⁻²⁴ counts

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BlackPoint:
    """Treatment of the print's black.

    - `kind`: share of the black that is subtracted. ``"keep"``: 0; ``"compensate"``: 1; ``"random"``: random for each
      image.
    - `largest_share`: largest random share, above 0 and at most 1.

    Raises `InputError` if the largest share is out of range.

    Examples
    --------
    >>> BlackPoint("compensate").share(seed=0, image=7), BlackPoint().share(seed=0, image=7)
    (1.0, 0.0)
    """

    kind: Literal["keep", "compensate", "random"] = "keep"
    largest_share: float = LARGEST_SHARE

    def __post_init__(self) -> None:
        if not 0 < self.largest_share <= 1:
            raise InputError(
                f"the largest share of the print's black is {self.largest_share:g}, expected a number > 0 and ≤ 1; "
                "correct it"
            )

    @property
    def label(self) -> str:
        """The text from which `parse_black_point` makes this value."""
        return f"random:{self.largest_share:g}" if self.kind == "random" else self.kind

    def share(self, seed: int, image: int) -> float:
        """Return the share of the print's black that is subtracted from an image, 0 … 1."""
        # Random words are drawn only for a random share: they take as long as all other bookkeeping of a small image.
        words = philox.words(seed, 0, 0, image, philox.VEILS)[0] if self.kind == "random" else np.zeros((), np.uint32)
        return float(self.shares(words))

    def shares(self, words: npt.NDArray[np.uint32]) -> _Array:
        """Return the shares (...) float64 for random words (...) uint32."""
        if self.kind == "random":
            return self.largest_share * (np.asarray(words, np.float64) / 2.0**32)
        return np.full(np.shape(words), 1.0 if self.kind == "compensate" else 0.0)


KEEP: Final = BlackPoint()  # Nothing is subtracted


def parse_black_point(text: str) -> BlackPoint:
    """Return the black point of a text: ``keep``, ``compensate``, ``random``, or ``random:MAX``."""
    for kind in ("keep", "compensate"):
        if text == kind:
            return BlackPoint(kind)
    match = re.fullmatch(r"random(?::(\d*\.?\d+))?", text, re.ASCII)
    if not match:
        raise InputError(
            f"the black point is {text!r}, expected keep, compensate, random, or random:MAX such as random:0.97; "
            "correct it"
        )
    return BlackPoint("random", float(match[1] or LARGEST_SHARE))


@dataclass(frozen=True, eq=False)
class BlackSubtraction:
    """Counts to subtract from the samples of an illuminant, and the factor on the difference.

    - `counts`: (3,) float64 ≥ 0, v b.
    - `stretch`: (3,) float64 ≥ 1, 1 / (1 - v b / W).
    """

    counts: _Array
    stretch: _Array


def black_cell_counts(lut: Lut, light: Mixture) -> _Array:
    """Return the mean counts of the black patch under an illuminant, (3,) float64.

    If the LUT lists black as unfit, the nearest fit patch is used.
    """
    light.white(lut)
    unfit = sorted({cell.colour for cell in lut.provenance.unfit})
    cell = int(nearest_fit_colours(unfit, lut.provenance.bits)[0]) if unfit and unfit[0] == 0 else 0
    means = [lut.samples[number, cell].mean(axis=0, dtype=np.float64) for number in light.lights]
    return np.asarray(light.weights) @ np.array(means)


def black_subtraction(lut: Lut, light: Mixture, share: float, grey: float | None = None) -> BlackSubtraction:
    """Return the subtraction that removes a share of the print's black from samples.

    `share`: 0 … 1. `grey`: grey to which black was mapped, relative to white, for images rendered by colour
    (`ColorimetricRendering.black`); None for the black patch.
    """
    black = black_cell_counts(lut, light) if grey is None else grey * light.white(lut)
    white = np.minimum(light.white(lut), lut.provenance.white_level)
    if (2 * black >= white).any():
        ratios = " ".join(f"{ratio:.3g}" for ratio in black / white)
        raise QualityError(
            f"under illuminant {light.label} the LUT {lut.folder} has a black of {ratios} × white (red, green, blue), "
            "expected less than 0.5; leave the illuminant out, or keep the black point"
        )
    subtracted = share * black
    return BlackSubtraction(subtracted, 1 / (1 - subtracted / white))


def subtract_black(
    samples: npt.NDArray[np.uint16],
    subtraction: BlackSubtraction,
    white_level: int,
    colours: npt.NDArray[np.bool_] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the samples of an illuminant without a share of the print's black.

    `samples`: (8**bits, S, 3) uint16, linear camera RGB. `colours`: (8**bits,) bool, colours to compute, None for all;
    samples of other colours are 0. Returns (8**bits, S, 3) uint16.
    """
    out = np.zeros(samples.shape, np.uint16)
    chosen_colours = np.arange(len(samples)) if colours is None else np.flatnonzero(colours)
    _subtract(np.asarray(samples), subtraction.counts, subtraction.stretch, float(white_level), chosen_colours, out)
    return out


@compiled
def _clipping_offset(values: Any, count: int) -> float:
    # Returns the offset to subtract from values before they are clipped at 0, so that clipping keeps their mean.
    # Without the offset, black would be too bright by 0.4 σ. If the mean is not above 0, all values become 0.
    total, upper = 0.0, 0.0
    for i in range(count):
        total += values[i]
        upper = max(upper, values[i])
    if total <= 0.0:
        return upper
    lower = 0.0
    for _ in range(_BISECTIONS):
        middle, remaining = (lower + upper) / 2, 0.0
        for i in range(count):
            remaining += max(values[i] - middle, 0.0)
        if remaining > total:
            lower = middle
        else:
            upper = middle
    return upper


@compiled
def _subtract(samples: Any, subtracted: Any, stretch: Any, white: float, chosen_colours: Any, out: Any) -> None:
    count = samples.shape[1]
    values = np.empty(count)
    for colour in chosen_colours:
        for channel in range(3):
            smallest = 0.0
            for i in range(count):
                values[i] = (samples[colour, i, channel] - subtracted[channel]) * stretch[channel]
                smallest = min(smallest, values[i])
            offset = _clipping_offset(values, count) if smallest < 0.0 else 0.0
            # Each sample takes over the rounding remainder of the previous one, which keeps the mean of the patch.
            remainder = 0.0
            for i in range(count):
                if values[i] >= white:
                    out[colour, i, channel] = np.uint16(white)
                    continue
                exact = max(values[i] - offset, 0.0) + remainder
                rounded = min(max(math.floor(exact + 0.5), 0.0), white)
                remainder = exact - rounded
                out[colour, i, channel] = np.uint16(rounded)
