"""All that makes one image of a dataset differ from the plain picture of a print: a value, and what it does.

In this order: the light falls off, then it is exposed, then noise is what it would have been, then counts are rounded
and cut at saturation. All of it happens in one pass (`exposing`). The ground truth is the light's, which neither
exposure nor noise changes.

Where light falls off, the light of a pixel is that of the image times, in each channel,

    (1 − w) + w · end,        0 < end ≤ 1,

where w, 0 … 1, is the mask of a second light (`generator.masks`), drawn anew for each image. So nowhere is it brighter
than the light that was photographed, and noise can always be added to what it was. The end is 2 to the power of minus
some stops, times the tint where one is asked for.

Where the end has no tint, the chromaticity of the light is the same in every pixel, and the ground truth is that of
the light. With a tint the image has two lights of one name, and masks and maps as other images of several lights have.

The factor of an exposure is drawn for each image from the words of Philox with counter (0, 0, number of the image,
12), or chosen by the image itself, as a camera's automatic exposure does: so that a share of its pixels reaches a
level.
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
    """The uneven light of one image.

    - `masks`: (height, width, 2) weights of the light itself, and of its far end.
    - `end`: red, green and blue light at the far end over that of the image, above 0 up to 1.
    """

    masks: MadeMasks
    end: Three

    def weights(self, height: int, width: int) -> Weights:
        """Return (height, width, 2) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
        return self.masks.weights(height, width, 2)


@dataclass(frozen=True)
class Gradient:
    """How light falls off on each image.

    - `shape`: where, as of the masks of two lights.
    - `stops`, `least`: the far end is darker by a number of stops between `least` and `stops`, each as likely.
    - `colour`: most that ln(R/G) and ln(B/G) of the far end differ from those of the light, each drawn evenly and on
      its own.
    """

    shape: Shape = SmoothFields()  # noqa: RUF009  frozen
    stops: float = 1.0
    least: float = 0.0
    colour: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.least <= self.stops < math.inf and 0 <= self.colour < math.inf):
            raise InputError(
                f"a gradient of {self.least:g} to {self.stops:g} stops and colour {self.colour:g} was asked for; "
                "expected rising stops from 0, and a colour from 0"
            )

    def of_image(self, seed: int, number: int) -> Falloff:
        """Return the uneven light of image `number`: words of Philox with counter (0, 64, number, 13), masks below."""
        drawn = [(int(word) + 0.5) / (1 << 32) for word in philox.words(seed, 0, 64, number, philox.GRADIENTS)]
        level = 2.0 ** -(self.least + (self.stops - self.least) * drawn[0])
        red, blue = (math.exp(self.colour * (2 * place - 1)) for place in drawn[1:3])
        most = max(red, 1.0, blue)
        end = (level * red / most, level / most, level * blue / most)
        return Falloff(MadeMasks(self.shape, RandomStreams(seed, number, philox.GRADIENTS)), end)

    def describe(self) -> dict[str, Any]:
        """Return the shape and the numbers as plain values."""
        return {**self.shape.describe(), "stops": self.stops, "least": self.least, "colour": self.colour}


def parse_gradient(text: str) -> Gradient:
    """Return the gradient that a text names: a kind of masks with its numbers, and ``stops``, ``least``, ``colour``."""
    kind, _, rest = text.strip().partition(":")
    entries = [entry for entry in rest.split(",") if entry.strip()]
    own = [entry for entry in entries if entry.partition("=")[0].strip().lower() in _GRADIENT_OPTIONS]
    numbers = parse_numbers(",".join(own), _GRADIENT_OPTIONS, f"the gradient {kind}")
    others = ",".join(entry for entry in entries if entry not in own)
    shape = parse_shape(f"{kind}:{others}" if others else kind)
    stops = numbers.get("stops", max(Gradient.stops, numbers.get("least", 0.0)))
    return Gradient(shape, stops, numbers.get("least", Gradient.least), numbers.get("colour", Gradient.colour))


# Largest factor of an automatic exposure unless said otherwise: 3 stops, as cameras' own limits of automatic ISO.
MOST: Final = 8.0

