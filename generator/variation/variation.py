"""Variation of the images of a data set: exposure, fall-off of the light, and noise.

One pass (`exposing`) reduces the light towards one end of the image, scales the exposure and adds noise. Counts are
then rounded and clipped at saturation. Exposure and noise do not change the ground truth.

With fall-off, the light of a pixel is multiplied in each channel by

    (1 − w) + w · end,        0 < end ≤ 1,

where `end` is the light of the far end relative to the near end. w, 0 … 1, is a random mask for each image, like that
of a second illuminant (`generator.masks`). No pixel becomes brighter than the photographed light, so noise is added and
never removed. `end` is 2⁻ˢ for s stops, times a tint on request. Without a tint, the chromaticity of the light is equal
in all pixels. With a tint, the image has two illuminants of one name, with masks and maps as for several illuminants.

The factor of an exposure is random for each image, from the words of Philox with counter (0, 0, number of the image,
12). Automatic exposure sets the factor so that a share of the pixels reaches a level, as a camera does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator import philox
from generator.masks.making import MadeMasks, RandomStreams, Shape, SmoothFields, Weights, parse_shape
from generator.named_numbers import Range, parse_numbers
from generator.variation.exposing import brightness_reached, expose
from generator.variation.iso_speed import IsoSpeed
from generator.variation.sensor_noise import SensorNoise, measured_noise

if TYPE_CHECKING:
    from calibration.table.lut import Lut


Three = tuple[float, float, float]

_GRADIENT_OPTIONS: Final[dict[str, Range]] = {"stops": (0.0, 6.0), "least": (0.0, 6.0), "colour": (0.0, 1.0)}


@dataclass(frozen=True)
class Falloff:
    """Fall-off of the light of one image.

    - `masks`: (height, width, 2) weights of the near and the far end.
    - `end`: red, green and blue light of the far end relative to the near end, > 0 and ≤ 1.
    """

    masks: MadeMasks
    end: Three

    def weights(self, height: int, width: int) -> Weights:
        """Return (height, width, 2) float32, 0 … 1 in multiples of 1/65535, with sum 1 in each pixel."""
        return self.masks.weights(height, width, 2)


@dataclass(frozen=True)
class Gradient:
    """Random fall-off of the light.

    - `shape`: shape of the fall-off, as for masks of two illuminants.
    - `stops`, `min_stops`: the far end is darker by a random number of stops, uniform between `min_stops` and `stops`.
    - `colour`: largest difference of ln(R/G) and of ln(B/G) between far end and near end. The two differences
      are random, uniform and independent.
    """

    shape: Shape = SmoothFields()  # noqa: RUF009  frozen
    stops: float = 1.0
    min_stops: float = 0.0
    colour: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.min_stops <= self.stops < math.inf and 0 <= self.colour < math.inf):
            raise InputError(
                f"the gradient has {self.min_stops:g} to {self.stops:g} stops and colour {self.colour:g}, expected "
                "rising stops ≥ 0 and a colour ≥ 0"
            )

    def of_image(self, seed: int, number: int) -> Falloff:
        """Return the fall-off of image `number`, from words of Philox with counter (0, 64, number, 13)."""
        uniform = [(int(word) + 0.5) / (1 << 32) for word in philox.words(seed, 0, 64, number, philox.GRADIENTS)]
        level = 2.0 ** -(self.min_stops + (self.stops - self.min_stops) * uniform[0])
        red, blue = (math.exp(self.colour * (2 * value - 1)) for value in uniform[1:3])
        brightest = max(red, 1.0, blue)
        end = (level * red / brightest, level / brightest, level * blue / brightest)
        return Falloff(MadeMasks(self.shape, RandomStreams(seed, number, philox.GRADIENTS)), end)

    def describe(self) -> dict[str, Any]:
        """Return shape and numbers as plain values."""
        return {**self.shape.describe(), "stops": self.stops, "least": self.min_stops, "colour": self.colour}


def parse_gradient(text: str) -> Gradient:
    """Return the gradient of a text: a mask shape with its numbers, and ``stops``, ``least``, ``colour``."""
    shape_name, _, numbers_text = text.strip().partition(":")
    entries = [entry for entry in numbers_text.split(",") if entry.strip()]
    gradient_entries = [entry for entry in entries if entry.partition("=")[0].strip().lower() in _GRADIENT_OPTIONS]
    numbers = parse_numbers(",".join(gradient_entries), _GRADIENT_OPTIONS, f"the gradient {shape_name}")
    shape_entries = ",".join(entry for entry in entries if entry not in gradient_entries)
    shape = parse_shape(f"{shape_name}:{shape_entries}" if shape_entries else shape_name)
    stops = numbers.get("stops", max(Gradient.stops, numbers.get("least", 0.0)))
    return Gradient(shape, stops, numbers.get("least", Gradient.min_stops), numbers.get("colour", Gradient.colour))


# Default of the largest factor of automatic exposure: 3 stops, like the automatic ISO of cameras.
LARGEST_FACTOR: Final = 8.0

# Limits of an exposure in stops. At 2⁻¹² the whole range of a 14-bit sensor is within its noise; at 2⁶ only noise of
# the LUT is visible.
_STOPS: Range = (-12.0, 6.0)
# A normal distribution of stops is truncated at this many standard deviations, which removes 0.3 %
_TAIL_SIGMAS: Final = 3.0

_EXPOSURE_OPTIONS: Final[dict[str, dict[str, Range]]] = {
    "stops": {"low": _STOPS, "high": _STOPS},
    "normal": {"mean": _STOPS, "sd": (0.0, 6.0)},
    "clip": {"share": (0.0, 0.9), "most": (0.01, 64.0)},
    "level": {"share": (0.0, 0.9), "low": (0.001, 1.0), "high": (0.001, 1.0), "most": (0.01, 64.0)},
}


@dataclass(frozen=True)
class DrawnExposure:
    """Random factor, 2 to the power of stops; `stops` are quantiles at equally spaced probabilities.

    Between quantiles, stops are interpolated linearly. Two quantiles are a uniform distribution, one is a fixed factor.
    """

    stops: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_quantiles(self.stops, "stops of exposure")

    @property
    def metered_share(self) -> float | None:
        """Share of the brightest pixels on which the factor depends; None if the image has no influence."""
        return None

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor > 0 of image `number`.

        `brightness`: value relative to saturation that the largest channel reaches in the share `metered_share` of the
        pixels; ignored if this share is None.
        """
        del brightness
        return 2.0 ** _quantile(self.stops, _uniform(seed, number))

    def describe(self) -> dict[str, Any]:
        """Return kind and numbers as plain values."""
        return {"exposure": "stops", "quantiles": list(self.stops)}


