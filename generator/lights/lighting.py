"""Illuminant of an image: a mixture of illuminants of the LUT, or several mixtures with masks.

`LightChoice` is the choice of illuminants for pictures; two simple choices are here, others are in
`generator.lights.choices`. Rules:

- The ground truth of a mixture is the same mixture of ground truths, because light adds.
- Weights of a mixture sum to 1. All samples contain stray light and read noise, so that with a larger sum both would
  be too large (`kernels.mixing`).
- Weights are multiples of 10⁻⁹, so that a label specifies the mixture exactly.
- The masks sum to 1 at each pixel, in multiples of 1/65535, so that a 16-bit file stores them without loss.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator import philox
from generator.kernels.mixing import mixed_table
from generator.kernels.rendering import WHOLE_LIGHT_PIXELS, read_light
from generator.kernels.unfit import colours_in
from generator.masks.making import MaskMaker

if TYPE_CHECKING:
    from calibration.table.lut import Lut

_BILLION: Final = 10**9  # Units of a weight; a label has nine decimals


@dataclass(frozen=True)
class Mixture:
    """A mixture of illuminants of a LUT, or a single illuminant with weight 1.

    Attributes
    ----------
    lights
        Indices in the LUT, ascending.
    weights
        Weights above 0 with the sum 1; they are rounded to billionths.

    Raises
    ------
    InputError
        If indices or weights are invalid.

    Examples
    --------
    >>> Mixture((12, 40), (0.25, 0.75)).label
    '12:0.25+40:0.75'
    """

    lights: tuple[int, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        ascending = all(low < high for low, high in zip(self.lights, self.lights[1:], strict=False))
        if not self.lights or len(self.lights) != len(self.weights) or not ascending or self.lights[0] < 0:
            raise InputError(
                f"illuminants {self.lights} with weights {self.weights} are not a mixture, expected ascending numbers "
                "and one weight for each; correct them"
            )
        if not all(0 < weight < np.inf for weight in self.weights) or abs(sum(self.weights) - 1) > 1e-6:
            raise InputError(
                f"the weights of a mixture are {self.weights}, expected numbers above 0 with the sum 1; correct them"
            )
        billionths = [max(1, round(weight * _BILLION)) for weight in self.weights]
        billionths[billionths.index(max(billionths))] += _BILLION - sum(billionths)
        object.__setattr__(self, "weights", tuple(count / _BILLION for count in billionths))

    @property
    def label(self) -> str:
        """The text of the column `illumination` of `ground_truth.csv`: ``12``, or ``12:0.25+40:0.75``."""
        if len(self.lights) == 1:
            return str(self.lights[0])
        pairs = zip(self.lights, self.weights, strict=True)
        return "+".join(f"{light}:{weight:.9f}".rstrip("0") for light, weight in pairs)

    def white(self, lut: Lut) -> npt.NDArray[np.float64]:
        """Return the ground truth (3,) float64: linear camera RGB of the achromatic reference, not normalised."""
        self._require(lut)
        return np.asarray(self.weights) @ lut.white[list(self.lights)]

    def samples(self, lut: Lut, seed: int = 0, picture: npt.NDArray[np.uint8] | None = None) -> npt.NDArray[np.uint16]:
        """Return the samples (8**bits, S, 3) uint16 of this illuminant, for `kernels.rendering.draw_samples`.

        If `picture` (H, W, 3) uint8 is given and small, samples of colours that it lacks may be 0.
        """
        self._require(lut)
        pixels = WHOLE_LIGHT_PIXELS if picture is None else picture.shape[0] * picture.shape[1]
        if len(self.lights) == 1:
            return read_light(lut, self.lights[0], pixels)
        colours = None
        if picture is not None and pixels < WHOLE_LIGHT_PIXELS:
            # For a large picture, finding its colours takes as long as mixing all of them.
            colours = colours_in(picture, lut.provenance.bits)
        tables = [lut.light_samples(light) for light in self.lights]
        return mixed_table(tables, self.weights, white_level=lut.provenance.white_level, seed=seed, colours=colours)

    def _require(self, lut: Lut) -> None:
        if self.lights[-1] >= len(lut.white):
            raise InputError(
                f"the LUT {lut.folder} has no illuminant {self.lights[-1]}; choose one of 0 to {len(lut.white) - 1}"
            )


@lru_cache(maxsize=1024)
def single_mixture(light: int) -> Mixture:
    """Return the mixture of one illuminant."""
    return Mixture((light,), (1.0,))


def mixture_of(shares: Mapping[int, float]) -> Mixture:
    """Return the mixture for shares ≥ 0 by illuminant number; shares that round to 0 are omitted."""
    total = sum(shares.values())
    used = {light: shares[light] / total for light in sorted(shares) if shares[light] / total * _BILLION >= 0.5}
    total = sum(used.values())
    return Mixture(tuple(used), tuple(weight / total for weight in used.values()))


def parse_mixture(label: str) -> Mixture:
    """Return the mixture of a label: ``12``, or ``12:0.25+40:0.75``."""
    if re.fullmatch(r"\d{1,9}", label, re.ASCII):
        return single_mixture(int(label))
    matches = [re.fullmatch(r"(\d{1,9}):(\d*\.?\d+)", term.strip(), re.ASCII) for term in label.split("+")]
    weights = {int(match[1]): float(match[2]) for match in matches if match}
    if len(weights) != len(matches) or not all(weights.values()):
        raise InputError(f"{label!r} is not a mixture of illuminants; write 12, or 12:0.25+40:0.75")
    ordered = sorted(weights)
    return Mixture(tuple(ordered), tuple(weights[light] for light in ordered))


@dataclass(frozen=True)
class Lighting:
    """The illuminants of one image."""

    mixtures: tuple[Mixture, ...]
    masks: MaskMaker | None = None  # None for one illuminant

    def __post_init__(self) -> None:
        if not self.mixtures or (self.masks is None) != (len(self.mixtures) == 1):
            raise InputError(
                f"{len(self.mixtures)} illuminants with{'out' if self.masks is None else ''} masks, expected one "
                "without, or several with masks; correct them"
            )

    def weights_of(self, height: int, width: int) -> npt.NDArray[np.float32]:
        """Return the weight of each illuminant in each pixel, (height, width, illuminants) float32, sum 1."""
        if self.masks is None:
            return np.ones((height, width, 1), np.float32)
        return self.masks.weights(height, width, len(self.mixtures))

    def whites(self, lut: Lut) -> npt.NDArray[np.float64]:
        """Return the ground truth of each illuminant, (illuminants, 3) float64, linear camera RGB, not normalised."""
        return np.array([mixture.white(lut) for mixture in self.mixtures])


@runtime_checkable
class LightChoice(Protocol):
    """Choice of illuminants; it depends only on the position of the picture in the list of sources and on a seed."""

    @property
    def lights_each(self) -> int:
        """Number of images of each picture."""
        ...

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position` (from 0) in the list of sources."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values for `dataset.json`.

        These values and the sources determine every byte of the data set.
        """
        ...