# Least and most stops: 2⁻¹² of a 14-bit sensor's range is within its noise, 2⁶ shows nothing but the table's noise.
_STOPS: Range = (-12.0, 6.0)
_TAILS: Final = 3.0  # Standard deviations at which a normal distribution of stops is cut, 0.3 % of it

_EXPOSURE_OPTIONS: Final[dict[str, dict[str, Range]]] = {
    "stops": {"low": _STOPS, "high": _STOPS},
    "normal": {"mean": _STOPS, "sd": (0.0, 6.0)},
    "clip": {"share": (0.0, 0.9), "most": (0.01, 64.0)},
    "level": {"share": (0.0, 0.9), "low": (0.001, 1.0), "high": (0.001, 1.0), "most": (0.01, 64.0)},
}


@dataclass(frozen=True)
class DrawnExposure:
    """A factor of 2 to the power of stops, drawn by quantiles: of probability 0 … 1 in even steps, linear between.

    Two quantiles are an even distribution between them, one is a fixed factor.
    """

    stops: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_quantiles(self.stops, "stops of exposure")

    @property
    def seen(self) -> float | None:
        """Share of an image's brightest pixels that the factor depends on: None, the image does not matter."""
        return None

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor > 0 of image `number`.

        `brightness`: largest channel, over saturation, that the share `seen` of the pixels reaches; any number where
        that is None.
        """
        del brightness
        return 2.0 ** _quantile(self.stops, _uniform(seed, number))

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"exposure": "stops", "quantiles": list(self.stops)}


@dataclass(frozen=True)
class NormalExposure:
    """A factor of 2 to the power of stops from a normal distribution, cut at 3 standard deviations."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and 0 <= self.sd < math.inf):
            raise InputError(f"stops of mean {self.mean} and sd {self.sd} were asked for, expected numbers, sd from 0")

    @property
    def seen(self) -> float | None:
        """None: the image does not matter."""
        return None

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor of image `number`; see `DrawnExposure.factor`."""
        del brightness
        tail = NormalDist().cdf(-_TAILS)
        place = tail + (1 - 2 * tail) * _uniform(seed, number)
        return 2.0 ** (self.mean + self.sd * NormalDist().inv_cdf(place))

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"exposure": "normal", "mean": self.mean, "sd": self.sd}


@dataclass(frozen=True)
class AutomaticExposure:
    """The factor with which a share of the pixels reaches a level: automatic exposure.

    - `share`: of the pixels, the brightest by their largest channel; 0 lets none reach the level.
    - `levels`: over saturation, 0 … 1: quantiles that each image's level is drawn by, as of `DrawnExposure`, in the
      logarithm. Level 1 clips that share.
    - `most`: largest factor, so that a dark picture stays dark.
    """

    share: float
    levels: tuple[float, ...] = (1.0,)
    most: float = MOST

    def __post_init__(self) -> None:
        _check_quantiles(self.levels, "levels of exposure")
        if not (0 <= self.share < 1 and min(self.levels) > 0 and max(self.levels) <= 1 and 0 < self.most < math.inf):
            raise InputError(
                f"an exposure of share {self.share}, levels {self.levels} and most {self.most} was asked for; expected "
                "a share from 0 and below 1, levels above 0 up to 1, and a factor above 0"
            )

    @property
    def seen(self) -> float | None:
        """The share of the pixels."""
        return self.share

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor of image `number`; see `DrawnExposure.factor`."""
        logarithms = tuple(math.log(level) for level in self.levels)
        level = math.exp(_quantile(logarithms, _uniform(seed, number)))
        return min(level / brightness, self.most) if brightness > 0 else self.most

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"exposure": "automatic", "share": self.share, "levels": list(self.levels), "most": self.most}


ExposureChoice = DrawnExposure | NormalExposure | AutomaticExposure  # The factor on the counts of each image


