"""Source pictures drawn so that together they are like a real data set.

Each picture gets a weight by which all of them together have the target's distribution of luminance, chroma and
grey-world offset (`balancing`). Pictures are then drawn by systematic sampling (L. Kish, Survey Sampling, 1965): each
as often as its weight says, rounded up or down at random, so that a good one may come several times and is then printed
under another light each time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator import philox
from generator.likeness.balancing import LEAST_EFFECTIVE, balance, effective_size
from generator.likeness.pictures import MeasuredPictures
from generator.pictures.sources import Source, SourcePicture
from generator.statistics.statistics_file import RealStatistics

_Array = npt.NDArray[np.float64]

BY_QUANTILES: Final = ("luminance_1", "luminance_50", "luminance_95", "chroma_spread")
"""Numbers of images that are brought to the target's 10th, 25th, 50th, 75th and 90th percentiles: data sets are
compared by medians of these, and their distributions have long tails."""

BY_SPREAD: Final = ("grey_red", "grey_blue")
"""Numbers of images that are brought to the target's mean and standard deviation: grey-world offsets, whose spread is
what a method cannot know, and of which data sets are compared by these two."""

TITLES: Final = {
    "luminance_1": "Luminance, 1st percentile",
    "luminance_50": "Luminance, 50th percentile",
    "luminance_95": "Luminance, 95th percentile",
    "chroma_spread": "Chroma spread",
    "grey_offset_red": "Grey-world offset, red",
    "grey_spread_red": "Grey-world spread, red",
    "grey_offset_blue": "Grey-world offset, blue",
    "grey_spread_blue": "Grey-world spread, blue",
}
"""Figures as the tables of `evaluate describe` call them, which stands above this package."""

_PERCENTS: Final = (10, 25, 50, 75, 90)
"""Percentiles that are matched: the middle, and what five images of a thousand decide is left out."""

_LEAST_IMAGES: Final = 3
"""Real images: of fewer there is no spread."""

_FEW: Final = 30
"""Real images below which a percentile of 10 or 90 hangs on three of them."""

_TOLERANCE: Final = 0.25
"""Share by which figures may differ and still be called alike, as in `evaluate describe`: a convention."""


@dataclass(frozen=True)
class Reached:
    """What became of one figure.

    - `name`: as the figures of `evaluate describe` are called: "chroma_spread", "grey_offset_red", "grey_spread_red".
    - `wanted`, `before`, `after`: of the real data set; of the pictures, each once; of those drawn.
    - `scale`: what a difference is measured by: the wanted spread for an offset, the wanted value for others.
    """

    name: str
    wanted: float
    before: float
    after: float
    scale: float

    @property
    def is_alike(self) -> bool:
        """Whether the figure of the pictures drawn is within a quarter of the wanted one."""
        if self.name.startswith("grey_offset"):
            return abs(self.after - self.wanted) <= _TOLERANCE * self.scale
        return self.wanted > 0 and 1 / (1 + _TOLERANCE) <= self.after / self.wanted <= 1 + _TOLERANCE

    def sentence(self) -> str:
        """Return in one line what became of it."""
        end = "" if self.is_alike else ", not within 25 %"
        figures = f"{self.before:.3g} of all pictures, {self.after:.3g} drawn, {self.wanted:.3g} wanted"
        return f"{TITLES[self.name]}: {figures}{end}"


@dataclass(frozen=True, eq=False)
class DrawnPictures:
    """Which pictures are drawn.

    - `weights`: (N,) float64 ≥ 0, sum 1, of all pictures.
    - `places`: (M,) int64 ascending, the pictures drawn, those of more than one draw repeated.
    - `reached`: what became of each figure.
    - `blacks`: (M,) float64, the share of the print's black, 0 … 1, that is taken out of each draw; None where options
      say it.
    """

    weights: _Array
    places: npt.NDArray[np.int64]
    reached: tuple[Reached, ...]
    blacks: npt.NDArray[np.float64] | None = None

    @property
    def effective(self) -> float:
        """Effective sample size of the weights."""
        return effective_size(self.weights)

    @property
    def distinct(self) -> int:
        """How many different pictures are drawn."""
        return len(np.unique(self.places))

    def describe(self) -> dict[str, Any]:
        """Return what `dataset.json` records."""
        black = {} if self.blacks is None else {"black_taken": _short(float(self.blacks.mean()))}
        return {
            **black,
            "measured": int((self.weights > 0).sum()),
            "drawn": len(self.places),
            "distinct": self.distinct,
            "effective": _short(self.effective),
            "figures": {
                made.name: {"wanted": _short(made.wanted), "before": _short(made.before), "after": _short(made.after)}
                for made in self.reached
            },
        }

    def sentences(self) -> list[str]:
        """Return what is to be told of it, a line each."""
        head = (
            f"{len(self.places)} draws of {self.distinct} pictures, of {int((self.weights > 0).sum())} measured; their "
            f"weights are worth {self.effective:.0f} equal ones"
        )
        black: list[str] = []
        if self.blacks is not None:
            low, middle, high = np.percentile(self.blacks, (10, 50, 90), method="hazen")
            told = f"{middle:.2f} in the median, {low:.2f} to {high:.2f} of eight images of ten"
            black.append(f"share of the print's black taken out: {told}")
        return [head, *black, *(made.sentence() for made in self.reached)]


@dataclass(frozen=True, eq=False, slots=True)
class WeightedPicture:
    """A source picture with its weight, 1 being that of a picture that is neither favoured nor disfavoured.

    With it the share of the print's black, 0 … 1, that is taken out of its images, where it was drawn with one.
    """

    source: Source
    weight: float
    black_taken: float | None = None

    @property
    def name(self) -> str:
        """The picture's name in the dataset; draws of one picture share it."""
        return self.source.name

    def read(self) -> SourcePicture:
        """Return the picture with its weight; errors as of the source."""
        return replace(self.source.read(), weight=self.weight, black_taken=self.black_taken)

    def to_json(self) -> dict[str, Any]:
        """Return as a JSON object how the picture is made or read, and its weight."""
        black = {} if self.black_taken is None else {"black_taken": self.black_taken}
        return {**self.source.to_json(), "weight": self.weight, **black}


