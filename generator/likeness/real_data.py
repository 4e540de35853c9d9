"""Generated data made like a real data set: its pictures, its exposure, its size.

Each source picture is measured as the camera would see it, and gets a weight by which all of them together have the
target's distribution of luminance, chroma and grey-world offset (`balance`). Pictures are then drawn by systematic
sampling (L. Kish, Survey Sampling, 1965): each as often as its weight says, rounded up or down at random, so that a
good one may come several times and is then printed under another light each time.

Entropy balancing gives the weights (J. Hainmueller, "Entropy balancing for causal effects", Political Analysis 20
(2012) 25-46): of all that give the wanted moments, those nearest to equal ones (least Kullback-Leibler divergence).
They are exponentials of a sum of the moments, each times a multiplier. The wanted moments are means over M real images
and known so well only: multipliers have a normal prior of spread 1, which M images overrule (S. F. Chen, R. Rosenfeld,
"A Gaussian prior for smoothing maximum entropy models", CMU-CS-99-108, 1999). Of few real images little is learned, and
weights stay nearer to equal.

What is left of images is told by the effective sample size, (Σw)² / Σw² (Kish): as many equally weighted images would
give means as precise. If it falls below a floor, the multipliers are bounded, ever more narrowly until it does not. A
moment that hardly any image has cannot then take the weights from those that can be met: a bounded multiplier is a
price by the missing share instead of a condition.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.compiled import ordered_map
from foundation.errors import FormatError, InputError
from generator import philox
from generator.pictures.sources import Source, SourcePicture
from generator.statistics import CELLS, RealStatistics, cell_means, log_chroma, numbers_of_cells
from generator.variation.variation import AutomaticExposure

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.dataset.plan import DatasetOptions

_Array = npt.NDArray[np.float64]

LEAST_EFFECTIVE: Final = 0.2
"""Least effective share of images: chosen. With a fifth, a mean over a thousand pictures is as precise as one over two
hundred, the size of the real sets that they are made like; each picture counts about five times at most typically."""

_BOUNDS: Final = tuple(float(bound) for bound in np.geomspace(8, 0.01, 40))
"""Bounds of the multipliers that are tried, widest first: a moment of 1 more may count e⁸ times as much, that is
freely, down to 1 %, that is hardly."""


def effective_size(weights: _Array) -> float:
    """Return Kish's effective sample size of weights (N,) float64 ≥ 0."""
    return float(weights.sum() ** 2 / np.square(weights).sum())


def balance(
    moments: _Array, wanted: _Array, real: float, least_effective: float = LEAST_EFFECTIVE, variants: int = 1
) -> _Array:
    """Return the weights (N,) float64 of images, sum 1, by which their moments' means come near to the wanted ones.

    `moments`: (N, K) float64, the moments of each image. `wanted`: (K,) float64, their wanted means. `least_effective`:
    least effective sample size as a share of the images, 0 … 1.
    """
    aside = moments - wanted
    penalty, least = 1 / real, least_effective * len(moments) / variants

    def is_enough(weights: _Array) -> bool:
        return effective_size(weights.reshape(-1, variants).sum(axis=1)) >= least

    free = _dual(aside, penalty, np.zeros(len(wanted)), None)
    found = _exponentials(aside, free)
    if is_enough(found):
        return found
    best, low, high = np.full(len(moments), 1 / len(moments)), 0, len(_BOUNDS) - 1
    while low <= high:
        middle = (low + high) // 2
        found = _exponentials(aside, _dual(aside, penalty, free, _BOUNDS[middle]))
        if is_enough(found):
            best, high = found, middle - 1
        else:
            low = middle + 1
    return best


def _exponentials(aside: _Array, multipliers: _Array) -> _Array:
    exponents = aside @ multipliers
    parts = np.exp(exponents - exponents.max())
    return parts / parts.sum()


