"""All that makes one image of a dataset differ from the plain picture of a print: a value, and what it does.

In this order: the light falls off, then it is exposed, then noise is what it would have been, then counts are rounded
and cut at saturation. All of it happens in one pass (`exposing`). The ground truth is the light's, which neither
exposure nor noise changes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator.variation.exposing import brightness_reached, expose
from generator.variation.exposures import ExposureChoice
from generator.variation.gradients import Gradient
from generator.variation.iso_speed import IsoSpeed
from generator.variation.sensor_noise import SensorNoise, measured_noise

if TYPE_CHECKING:
    from calibration.table.lut import Lut

Three = tuple[float, float, float]

_TRIALS: Final = 2
"""Exposures tried until the share of the pixels that reach a level is the one asked for, noise included: of 60
photographs at ISO 3200 a share of .02 was .85 to 3.8 times as large without, within 3 % with one, .5 % with two."""
_LARGEST: Final = 65535
"""Largest value of 16 bits."""
_EVEN: Final[Three] = (1.0, 1.0, 1.0)
"""Light that is the same everywhere."""


@dataclass(frozen=True, eq=False)
class Varied:
    """What was done to an image.

    - `details`: for `images.csv`.
    - `weights`: (H, W, 2) float32, how much of each pixel's light is that of the near and the far end; None if it is
      even.
    - `end`: light of the far end over that of the near one, of each channel.
    """

    details: dict[str, int | float | str] = field(default_factory=dict[str, int | float | str])
    weights: npt.NDArray[np.float32] | None = None
    end: Three = _EVEN

    def intensity(self) -> npt.NDArray[np.float32] | None:
        """Return the light of each pixel over that of the near end, (H, W) float32, of an end without a tint."""
        if self.weights is None:
            return None
        return np.float32(1) - self.weights[..., 1] * np.float32(1 - self.end[1])


@dataclass(frozen=True)
class Variation:
    """What differs from image to image; without anything set, nothing.

    - `exposure`: how much light; None as the table.
    - `gradient`: how it falls off over the image; None not at all.
    - `iso`: ISO speed whose noise images have; None the table's.
    - `noise`: of the table's samples; needed with any of the others. See `varied_by`.
    """

    exposure: ExposureChoice | None = None
    gradient: Gradient | None = None
    iso: IsoSpeed | None = None
    noise: SensorNoise | None = None

    def __post_init__(self) -> None:
        if self.is_on and self.noise is None:
            raise InputError(
                "the noise of the table is not known, which exposure, gradient and ISO speed need; measure it with "
                "generator.variation.sensor_noise.measured_noise"
            )

    @property
    def is_on(self) -> bool:
        """Whether anything is done to images."""
        return not (self.exposure is None and self.gradient is None and self.iso is None)

    @property
    def tints(self) -> bool:
        """Whether the light of an image changes its colour over it, so that images have maps of it."""
        return self.gradient is not None and self.gradient.colour > 0

    def apply(self, image: npt.NDArray[np.uint16], white_level: int, seed: int, number: int) -> Varied:
        """Change an image in place and return what was done to it.

        `image`: (H, W, 3) uint16, contiguous; counts of the table, as drawn.
        """
        noise = self.noise
        if not self.is_on or noise is None:
            return Varied()
        details: dict[str, int | float | str] = {}
        weights, end = None, _EVEN
        if self.gradient is not None:
            falloff = self.gradient.of_image(seed, number)
            weights, end = falloff.weights(*image.shape[:2]), falloff.end
            details |= dict(zip(("end_r", "end_g", "end_b"), end, strict=True))
        ratio, electrons = (1.0, None) if self.iso is None else (self.iso.ratio, self.iso.sensor_electrons)
        wanted = noise if electrons is None else noise.at(ratio, electrons)

        def exposed(factor: float, saturation: int, out: npt.NDArray[np.uint16]) -> float:
            """Fill `out` with the image exposed anew; return the share of its pixels at saturation."""
            return expose(
                image,
                factor,
                noise,
                wanted=wanted,
                ratio=ratio,
                weights=weights,
                end=end,
                white_level=saturation,
                seed=seed,
                number=number,
                out=out,
            )

        factor = 1.0
        if self.exposure is not None:
            seen, brightness = self.exposure.seen, 0.0
            if seen is not None:
                brightness = brightness_reached(image, seen, weights, end) / white_level
            factor = self.exposure.factor(seed, number, brightness)
            if seen is not None and (factor < 1 or weights is not None or self.iso is not None):
                # Noise lifts what the brightest pixels reach, so what they reach with it decides.
                trial = np.empty_like(image)
                for _ in range(_TRIALS):
                    exposed(factor, _LARGEST, trial)
                    brightness = brightness_reached(trial, seen) / white_level / factor
                    factor = self.exposure.factor(seed, number, brightness)
            details["exposure"] = factor
        if self.iso is not None:
            # With more light than the wanted speed allows, the noise is that of a higher one.
            details["iso"] = self.iso.base * max(ratio, factor)
        details["clipped"] = exposed(factor, white_level, image)
        return Varied(details, weights, end)

    def describe(self) -> dict[str, Any]:
        """Return what is set as plain values for `dataset.json`: enough to make every byte again."""
        parts = {"exposure": self.exposure, "gradient": self.gradient, "iso": self.iso, "noise": self.noise}
        return {name: part.describe() for name, part in parts.items() if part is not None}


NO_VARIATION: Final = Variation()
"""Images as the table gives them."""


def varied_by(
    lut: Lut, exposure: ExposureChoice | None = None, gradient: Gradient | None = None, iso: IsoSpeed | None = None
) -> Variation:
    """Return the variation of images of a table, whose noise is measured if anything is set."""
    if exposure is None and gradient is None and iso is None:
        return NO_VARIATION
    return Variation(exposure, gradient, iso, measured_noise(lut))
