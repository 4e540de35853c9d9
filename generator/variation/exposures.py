"""How much light an image was exposed to, as a factor on the counts of the table.

A factor is drawn for each image from the words of Philox with counter (0, 0, number of the image, 12), or chosen by the
image itself, as a camera's automatic exposure does: so that a share of its pixels reaches a level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator import philox
from generator.named_numbers import Range, parse_numbers

MOST: Final = 8.0
"""Largest factor of an automatic exposure unless said otherwise: 3 stops, as cameras' own limits of automatic ISO."""

_STOPS: Range = (-12.0, 6.0)
"""Least and most stops: 2⁻¹² of a 14-bit sensor's range is within its noise, 2⁶ shows nothing but the table's noise."""
_TAILS: Final = 3.0
"""Standard deviations at which a normal distribution of stops is cut, 0.3 % of it."""

_OPTIONS: Final[dict[str, dict[str, Range]]] = {
    "stops": {"low": _STOPS, "high": _STOPS},
    "normal": {"mean": _STOPS, "sd": (0.0, 6.0)},
    "clip": {"share": (0.0, 0.9), "most": (0.01, 64.0)},
    "level": {"share": (0.0, 0.9), "low": (0.001, 1.0), "high": (0.001, 1.0), "most": (0.01, 64.0)},
}


class ExposureChoice(Protocol):
    """The factor on the counts of each image."""

    @property
    def seen(self) -> float | None:
        """Share of an image's brightest pixels that the factor depends on; None where it does not."""
        ...

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor > 0 of image `number`.

        `brightness`: largest channel, over saturation, that the share `seen` of the pixels reaches; any number where
        that is None.
        """
        ...

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers as plain values."""
        ...


@dataclass(frozen=True)
class DrawnExposure:
    """A factor of 2 to the power of stops, drawn by quantiles: of probability 0 … 1 in even steps, linear between.

    Two quantiles are an even distribution between them, one is a fixed factor.

    Examples
    --------
    >>> round(DrawnExposure((-1.0, -1.0)).factor(seed=0, number=7, brightness=0.0), 3)
    0.5
    """

    stops: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_quantiles(self.stops, "stops of exposure")

    @property
    def seen(self) -> float | None:
        """None: the image does not matter."""
        return None

    def factor(self, seed: int, number: int, brightness: float) -> float:
        """Return the factor of image `number`; see `ExposureChoice.factor`."""
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
        """Return the factor of image `number`; see `ExposureChoice.factor`."""
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

    Examples
    --------
    >>> AutomaticExposure(share=0.01, levels=(1.0,)).factor(seed=0, number=0, brightness=0.25)
    4.0
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
        """Return the factor of image `number`; see `ExposureChoice.factor`."""
        logarithms = tuple(math.log(level) for level in self.levels)
        level = math.exp(_quantile(logarithms, _uniform(seed, number)))
        return min(level / brightness, self.most) if brightness > 0 else self.most

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"exposure": "automatic", "share": self.share, "levels": list(self.levels), "most": self.most}


def parse_exposure(text: str) -> ExposureChoice:
    """Return the exposure that a text names.

    A number is a factor; ``stops:low=-2,high=1`` draws evenly in stops, ``normal:mean=-1,sd=.5`` normally;
    ``clip:share=.01`` clips that share of the pixels; ``level:share=.01,low=.3,high=.9`` lets that share of them reach
    a level between those, over saturation. ``most=4`` limits the factor of the last two.

    Examples
    --------
    >>> parse_exposure("stops:low=-2,high=1")
    DrawnExposure(stops=(-2.0, 1.0))
    >>> parse_exposure("clip:share=.01")
    AutomaticExposure(share=0.01, levels=(1.0,), most=8.0)
    """
    kind, _, rest = text.strip().partition(":")
    if kind not in _OPTIONS:
        return _fixed(text)
    given = parse_numbers(rest, _OPTIONS[kind], f"the exposure {kind}")
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
