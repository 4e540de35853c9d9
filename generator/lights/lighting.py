"""The light on a picture: a mixture of the table's lights, or several mixtures, each in its part of the picture.

And which falls on which picture (`LightChoice`): lights that are listed, or drawn from the table's, stand here, others
in `generator.lights.choices`.

Light adds, so a mixture with weights from 0 is a real light, its ground truth the same mixture of the ground truths.
Rules that hold inside:

- The weights of a mixture sum to 1. So it is as bright as its lights are and never brighter than the brightest, the
  stray light of an exposure is in the mixture once, and the noise is that of one exposure (`kernels.mixed_table`).
- Weights are whole billionths, so that a label gives back the mixture to the last bit.
- What masks give for a pixel sums to 1 in whole 65535ths, so that a 16-bit file holds it without loss.
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

_BILLION: Final = 10**9  # Parts of a weight: as many decimals as a label has


@dataclass(frozen=True)
class Mixture:
    """Lights of a table shining together; one light of weight 1 is that light as it was photographed.

    - `lights`: numbers in the table, ascending.
    - `weights`: above 0, sum 1; rounded to billionths when made.

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
                f"lights {self.lights} with weights {self.weights} are no mixture: expected ascending numbers, a "
                "weight each"
            )
        if not all(0 < weight < np.inf for weight in self.weights) or abs(sum(self.weights) - 1) > 1e-6:
            raise InputError(f"the weights {self.weights} of a mixture are to be above 0 and sum to 1")
        parts = [max(1, round(weight * _BILLION)) for weight in self.weights]
        parts[parts.index(max(parts))] += _BILLION - sum(parts)
        object.__setattr__(self, "weights", tuple(part / _BILLION for part in parts))

    @property
    def label(self) -> str:
        """Return the text of the column `illumination` of `ground_truth.csv`: ``12``, or ``12:0.25+40:0.75``."""
        if len(self.lights) == 1:
            return str(self.lights[0])
        pairs = zip(self.lights, self.weights, strict=True)
        return "+".join(f"{light}:{weight:.9f}".rstrip("0") for light, weight in pairs)

    def white(self, lut: Lut) -> npt.NDArray[np.float64]:
        """Return the ground truth (3,) float64: linear camera RGB of the achromatic reference, not normalised."""
        self._require(lut)
        return np.asarray(self.weights) @ lut.white[list(self.lights)]

    def samples(self, lut: Lut, seed: int = 0, picture: npt.NDArray[np.uint8] | None = None) -> npt.NDArray[np.uint16]:
        """Return the samples (8**bits, S, 3) uint16 of this light, as `kernels.rendering.draw_samples` takes them.

        `picture`: (H, W, 3) uint8, the picture they are for: of a small one, samples of other colours may be 0, and a
        light alone is not read whole. None: any pictures, of any size.
        """
        self._require(lut)
        pixels = WHOLE_LIGHT_PIXELS if picture is None else picture.shape[0] * picture.shape[1]
        if len(self.lights) == 1:
            return read_light(lut, self.lights[0], pixels)
        colours = None
        if picture is not None and pixels < WHOLE_LIGHT_PIXELS:
            # To find the colours of a large picture takes as long as to mix all.
            colours = colours_in(picture, lut.provenance.bits)
        tables = [lut.light_samples(light) for light in self.lights]
        return mixed_table(tables, self.weights, white_level=lut.provenance.white_level, seed=seed, colours=colours)

    def _require(self, lut: Lut) -> None:
        if self.lights[-1] >= len(lut.white):
            raise InputError(
                f"there is no light {self.lights[-1]}; the table {lut.folder} has lights 0 to {len(lut.white) - 1}"
            )


@lru_cache(maxsize=1024)
def plain(light: int) -> Mixture:
    """Return light number `light` alone: a mixture of one."""
    return Mixture((light,), (1.0,))