def _dual(aside: _Array, penalty: float, start: _Array, bound: float | None) -> _Array:
    """Return the multipliers (K,) that minimise ln of the mean of exp(aside · λ), plus half of penalty · λ²."""
    from scipy.optimize import minimize

    def value(multipliers: _Array) -> tuple[float, _Array]:
        exponents = aside @ multipliers
        top = exponents.max()
        parts = np.exp(exponents - top)
        total = parts.sum()
        slope = parts @ aside / total + penalty * multipliers
        return float(top + np.log(total) + 0.5 * penalty * np.square(multipliers).sum()), slope

    bounds = None if bound is None else [(-bound, bound)] * len(start)
    begin = start if bound is None else np.clip(start, -bound, bound)
    # The problem is convex and smooth, so that the start does not matter.
    found = minimize(
        value,
        begin,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 500, "ftol": 1e-10, "gtol": 1e-6},
    )
    return np.asarray(found.x, dtype=np.float64)


TRIED_SHARES: Final = (0.0, 0.3, 0.5, 0.65, 0.75, 0.83, 0.88, 0.92, 0.96, 1.0)
"""Shares of the print's black that are tried with each picture: chosen so that what is left shrinks by a third from one
to the next, since the shadows of real images differ by factors, and at last is nothing."""

Photograph = Callable[[npt.NDArray[np.uint8], int], npt.NDArray[np.uint16]]
"""From a picture (H, W, 3) uint8 and the number of an image to its raw image (H, W, 3) uint16 under one light."""


@dataclass(frozen=True, eq=False)
class MeasuredPictures:
    """Numbers of source pictures as the camera would see them.

    - `values`: (N,) float64 each, by the names of `image_numbers.numbers_of_cells`; NaN of a picture that has no such
      number.
    - `unreadable`: (N,) bool, pictures that cannot be read or cut, of which every number is NaN.
    - `shares`: shares of the print's black, 0 … 1, at which each picture was measured, or none: then N is the number of
      pictures times shares, those of a picture one after the other.
    """

    values: Mapping[str, npt.NDArray[np.float64]]
    unreadable: npt.NDArray[np.bool_]
    shares: tuple[float, ...] = ()

    @property
    def variants(self) -> int:
        """How often each picture was measured."""
        return max(1, len(self.shares))


@dataclass(frozen=True)
class BlackShares:
    """Of a print's black, shares that are tried with each picture.

    - `black`: (3,) what the camera sees of the print's black under the light of the measurement, counts.
    - `shares`: what is taken out of it, 0 … 1, at least one.
    """

    black: tuple[float, float, float]
    shares: tuple[float, ...] = TRIED_SHARES


def reference_light(lut: Lut, lights: npt.NDArray[np.float64]) -> int:
    """Return the light of a table nearest to the mean of lights (L, 3) float64 above 0 in ln(R/G) and ln(B/G)."""
    apart = log_chroma(lut.white) - log_chroma(lights).mean(axis=0)
    return int(np.square(apart).sum(axis=1).argmin())


def measure_pictures(
    sources: Sequence[Source],
    photograph: Photograph,
    white: npt.NDArray[np.float64],
    cells: int = CELLS,
    workers: int = 1,
    on_picture: Callable[[int, int], None] | None = None,
    black: BlackShares | None = None,
) -> MeasuredPictures:
    """Return the numbers of source pictures, photographed one after the other.

    `photograph`: how each, (H, W, 3) uint8, becomes a raw image (H, W, 3) uint16. `white`: (3,) float64 above 0, the
    light of these images in linear camera RGB. `black`: shares of the print's black that are taken out of the cells of
    each photograph, which was taken with all of it; None leaves photographs as they are.
    """
    found: list[dict[str, float] | None] = []
    measure = partial(_measure, photograph=photograph, white=white, cells=cells, black=black)
    shares = black.shares if black else ()
    for done, numbers in enumerate(ordered_map(measure, enumerate(sources), workers), 1):
        found += [None] * max(1, len(shares)) if numbers is None else numbers
        if on_picture:
            on_picture(done, len(sources))
    names = next((numbers.keys() for numbers in found if numbers is not None), ())
    values = {name: np.array([np.nan if numbers is None else numbers[name] for numbers in found]) for name in names}
    return MeasuredPictures(values, np.array([numbers is None for numbers in found]), shares)


