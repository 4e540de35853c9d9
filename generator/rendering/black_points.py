"""The print's own black, taken out of what the camera saw of it.

A print is never black: its surface scatters a few hundredths of the light, which lies on every colour like a veil.
With b what the camera sees of the chart's black cell under a light and W the light's white, a share v of it is taken
out of a sample x, channel by channel::

    y = (x - v b) / (1 - v b / W)

White stays W to the last bit, so the ground truth is the same; a share of 1 makes the mean of black 0. Rules that hold
inside:

- Signal and noise are stretched alike, by 1 / (1 - v b / W), some hundredths: the noise is else left as it was.
- Counts have no sign (calibration.sampling clips them at 0), and noise around a black that was taken out would
  have one. Cut off at 0, black would be too bright by .4 σ. So of a cell with samples below 0 these become 0, and all
  above are lowered by one number that keeps the cell's mean. Where a cell is darker than what is taken out, it is 0.
- Rounding keeps the mean of a cell: each sample takes over what rounding the one before has left.
- Of images rendered by codes the black cell's b is taken out whole, its tint included. Rendered by colour, black is not
  that cell: it was mapped to the darkest grey that the print shows, which is brighter. There b is that grey, of
  every light on the image, so that a share of 1 undoes the mapping and greys stay grey.
- What is saturated stays saturated: with W above the white level, the white level is taken for it.
- Several lights on a pixel: each light's samples lose that light's veil before they are mixed, since light adds. To
  take the veil out of the mixture instead is the same where b / W is that of all its lights, and else differs by less
  than .0005 of white for lights whose b / W are .03 and .045.

Source: black point compensation scales between two black points and a common white (ISO 18619:2015, clause 5.2), here
in the linear counts of a camera.
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

# Largest random share unless said otherwise. Chosen: with it, learned methods did best on real photographs, of shares
# that others had tried (docs/transfer.md); real scenes have some veil of their own.
MOST: Final = 0.97

_HALVINGS: Final = 40  # Steps to find what samples above 0 are lowered by: to 2⁻²⁴ counts

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BlackPoint:
    """What becomes of the print's black.

    - `kind`: ``"keep"``: nothing; ``"compensate"``: all of it is taken out; ``"random"``: of each image a random share.
    - `most`: largest random share, above 0 and at most 1.

    Raises `InputError`: the largest share is out of range.

    Examples
    --------
    >>> BlackPoint("compensate").share(seed=0, image=7), BlackPoint().share(seed=0, image=7)
    (1.0, 0.0)
    """

    kind: Literal["keep", "compensate", "random"] = "keep"
    most: float = MOST

    def __post_init__(self) -> None:
        if not 0 < self.most <= 1:
            raise InputError(
                f"the largest share of the print's black is {self.most:g}, expected a number above 0 and at most 1"
            )

    @property
    def label(self) -> str:
        """The text that `parse_black_point` makes it of."""
        return f"random:{self.most:g}" if self.kind == "random" else self.kind

    def share(self, seed: int, image: int) -> float:
        """Return the share of the print's black that is taken out of an image, 0 … 1; a function of seed and number."""
        # Words that nothing is drawn from take as long as the rest of a small image's bookkeeping.
        words = philox.words(seed, 0, 0, image, philox.VEILS)[0] if self.kind == "random" else np.zeros((), np.uint32)
        return float(self.shares(words))

    def shares(self, words: npt.NDArray[np.uint32]) -> _Array:
        """Return the shares (...) float64 for random words (...) uint32."""
        if self.kind == "random":
            return self.most * (np.asarray(words, np.float64) / 2.0**32)
        return np.full(np.shape(words), 1.0 if self.kind == "compensate" else 0.0)


KEEP: Final = BlackPoint()  # The print's black is kept


def parse_black_point(text: str) -> BlackPoint:
    """Return what an option asks for: ``keep``, ``compensate``, ``random``, or ``random:MAX``."""
    for kind in ("keep", "compensate"):
        if text == kind:
            return BlackPoint(kind)
    match = re.fullmatch(r"random(?::(\d*\.?\d+))?", text, re.ASCII)
    if not match:
        raise InputError(f"the black point is {text!r}, expected keep, compensate, random, or random:MAX such as .97")
    return BlackPoint("random", float(match[1] or MOST))