def mixture_of(parts: Mapping[int, float]) -> Mixture:
    """Return the mixture of lights in the proportion of `parts` ≥ 0 (light to share); shares of 0 are left out."""
    total = sum(parts.values())
    kept = {light: parts[light] / total for light in sorted(parts) if parts[light] / total * _BILLION >= 0.5}
    total = sum(kept.values())
    return Mixture(tuple(kept), tuple(weight / total for weight in kept.values()))


def parse_mixture(label: str) -> Mixture:
    """Return the mixture that a `Mixture.label` names: ``12``, or ``12:0.25+40:0.75``."""
    if re.fullmatch(r"\d{1,9}", label, re.ASCII):
        return plain(int(label))
    matches = [re.fullmatch(r"(\d{1,9}):(\d*\.?\d+)", part.strip(), re.ASCII) for part in label.split("+")]
    parts = {int(match[1]): float(match[2]) for match in matches if match}
    if len(parts) != len(matches) or not all(parts.values()):
        raise InputError(f"{label!r} is no mixture of lights; write a light such as 12, or 12:0.25+40:0.75")
    ordered = sorted(parts)
    return Mixture(tuple(ordered), tuple(parts[light] for light in ordered))


@dataclass(frozen=True)
class Lighting:
    """The light of one image.

    - `mixtures`: the lights in it.
    - `masks`: where each falls; None where one light falls on everything.
    """

    mixtures: tuple[Mixture, ...]
    masks: MaskMaker | None = None

    def __post_init__(self) -> None:
        if not self.mixtures or (self.masks is None) != (len(self.mixtures) == 1):
            raise InputError(
                f"{len(self.mixtures)} lights with{'out' if self.masks is None else ''} masks make no lighting; "
                "expected one light, or several and masks that say where each falls"
            )

    def weights_of(self, height: int, width: int) -> npt.NDArray[np.float32]:
        """Return the share of each light in each pixel: (height, width, lights) float32, sum 1 in whole 65535ths."""
        if self.masks is None:
            return np.ones((height, width, 1), np.float32)
        return self.masks.weights(height, width, len(self.mixtures))

    def whites(self, lut: Lut) -> npt.NDArray[np.float64]:
        """Return the ground truth of each light, (lights, 3) float64, linear camera RGB, not normalised."""
        return np.array([mixture.white(lut) for mixture in self.mixtures])


@runtime_checkable
class LightChoice(Protocol):
    """Which light falls on each source picture: a function of its position in the list of sources, and of a seed."""

    @property
    def lights_each(self) -> int:
        """Images for each picture."""
        ...

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position` (from 0) in the list of sources."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values for `dataset.json`: enough to make every byte again."""
        ...


@dataclass(frozen=True)
class ListedLights:
    """The same lights for every picture: numbers of the table's lights, or mixtures of them."""

    lights: tuple[int | Mixture, ...]

    @property
    def lights_each(self) -> int:
        """Images for each picture."""
        return len(self.lights)

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image; `position` does not matter."""
        del position
        mixtures = (light if isinstance(light, Mixture) else plain(light) for light in self.lights)
        return tuple(Lighting((mixture,)) for mixture in mixtures)

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        lights = [light.label if isinstance(light, Mixture) else light for light in self.lights]
        return {"choice": "listed", "lights": lights}


@dataclass(frozen=True)
class RandomLights:
    """`lights_each` distinct lights of `total` for each picture, every set equally likely; purpose 1 of `philox`."""

    lights_each: int
    total: int
    seed: int

    def __post_init__(self) -> None:
        if not 1 <= self.lights_each <= self.total:
            raise InputError(
                f"{self.lights_each} random lights a picture were asked for; the table has {self.total}, expected 1 to "
                "that"
            )

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position`."""
        lights = philox.distinct(self.seed, self.lights_each, self.total, position, philox.LIGHTS)
        return tuple(Lighting((plain(light),)) for light in lights)

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {"choice": "random", "count": self.lights_each}