def parse_exposure(text: str) -> ExposureChoice:
    """Return the exposure that a text names.

    A number is a factor; ``stops:low=-2,high=1`` draws evenly in stops, ``normal:mean=-1,sd=.5`` normally;
    ``clip:share=.01`` clips that share of the pixels; ``level:share=.01,low=.3,high=.9`` lets that share of them reach
    a level between those, over saturation. ``most=4`` limits the factor of the last two.
    """
    kind, _, rest = text.strip().partition(":")
    if kind not in _EXPOSURE_OPTIONS:
        return _fixed(text)
    given = parse_numbers(rest, _EXPOSURE_OPTIONS[kind], f"the exposure {kind}")
    needed = {"stops": ("low", "high"), "normal": ("mean", "sd"), "clip": ("share",), "level": ("share", "low")}[kind]
    missing = [name for name in needed if name not in given]
    if missing:
        raise InputError(f"the exposure {text!r} lacks {' and '.join(missing)}; write for example {_EXAMPLES[kind]}")
    if "low" in given and given.get("high", given["low"]) < given["low"]:
        raise InputError(f"the exposure {text!r}: low is above high; exchange them")
    if kind == "stops":
        return DrawnExposure((given["low"], given["high"]))
    if kind == "normal":
        return NormalExposure(given["mean"], given["sd"])
    levels = (1.0,) if kind == "clip" else (given["low"], given.get("high", given["low"]))
    return AutomaticExposure(given["share"], levels, given.get("most", MOST))


_EXAMPLES: Final = {
    "stops": "stops:low=-2,high=1",
    "normal": "normal:mean=-1,sd=.5",
    "clip": "clip:share=.01",
    "level": "level:share=.01,low=.3,high=.9",
}


def _fixed(text: str) -> ExposureChoice:
    least, most = (2.0**stops for stops in _STOPS)
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not least <= factor <= most:
        raise InputError(
            f"{text!r} is no exposure; write a factor from {least:.2g} to {most:g}, or {', '.join(_EXAMPLES.values())}"
        )
    return DrawnExposure((math.log2(factor),))


def _check_quantiles(quantiles: tuple[float, ...], what: str) -> None:
    ordered = all(low <= high for low, high in pairwise(quantiles))
    if not quantiles or not ordered or not all(map(math.isfinite, quantiles)):
        raise InputError(f"the {what} are {quantiles}, expected one or more rising numbers")


def _quantile(quantiles: tuple[float, ...], place: float) -> float:
    steps: npt.NDArray[np.float64] = np.linspace(0.0, 1.0, len(quantiles))
    return float(np.interp(place, steps, quantiles))


def _uniform(seed: int, number: int) -> float:
    """Return a number between 0 and 1."""
    return (int(philox.words(seed, 0, 0, number, philox.EXPOSURES)[0]) + 0.5) / (1 << 32)


# Exposures tried until the share of the pixels that reach a level is the one asked for, noise included: of 60
# photographs at ISO 3200 a share of .02 was .85 to 3.8 times as large without, within 3 % with one, .5 % with two.
_TRIALS: Final = 2
_LARGEST: Final = 65535  # Largest value of 16 bits
_EVEN: Final[Three] = (1.0, 1.0, 1.0)  # Light that is the same everywhere


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
    """What differs from image to image; something is set.

    - `exposure`: how much light; None as the table.
    - `gradient`: how it falls off over the image; None not at all.
    - `iso`: ISO speed whose noise images have; None the table's.
    - `noise`: of the table's samples; see `varied_by`.
    """

    exposure: ExposureChoice | None = None
    gradient: Gradient | None = None
    iso: IsoSpeed | None = None
    noise: SensorNoise = field(kw_only=True)

    def __post_init__(self) -> None:
        if self.exposure is None and self.gradient is None and self.iso is None:
            raise InputError("a variation has neither exposure, gradient nor ISO speed; set one, or give no variation")

    @property
    def tints(self) -> bool:
        """Whether the light of an image changes its colour over it, so that images have maps of it."""
        return self.gradient is not None and self.gradient.colour > 0

    def apply(self, image: npt.NDArray[np.uint16], white_level: int, seed: int, number: int) -> Varied:
        """Change an image in place and return what was done to it.

        `image`: (H, W, 3) uint16, contiguous; counts of the table, as drawn.
        """
        noise = self.noise
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


def varied_by(
    lut: Lut, exposure: ExposureChoice | None = None, gradient: Gradient | None = None, iso: IsoSpeed | None = None
) -> Variation:
    """Return the variation of images of a table, whose noise is measured; one of the three must be given."""
    return Variation(exposure, gradient, iso, noise=measured_noise(lut))