@dataclass(frozen=True, eq=False)
class Veil:
    """What is taken out of the samples of a light, and what the rest is multiplied by.

    - `taken`: (3,) float64 ≥ 0, counts: v b.
    - `stretch`: (3,) float64 ≥ 1: 1 / (1 - v b / W).
    """

    taken: _Array
    stretch: _Array


def black_of(lut: Lut, light: Mixture) -> _Array:
    """Return what the camera sees of the chart's black cell under a light: (3,) float64, counts, the samples' mean.

    Where the table lists black as unfit, it is that of the nearest fit cell.
    """
    light.white(lut)
    unfit = sorted({cell.colour for cell in lut.provenance.unfit})
    cell = int(nearest_fit_colours(unfit, lut.provenance.bits)[0]) if unfit and unfit[0] == 0 else 0
    means = [lut.samples[number, cell].mean(axis=0, dtype=np.float64) for number in light.lights]
    return np.asarray(light.weights) @ np.array(means)


def veil_of(lut: Lut, light: Mixture, share: float, grey: float | None = None) -> Veil:
    """Return what taking out a share of the print's black means under a light.

    `share`: 0 … 1. `grey`: what black was mapped to, over the light's white, of images rendered by colour
    (`ColorimetricRendering.black`); None for the black cell.
    """
    black = black_of(lut, light) if grey is None else grey * light.white(lut)
    white = np.minimum(light.white(lut), lut.provenance.white_level)
    if (2 * black >= white).any():
        shown = " ".join(f"{part:.3g}" for part in black / white)
        raise QualityError(
            f"under light {light.label} the table {lut.folder} has a black of {shown} of white (red, green, blue), "
            "expected less than half: leave the light out, or keep the black point"
        )
    taken = share * black
    return Veil(taken, 1 / (1 - taken / white))


def without_veil(
    samples: npt.NDArray[np.uint16],
    veil: Veil,
    white_level: int,
    colours: npt.NDArray[np.bool_] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the samples of a light without a share of the print's black; the rules stand at the head of this file.

    `samples`: (8**bits, S, 3) uint16, linear camera RGB of the light. `colours`: (8**bits,) bool, which colours are
    wanted; None for all. Samples of the others are 0. Returns (8**bits, S, 3) uint16.
    """
    out = np.zeros(samples.shape, np.uint16)
    chosen = np.arange(len(samples)) if colours is None else np.flatnonzero(colours)
    _take_out(np.asarray(samples), veil.taken, veil.stretch, float(white_level), chosen, out)
    return out


@compiled
def _lowering(values: Any, count: int) -> float:
    """Return what the values above 0 are to be lowered by so that they, cut off at 0, keep the mean of all."""
    total, high = 0.0, 0.0
    for i in range(count):
        total += values[i]
        high = max(high, values[i])
    if total <= 0.0:
        return high
    low = 0.0
    for _ in range(_HALVINGS):
        middle, kept = (low + high) / 2, 0.0
        for i in range(count):
            kept += max(values[i] - middle, 0.0)
        if kept > total:
            low = middle
        else:
            high = middle
    return high


@compiled
def _take_out(samples: Any, taken: Any, stretch: Any, white: float, chosen: Any, out: Any) -> None:
    count = samples.shape[1]
    values = np.empty(count)
    for colour in chosen:
        for channel in range(3):
            least = 0.0
            for i in range(count):
                values[i] = (samples[colour, i, channel] - taken[channel]) * stretch[channel]
                least = min(least, values[i])
            lowered = _lowering(values, count) if least < 0.0 else 0.0
            left = 0.0
            for i in range(count):
                if values[i] >= white:
                    out[colour, i, channel] = np.uint16(white)
                    continue
                wanted = max(values[i] - lowered, 0.0) + left
                rounded = min(max(math.floor(wanted + 0.5), 0.0), white)
                left = wanted - rounded
                out[colour, i, channel] = np.uint16(rounded)