@dataclass(frozen=True)
class ListedLights:
    """The same illuminants for every picture: numbers in the LUT, or mixtures."""

    lights: tuple[int | Mixture, ...]

    @property
    def lights_each(self) -> int:
        """Number of images of each picture."""
        return len(self.lights)

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image; it does not depend on `position`."""
        del position
        mixtures = (light if isinstance(light, Mixture) else single_mixture(light) for light in self.lights)
        return tuple(Lighting((mixture,)) for mixture in mixtures)

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        lights = [light.label if isinstance(light, Mixture) else light for light in self.lights]
        return {"choice": "listed", "lights": lights}


@dataclass(frozen=True)
class RandomLights:
    """Random illuminants for each picture: `lights_each` different ones of `total`, all equally likely."""

    lights_each: int
    total: int
    seed: int

    def __post_init__(self) -> None:
        if not 1 <= self.lights_each <= self.total:
            raise InputError(
                f"the number of random illuminants of each picture is {self.lights_each}, expected 1 to {self.total}, "
                "the number in the LUT; correct it"
            )

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position`."""
        lights = philox.distinct(self.seed, self.lights_each, self.total, position, philox.LIGHTS)
        return tuple(Lighting((single_mixture(light),)) for light in lights)

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {"choice": "random", "count": self.lights_each}