def _measure(
    numbered: tuple[int, Source],
    photograph: Photograph,
    white: npt.NDArray[np.float64],
    cells: int,
    black: BlackShares | None,
) -> list[dict[str, float]] | None:
    """Return the numbers of a picture with each share, or None if it cannot be read: the dataset would leave it out."""
    number, source = numbered
    try:
        read = source.read()
    except FormatError:
        return None
    crops = [cut.picture for cut in read.cuts] or [read.picture]
    means = [cell_means(photograph(crop, number), white, cells) for crop in crops]
    by_share: list[dict[str, float]] = []
    for share in black.shares if black else (None,):
        taken = means if black is None or share is None else [_without(mean, black, share, white) for mean in means]
        found = [numbers_of_cells(mean)[0] for mean in taken]
        # Crops of a picture are drawn together, so what they are together counts.
        by_share.append({name: float(np.mean([numbers[name] for numbers in found])) for name in found[0]})
    return by_share


def _without(
    means: npt.NDArray[np.float64], black: BlackShares, share: float, white: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return cells (h, w, 3) float64, divided by their light, without a share of the black: as `black_points` has it.

    What is done there to samples is done here to means of cells, which is the same but where a sample is darker than
    what is taken out of it.
    """
    part = share * np.array(black.black) / white
    return np.maximum(means - part * white.mean(), 0) / (1 - part)


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
        """Return what is to be said of it, a line each."""
        head = (
            f"{len(self.places)} draws of {self.distinct} pictures, of {int((self.weights > 0).sum())} measured; their "
            f"weights are worth {self.effective:.0f} equal ones"
        )
        black: list[str] = []
        if self.blacks is not None:
            low, middle, high = np.percentile(self.blacks, (10, 50, 90), method="hazen")
            shares = f"{middle:.2f} in the median, {low:.2f} to {high:.2f} of eight images of ten"
            black.append(f"share of the print's black taken out: {shares}")
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
    lines: list[str] = []
    if target.may_be_encoded:
        lines.append(
            f"the images of {target.name} are in the median {float(np.median(target.known('luminance_50'))):.2f} as "
            "bright as their highlights, raw ones about .15 to .2: if they are encoded for a display, describe linear "
            "ones"
        )
    if target.images < _FEW:
        lines.append(f"{target.name} has {target.images} images: what they are like is known roughly, and followed so")
    return lines


def _weights(
    pictures: Mapping[str, _Array], real: Mapping[str, _Array], least_effective: float, variants: int
) -> _Array:
    """Return the weights of pictures by their moments and those of real images."""
    columns = [_moments(name, pictures[name], real[name]) for name in pictures]
    moments = np.concatenate([column for column, _ in columns], axis=1)
    wanted = np.concatenate([column.mean(axis=0) for _, column in columns])
    return balance(moments, wanted, min(map(len, real.values())), least_effective, variants)


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


def remedies(drawn: DrawnPictures, options: DatasetOptions) -> list[str]:
    """Return which options bring figures nearer that are not alike, a line each; none where all are."""
    apart = {made.name: made for made in drawn.reached if not made.is_alike}
    if not apart:
        return []
    lines: list[str] = []
    shadows, chroma = apart.get("luminance_1"), apart.get("chroma_spread")
    bright = shadows is not None and shadows.after > shadows.wanted
    pale = chroma is not None and chroma.after < chroma.wanted
    if (bright or pale) and options.rendering == "codes":
        lines.append(
            "--rendering colorimetric: by codes a picture has the contrast and chroma of the print, mostly less than "
            "the scene's"
        )
    if (shadows is not None or pale) and options.black_point.kind != "like":
        lines.append(
            "--black-point like: the print's own black lifts shadows and makes colours pale, and of each picture as "
            "much of it is taken out as makes it like the real ones"
        )
    lines.append(
        "more pictures with --sources, or several crops of each (--crop WxH --crops N): there is more to choose from"
    )
    return [f"what may help: {line}" for line in lines]


def light_caution(lut: Lut, target: RealStatistics) -> str:
    """Return that pictures were measured under one light of the table, and how figures of the images are had."""
    light = lut.illuminations[reference_light(lut, target.lights)]
    return (
        f"figures drawn are of pictures measured under one light, {light.index} of the table; for those of the images, "
        f"each under its own light, run evaluate describe on the dataset with --against {target.file}"
    )


SHARE: Final = 0.01
"""Share of an image's pixels whose brightest channel is brighter than its exposure: so `evaluate describe` has it."""

_LEAST: Final = 0.001
"""Least exposure that is followed: below it an image is black."""


def like_exposure(target: RealStatistics) -> AutomaticExposure | None:
    """Return the exposure by which images reach the levels that those of a real data set reach.

    Returns the levels drawn by eleven quantiles; None where the real data set's saturation is not known.
    """
    known = target.known("exposure")
    if not known.size:
        return None
    levels = np.percentile(known, np.linspace(0, 100, 11), method="hazen")
    return AutomaticExposure(SHARE, tuple(float(f"{level:.6g}") for level in np.clip(levels, _LEAST, 1.0)))


def exposure_sentence(target: RealStatistics) -> str:
    """Return in one line how images are exposed."""
    known = target.known("exposure")
    if not known.size:
        return f"exposure: that of {target.name} is not known without its saturation; images are exposed as the table"
    low, middle, high = np.percentile(known, (10, 50, 90), method="hazen")
    return f"exposure: {middle:.2f} of saturation in the median, {low:.2f} to {high:.2f} in eight of ten images"


_LOOKED_AT: Final = 200
"""Pictures whose size is looked at, evenly spread over the list: a tenth of them is then known to a few percent."""

_TOO_SMALL: Final = 10
"""Percent of the pictures that may be too small for the crop, and are left out."""

_LEAST_SIDE: Final = 16
"""Least side of images, px: below it their cells say nothing of scenes."""


@dataclass(frozen=True)
class LikeSize:
    """A size of images.

    - `width`, `height`: what pictures are cut to, px.
    - `wanted`: width and height of most images of the real data set, px.
    """

    width: int
    height: int
    wanted: tuple[int, int]

    def describe(self) -> dict[str, Any]:
        """Return what `dataset.json` records."""
        return {"crop": [self.width, self.height], "wanted": list(self.wanted)}

    def sentence(self) -> str:
        """Return in one line which size it is."""
        same = (self.width, self.height) == self.wanted
        end = "" if same else ", as large as nine of ten pictures allow in that shape"
        return "size: {}x{} px{}; most real images have {}x{}".format(self.width, self.height, end, *self.wanted)


def like_size(target: RealStatistics, sources: Sequence[Source]) -> LikeSize | None:
    """Return the size of most real images, made smaller in that shape where pictures are smaller.

    Returns none for thumbnails, whose size and shape are not those of the photographs.
    """
    if target.layout == "thumbnails" or not target.sizes:
        return None
    width, height, _ = target.sizes[0]
    scales: list[float] = []
    for place in np.unique(np.linspace(0, len(sources) - 1, min(len(sources), _LOOKED_AT)).astype(int)):
        try:
            high, wide = sources[int(place)].read().picture.shape[:2]
        except FormatError:
            continue
        scales.append(min(wide / width, high / height))
    if not scales:
        raise InputError("none of the pictures can be read; name others with --sources")
    scale = min(1.0, float(np.percentile(scales, _TOO_SMALL, method="lower")))
    # Whole pixels below, so that the pictures that decide the scale are not too small by a fraction of one.
    size = LikeSize(int(width * scale + 1e-9), int(height * scale + 1e-9), (width, height))
    if min(size.width, size.height) < _LEAST_SIDE:
        raise InputError(
            f"pictures cut to the shape of {width}x{height} px would be {size.width}x{size.height} px, expected "
            f"{_LEAST_SIDE} px a side or more; name larger ones, or leave size out of --like-in"
        )
    return size