def draw_pictures(
    measured: MeasuredPictures,
    target: RealStatistics,
    count: int | None,
    seed: int,
    least_effective: float = LEAST_EFFECTIVE,
) -> DrawnPictures:
    """Return which of N pictures are drawn to be like a real data set; purpose 15 of `philox`.

    `count`: how many are drawn; None for as many as can be used. `least_effective`: least effective share of the
    pictures.
    """
    names = (*BY_QUANTILES, *BY_SPREAD)
    real = {name: target.known(name) for name in names}
    fewest = min(real, key=lambda name: len(real[name]))
    if len(real[fewest]) < _LEAST_IMAGES:
        raise InputError(
            f"{target.file} has {fewest} of {len(real[fewest])} images, expected {_LEAST_IMAGES} or more to choose "
            "pictures by; describe more images, or leave pictures out of --like-in"
        )
    usable = ~measured.unreadable
    for name in names:
        usable &= np.isfinite(measured.values.get(name, np.full(len(usable), np.nan)))
    if not usable.any():
        raise InputError(f"none of the {len(usable)} pictures can be read or has a colour; name others with --sources")
    if count is not None and count < 1:
        raise InputError(f"{count} pictures are to be drawn, expected 1 or more")
    variants = measured.variants
    # A picture counts with all its shares of black, or not at all.
    usable = np.repeat(usable.reshape(-1, variants).all(axis=1), variants)
    pictures = {name: measured.values[name][usable] for name in names}
    weights = np.zeros(len(usable))
    weights[usable] = _weights(pictures, real, least_effective, variants)
    places = _systematic(weights, count or int(usable.sum()) // variants, seed)
    reached: list[Reached] = []
    for name in names:
        reached += _reached(name, real[name], pictures[name], measured.values[name][places])
    blacks = np.array(measured.shares)[places % variants] if measured.shares else None
    of_pictures = weights.reshape(-1, variants).sum(axis=1)
    return DrawnPictures(of_pictures, places // variants, tuple(reached), blacks)


def drawn_sources(sources: Sequence[Source], drawn: DrawnPictures) -> tuple[WeightedPicture, ...]:
    """Return the sources that were drawn, with their weights; sources drawn more than once are repeated."""
    relative = drawn.weights * (drawn.weights > 0).sum()
    places: list[int] = drawn.places.tolist()
    blacks: list[float | None] = [None] * len(places) if drawn.blacks is None else drawn.blacks.tolist()
    return tuple(
        WeightedPicture(sources[place], _short(float(relative[place])), black)
        for place, black in zip(places, blacks, strict=True)
    )


def cautions(target: RealStatistics) -> list[str]:
    """Return what makes a target less to be trusted than it looks."""
    told: list[str] = []
    if target.may_be_encoded:
        told.append(
            f"the images of {target.name} are in the median {float(np.median(target.known('luminance_50'))):.2f} as "
            "bright as their highlights, raw ones about .15 to .2: if they are encoded for a display, describe linear "
            "ones"
        )
    if target.images < _FEW:
        told.append(f"{target.name} has {target.images} images: what they are like is known roughly, and followed so")
    return told


def _weights(
    pictures: Mapping[str, _Array], real: Mapping[str, _Array], least_effective: float, variants: int
) -> _Array:
    """Return the weights of pictures by their moments and those of real images."""
    columns = [_moments(name, pictures[name], real[name]) for name in pictures]
    moments = np.concatenate([column for column, _ in columns], axis=1)
    wanted = np.concatenate([column.mean(axis=0) for _, column in columns])
    return balance(moments, wanted, min(map(len, real.values())), least_effective, variants).weights


def _moments(name: str, pictures: _Array, real: _Array) -> tuple[_Array, _Array]:
    """Return the moments (N, K) and (M, K) of a number of pictures and of real images."""
    if name in BY_SPREAD:
        spread = float(real.std()) or float(pictures.std()) or 1.0
        both = [(values - real.mean()) / spread for values in (pictures, real)]
        return np.stack([both[0], both[0] ** 2], axis=1), np.stack([both[1], both[1] ** 2], axis=1)
    borders = np.percentile(real, _PERCENTS, method="hazen")
    return (pictures[:, None] <= borders).astype(np.float64), (real[:, None] <= borders).astype(np.float64)


def _systematic(weights: _Array, count: int, seed: int) -> npt.NDArray[np.int64]:
    """Return `count` places ascending, each as often as its weight says, rounded up or down by one random number."""
    word = int(philox.words(seed, 0, 0, 0, philox.PICTURES)[0])
    marks = (np.arange(count) + (word + 0.5) / (1 << 32)) / count
    places = np.searchsorted(np.cumsum(weights) / weights.sum(), marks)
    return np.minimum(places, np.flatnonzero(weights)[-1]).astype(np.int64)


def _reached(name: str, real: _Array, before: _Array, after: _Array) -> list[Reached]:
    if name in BY_SPREAD:
        colour = name.removeprefix("grey_")
        means = (float(values.mean()) for values in (real, before, after))
        spreads = tuple(float(values.std()) for values in (real, before, after))
        return [
            Reached(f"grey_offset_{colour}", *means, scale=spreads[0]),
            Reached(f"grey_spread_{colour}", *spreads, scale=spreads[0]),
        ]
    medians = tuple(float(np.median(values)) for values in (real, before, after))
    return [Reached(name, *medians, scale=medians[0])]


def _short(value: float) -> float:
    """Return a number with six significant digits: other machines find the same, whatever their last bits."""
    return float(f"{value:.6g}")