@dataclass(frozen=True)
class NormalExposure:
    """Random factor, 2 to the power of stops that are normally distributed and truncated at 3 standard deviations."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and 0 <= self.sd < math.inf):
            raise InputError(f"the stops have mean {self.mean} and sd {self.sd}, expected finite numbers and sd ≥ 0")

    @property
    def metered_share(self) -> float | None:
        """None, because the factor does not depend on the image."""
        return None

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor of image `number`; see `DrawnExposure.factor`."""
        del brightness
        tail = NormalDist().cdf(-_TAIL_SIGMAS)
        probability = tail + (1 - 2 * tail) * _uniform(seed, number)
        return 2.0 ** (self.mean + self.sd * NormalDist().inv_cdf(probability))

    def describe(self) -> dict[str, Any]:
        """Return kind and numbers as plain values."""
        return {"exposure": "normal", "mean": self.mean, "sd": self.sd}


@dataclass(frozen=True)
class AutomaticExposure:
    """Automatic exposure: the factor at which a share of the pixels reaches a level.

    - `share`: share of the pixels whose largest channel reaches the level; with 0 no pixel reaches it.
    - `levels`: quantiles of the random level, relative to saturation, 0 … 1. Between quantiles, its logarithm is
      interpolated linearly. Level 1 saturates this share of the pixels.
    - `limit`: largest factor, so that a dark picture stays dark.
    """

    share: float
    levels: tuple[float, ...] = (1.0,)
    limit: float = LARGEST_FACTOR

    def __post_init__(self) -> None:
        _check_quantiles(self.levels, "levels of exposure")
        if not (0 <= self.share < 1 and min(self.levels) > 0 and max(self.levels) <= 1 and 0 < self.limit < math.inf):
            raise InputError(
                f"the exposure has share {self.share}, levels {self.levels} and most {self.limit}; expected a "
                "share ≥ 0 and < 1, levels > 0 and ≤ 1, and most > 0"
            )

    @property
    def metered_share(self) -> float | None:
        """Share of the pixels that reaches the level."""
        return self.share

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor of image `number`; see `DrawnExposure.factor`."""
        logarithms = tuple(math.log(level) for level in self.levels)
        level = math.exp(_quantile(logarithms, _uniform(seed, number)))
        return min(level / brightness, self.limit) if brightness > 0 else self.limit

    def describe(self) -> dict[str, Any]:
        """Return kind and numbers as plain values."""
        return {"exposure": "automatic", "share": self.share, "levels": list(self.levels), "most": self.limit}


# How the factor on the counts of each image is chosen
ExposureChoice = DrawnExposure | NormalExposure | AutomaticExposure


def parse_exposure(text: str) -> ExposureChoice:
    """Return the exposure of a text.

    A number is a factor. ``stops:low=-2,high=1`` is uniform in stops, ``normal:mean=-1,sd=0.5`` normally distributed.
    ``clip:share=0.01`` saturates 1 % of the pixels. ``level:share=0.01,low=0.3,high=0.9`` lets 1 % of the pixels reach
    a random level from 0.3 to 0.9 of saturation. ``most=4`` limits the factor of ``clip`` and ``level``.
    """
    kind, _, numbers_text = text.strip().partition(":")
    if kind not in _EXPOSURE_OPTIONS:
        return _parse_factor(text)
    values = parse_numbers(numbers_text, _EXPOSURE_OPTIONS[kind], f"the exposure {kind}")
    required = {"stops": ("low", "high"), "normal": ("mean", "sd"), "clip": ("share",), "level": ("share", "low")}[kind]
    missing = [name for name in required if name not in values]
    if missing:
        raise InputError(f"the exposure {text!r} lacks {' and '.join(missing)}; write for example {_EXAMPLES[kind]}")
    if "low" in values and values.get("high", values["low"]) < values["low"]:
        raise InputError(f"the exposure {text!r} has low above high; exchange them")
    if kind == "stops":
        return DrawnExposure((values["low"], values["high"]))
    if kind == "normal":
        return NormalExposure(values["mean"], values["sd"])
    levels = (1.0,) if kind == "clip" else (values["low"], values.get("high", values["low"]))
    return AutomaticExposure(values["share"], levels, values.get("most", LARGEST_FACTOR))


_EXAMPLES: Final = {
    "stops": "stops:low=-2,high=1",
    "normal": "normal:mean=-1,sd=0.5",
    "clip": "clip:share=0.01",
    "level": "level:share=0.01,low=0.3,high=0.9",
}


def _parse_factor(text: str) -> ExposureChoice:
    smallest, largest = (2.0**stops for stops in _STOPS)
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not smallest <= factor <= largest:
        raise InputError(
            f"the exposure is {text!r}, expected a factor from {smallest:.2g} to {largest:g}, or "
            f"{', '.join(_EXAMPLES.values())}"
        )
    return DrawnExposure((math.log2(factor),))


def _check_quantiles(quantiles: tuple[float, ...], name: str) -> None:
    ordered = all(low <= high for low, high in pairwise(quantiles))
    if not quantiles or not ordered or not all(map(math.isfinite, quantiles)):
        raise InputError(f"the {name} are {quantiles}, expected 1 or more rising numbers")


def _quantile(quantiles: tuple[float, ...], probability: float) -> float:
    steps: npt.NDArray[np.float64] = np.linspace(0.0, 1.0, len(quantiles))
    return float(np.interp(probability, steps, quantiles))


def _uniform(seed: int, number: int) -> float:
    return (int(philox.words(seed, 0, 0, number, philox.EXPOSURES)[0]) + 0.5) / (1 << 32)


# Number of trials of automatic exposure. They are needed because noise lets more pixels reach the level. For 60
# photographs at ISO 3200 and a share of 0.02, two trials gave the share within 0.5 %. Without trials, up to 3.8 times
# as many pixels reached the level.
_TRIALS: Final = 2
_LARGEST_COUNT: Final = 65535  # Largest 16-bit count
_EVEN_LIGHT: Final[Three] = (1.0, 1.0, 1.0)  # Far end of even light


@dataclass(frozen=True, eq=False)
class AppliedVariation:
    """The variation of one image.

    - `details`: values for the columns of `images.csv`.
    - `weights`: (H, W, 2) float32, weights of the near and the far end in each pixel; None for even light.
    - `end`: light of the far end relative to the near end, by channel.
    """

    details: dict[str, int | float | str] = field(default_factory=dict[str, int | float | str])
    weights: npt.NDArray[np.float32] | None = None
    end: Three = _EVEN_LIGHT

    def intensity(self) -> npt.NDArray[np.float32] | None:
        """Return the light relative to the near end, (H, W) float32, for a far end without tint."""
        if self.weights is None:
            return None
        return np.float32(1) - self.weights[..., 1] * np.float32(1 - self.end[1])


@dataclass(frozen=True)
class Variation:
    """Differences between images; at least one of exposure, gradient and ISO speed is set.

    - `exposure`: amount of light; None for the exposure of the LUT.
    - `gradient`: fall-off over the image; None for even light.
    - `iso`: ISO speed that determines the noise; None for the speed of the LUT.
    - `noise`: noise of the samples of the LUT; see `variation_of`.
    """

    exposure: ExposureChoice | None = None
    gradient: Gradient | None = None
    iso: IsoSpeed | None = None
    noise: SensorNoise = field(kw_only=True)

    def __post_init__(self) -> None:
        if self.exposure is None and self.gradient is None and self.iso is None:
            raise InputError("a variation has no exposure, gradient or ISO speed, expected 1 or more; set one")

    @property
    def tints(self) -> bool:
        """Whether the colour of the light varies over an image; such images have maps of the illuminant."""
        return self.gradient is not None and self.gradient.colour > 0

    def apply(self, image: npt.NDArray[np.uint16], white_level: int, seed: int, number: int) -> AppliedVariation:
        """Change an image in place and return the applied variation.

        `image`: (H, W, 3) uint16, contiguous, counts as drawn from the LUT.
        """
        noise = self.noise
        details: dict[str, int | float | str] = {}
        weights, far_end = None, _EVEN_LIGHT
        if self.gradient is not None:
            falloff = self.gradient.of_image(seed, number)
            weights, far_end = falloff.weights(*image.shape[:2]), falloff.end
            details |= dict(zip(("end_r", "end_g", "end_b"), far_end, strict=True))
        iso_ratio, electrons = (1.0, None) if self.iso is None else (self.iso.ratio, self.iso.sensor_electrons)
        target_noise = noise if electrons is None else noise.at(iso_ratio, electrons)

        def expose_with(factor: float, saturation: int, out: npt.NDArray[np.uint16]) -> float:
            return expose(
                image,
                factor,
                noise,
                target_noise=target_noise,
                iso_ratio=iso_ratio,
                weights=weights,
                far_end=far_end,
                white_level=saturation,
                seed=seed,
                number=number,
                out=out,
            )

        factor = 1.0
        if self.exposure is not None:
            metered_share, brightness = self.exposure.metered_share, 0.0
            if metered_share is not None:
                brightness = brightness_reached(image, metered_share, weights, far_end) / white_level
            factor = self.exposure.factor(seed, number, brightness)
            if metered_share is not None and (factor < 1 or weights is not None or self.iso is not None):
                # Noise raises the level that the brightest pixels reach, so it is included in the metering.
                trial = np.empty_like(image)
                for _ in range(_TRIALS):
                    expose_with(factor, _LARGEST_COUNT, trial)
                    brightness = brightness_reached(trial, metered_share) / white_level / factor
                    factor = self.exposure.factor(seed, number, brightness)
            details["exposure"] = factor
        if self.iso is not None:
            # A factor above the ISO ratio has the noise of a higher ISO speed.
            details["iso"] = self.iso.base * max(iso_ratio, factor)
        details["clipped"] = expose_with(factor, white_level, image)
        return AppliedVariation(details, weights, far_end)

    def describe(self) -> dict[str, Any]:
        """Return the set options as plain values for `dataset.json`; they determine every byte of the images."""
        options = {"exposure": self.exposure, "gradient": self.gradient, "iso": self.iso, "noise": self.noise}
        return {name: option.describe() for name, option in options.items() if option is not None}


def variation_of(
    lut: Lut, exposure: ExposureChoice | None = None, gradient: Gradient | None = None, iso: IsoSpeed | None = None
) -> Variation:
    """Return the variation of images of a LUT and measure its noise; at least one option must be given."""
    return Variation(exposure, gradient, iso, noise=measured_noise(lut))
