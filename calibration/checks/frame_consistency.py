"""Whether a frame is of the same camera and exposure and shows the same print as the registered one.

A light's own frame may be spoilt between two white ones, while the tags are where they were. The ratio of a cell's
channel to the same under the first light is a smooth function of the printed code, for any two lights and whatever the
inks: a polynomial in the code, fitted on the frame itself. What is left is noise, the polynomial's own error, which is
spread over the sheet at random as the codes are, and what is wrong with the frame:

- `scatter`, over all cells: blur mixes neighbours, and another order of cells fits nothing. What noise may be by chance
  is taken off;
- `block`, the mean over neighbouring cells: a hand, a shadow or a reflection lies in one place. A cell that none of its
  neighbours is like, as a hot photosite makes it, counts as the one next to it in value;
- `disturbed`, cells next to each other that are far off: what covers too few of them to move a block's mean
  (`calibration.checks.small_places`).

Charts of 8 and 64 cells have no more cells than the polynomial has terms, or twice as many, and cannot be checked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from calibration import kernels
from calibration.checks.small_places import AROUND, LEAST_MODEL_ERROR, SmallPlaces, cells_without_hot
from drivers.raw.rawfile import FrameOrigin
from experiment.measures.least_squares import (
    code_polynomial,
    code_powers,
    least_absolute_line,
    least_squares,
    linear_combinations,
    product,
)
from experiment.session.records import FrameRecord
from foundation.robust import huber_weights, robust_sigma

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

DEGREE = 4  # Of the polynomial in the code: 35 terms

LEAST_COUNTS = 60.0  # Mean of 25 samples that a cell is expected to have for it to be compared: good to 3 %

# Cells whose scatter and blocks are compared, at most: a quarter of a full chart, for every frame is compared.
CELLS = 8192

FIT_CELLS = 1500  # Cells that the polynomial is fitted on, about: forty for each of its terms

# Compared cells of a block: four times as many cells of a full chart, a square of six centimetres on A0.
BLOCK_CELLS = 32

LEAST_CELLS = 12  # Compared cells that a block must have for its mean to count

CELLS_A_TERM = 2  # With fewer cells for each term, what is wrong would be fitted, or what is right not

_ROUNDS = 3  # Reweighted solutions in a row, after a first with equal weights

# Standard errors that are taken off a block's mean, and off the cells' spread, before it counts: among a full chart's
# 256 blocks noise alone exceeds them in one of sixty frames.
_CERTAIN = 4.0

# Variance of a standard deviation estimated by the median deviation of N normal values, over σ²/N (P. Rousseeuw and
# C. Croux, Journal of the American Statistical Association 88, 1993: an efficiency of 37 %).
_SPREAD_ERROR2 = 1.36

_AS_MUCH = 0.3  # Share of the worst block's deviation from which on a block is part of the same thing

# Of the cells' expected levels, what is taken for the brightest: bare paper is not among them.
_BRIGHT_PERCENTILE = 99.0

_MODEL_ERROR, _LEAST_ERROR = 0.02, 3.0  # Standard error of a cell's prediction: a share of its level, and counts


@dataclass(frozen=True)
class FrameConsistency:
    """How a frame differs from the registered print under its light; zeros where nothing can be compared.

    - `scatter`: spread of the cells about what their codes give, as a share, the noise taken out, beyond four standard
      errors; of the worst channel.
    - `block`: how far the worst block of cells is off, as a share, beyond four standard errors.
    - `at_mm`: the middle of that block on the print.
    - `colour`: how far that block is off in R, G and B, as shares, with their signs; 0 of a channel that is too dim.
    - `share`: share of the blocks that are off by a third as much or more.
    - `extent_mm`: side of a square of the area of these.
    - `added`: light that these blocks' cells have besides their own, as a share of the brightest cells'.
    - `kept`: share of their own light that they have.
    - `disturbed`: cells that something covers, however few they are, and how far each is off, a share with its sign: of
      the channel that is off most, 0 where it is too dark to be compared.
    - `seeds`: those of them that are far off by themselves; the others touch these.
    - `alone`: cells that are far off, and none of their neighbours is.
    """

    scatter: float = 0.0
    block: float = 0.0
    at_mm: tuple[float, float] = (0.0, 0.0)
    colour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    share: float = 0.0
    extent_mm: float = 0.0
    added: float = 0.0
    kept: float = 1.0
    disturbed: tuple[tuple[int, float], ...] = ()
    seeds: tuple[int, ...] = ()
    alone: tuple[int, ...] = ()

    def without_hot(self, hot: _Mask, cells_mm: _Array) -> FrameConsistency:
        """Return the same where cells that are off by their hot photosites are not taken for covered ones.

        `hot`: (C,) bool, cells that hold a photosite which is hot in the dark frames. `cells_mm`: (C, 2) places.
        """
        cells = np.array([cell for cell, _ in self.disturbed], dtype=np.int64)
        if not hot[cells].any():
            return self
        kept, alone = cells_without_hot(cells, np.array(self.seeds, dtype=np.int64), hot, cells_mm)
        disturbed = tuple(one for one, stays in zip(self.disturbed, kept.tolist(), strict=True) if stays)
        seeds = tuple(cell for cell in self.seeds if kept[np.searchsorted(cells, cell)])
        return replace(self, disturbed=disturbed, seeds=seeds, alone=tuple(sorted({*self.alone, *alone.tolist()})))


@dataclass(frozen=True, eq=False)
class _Deviations:
    """What is left of one channel.

    `solution` (K,) of the polynomial. Of the cells compared for blocks `seen` and `expected` (N,) counts, NaN of those
    that cannot be, `scatter` of all as estimated and `certain_scatter` beyond its error, and of each block (B,) its
    `mean` deviation, a share, and how far that is `off` beyond noise.
    """

    solution: _Array
    seen: _Array
    expected: _Array
    scatter: float
    certain_scatter: float
    mean: _Array
    off: _Array


@dataclass(frozen=True, eq=False)
class _Channel:
    """One channel of the reference, prepared for comparisons.

    `terms` (N, K) and `level` (N,) of the compared cells, those `there` that are bright enough, `some` of them to fit
    on, and the fit's `design` (F, K).
    """

    terms: _Array
    level: _Array
    there: npt.NDArray[np.int64]
    some: npt.NDArray[np.int64]
    design: _Array

    @staticmethod
    def of(terms: _Array, level: _Array, usable: _Mask) -> _Channel:
        there = np.flatnonzero(usable & (level > LEAST_COUNTS))
        some = there[:: max(1, len(there) // FIT_CELLS)]
        return _Channel(terms, level, there, some, terms[some] * level[some, None])


def has_enough_cells(cells: int) -> bool:
    """Return whether a chart of so many cells can be checked by its codes at all."""
    return cells >= CELLS_A_TERM * len(code_powers(DEGREE))


class ConsistencyCheck:
    """Compares frames with one reference frame of the print, whatever their lights.

    `rgb`: (C, 3) printed codes. `cells_mm`: (C, 2) places. `level`, `variance`: (C, 3) float64 mean counts above black
    in that frame, field divided out, and their variance. `usable`: (C,) bool, cells that are inside the frame and not
    covered.
    """

    def __init__(self, rgb: npt.ArrayLike, cells_mm: _Array, level: _Array, variance: _Array, usable: _Mask) -> None:
        # Blocks are means over many cells: of a full chart every fourth is enough.
        self._some = slice(None, None, max(1, len(cells_mm) // CELLS))
        every = code_polynomial(np.asarray(rgb), DEGREE)
        terms = np.ascontiguousarray(every[self._some])
        self._usable = usable[self._some]
        self._channels = [_Channel.of(terms, level[self._some, channel], self._usable) for channel in range(3)]
        self._basis = np.ascontiguousarray(every.T)
        self._level = np.where(usable[:, None] & (level > LEAST_COUNTS), level, np.nan).T.copy()
        self._noise2 = np.ascontiguousarray((variance / np.maximum(level, 1.0) ** 2).T)
        self._places = SmallPlaces(rgb, cells_mm, usable)
        places_mm = cells_mm[self._some]
        block, self._middles, self._block_mm2 = _blocks(places_mm)
        self._members = _members(block, len(self._middles))
        # Eight, those of a square grid: what covers the print, however small, covers two cells or harms one alone.
        # A bound by the block's own spread would leave what covers less than half of each block it lies in.
        around = cKDTree(places_mm).query(places_mm, k=min(AROUND + 1, len(places_mm)))[1]
        self._around = np.ascontiguousarray(np.atleast_2d(around), dtype=np.int64)

    def compare(self, mean: _Array, variance: _Array) -> FrameConsistency:
        """Return how far a frame is consistent with the reference.

        `mean`: (C, 3) float64 mean counts above black of all cells, field divided out. `variance`: (C, 3) float64, of
        these means.
        """
        some, some_variance = mean[self._some], variance[self._some]
        light = np.median(some[self._usable], axis=0)
        found = {
            int(channel): self._of_channel(self._channels[channel], some[:, channel], some_variance[:, channel])
            for channel in np.flatnonzero(light >= 0.2 * light.max())
        }
        known = {channel: one for channel, one in found.items() if one is not None}
        if not known:
            return FrameConsistency()
        disturbed, seeds, alone = self._disturbed(known, mean, variance)
        scatter = max(one.certain_scatter for one in known.values())
        off = np.max([one.off for one in known.values()], axis=0)
        worst = int(np.argmax(off))
        if not off[worst] > 0:
            return FrameConsistency(scatter, disturbed=disturbed, seeds=seeds, alone=alone)
        there = np.flatnonzero(off >= _AS_MUCH * off[worst])
        red, green, blue = (float(known[c].mean[worst]) if c in known else 0.0 for c in range(3))
        x, y = self._middles[worst].tolist()
        added, kept = _light_of(list(known.values()), self._members[there])
        return FrameConsistency(
            scatter=scatter,
            block=float(off[worst]),
            at_mm=(x, y),
            colour=(red, green, blue),
            share=len(there) / len(off),
            extent_mm=float(np.sqrt(len(there) * self._block_mm2)),
            added=added,
            kept=kept,
            disturbed=disturbed,
            seeds=seeds,
            alone=alone,
        )

    def _disturbed(
        self, known: dict[int, _Deviations], mean: _Array, variance: _Array
    ) -> tuple[tuple[tuple[int, float], ...], tuple[int, ...], tuple[int, ...]]:
        """Return `disturbed`, `seeds` and `alone` of `FrameConsistency`."""
        channels = sorted(known)
        factors = np.zeros((3, len(self._basis)))
        for channel in channels:
            factors[channel] = known[channel].solution
        sums = linear_combinations(self._basis, factors)
        deviation, sigma = np.empty((2, len(channels), len(mean)))
        for row, channel in enumerate(channels):
            with np.errstate(invalid="ignore"):
                expected = sums[channel] * self._level[channel]
                expected[~(expected > LEAST_COUNTS)] = np.nan
            np.divide(mean[:, channel], expected, out=deviation[row])
            deviation[row] -= 1
            np.divide(variance[:, channel], expected**2, out=sigma[row])
            sigma[row] += self._noise2[channel]
            sigma[row] += max(known[channel].scatter, LEAST_MODEL_ERROR) ** 2
        np.sqrt(sigma, out=sigma)
        cells, off, seeds, alone = self._places.disturbed(deviation, sigma)
        disturbed = tuple(zip(cells.tolist(), off.round(6).tolist(), strict=True))
        return disturbed, tuple(seeds.tolist()), tuple(alone.tolist())

    def _of_channel(self, known: _Channel, mean: _Array, variance: _Array) -> _Deviations | None:
        if len(known.there) < CELLS_A_TERM * known.terms.shape[1]:
            return None
        design, level, seen = known.design, known.level[known.some], mean[known.some]
        # Weights are those of the expected levels, not of the levels seen: covered cells would count most.
        sigma = _MODEL_ERROR * float(np.median(seen / level)) * level + _LEAST_ERROR
        if not sigma.min() > 0:
            return None
        weights = 1 / sigma**2
        solution = least_squares(design, seen, weights)
        for _ in range(_ROUNDS):
            residual = np.abs(seen - product(design, solution)) / sigma
            usual = max(robust_sigma(residual), 1e-9)
            solution = least_squares(design, seen, weights * huber_weights(residual, usual) ** 2)
        expected, there = product(known.terms, solution) * known.level, known.there
        there = there[expected[there] > LEAST_COUNTS]
        if len(there) < LEAST_CELLS:
            return None
        deviation = np.full(len(mean) + 1, np.nan)
        deviation[there] = np.clip(mean[there] / expected[there] - 1, -1, 1)
        spread2 = robust_sigma(deviation[there] - np.median(deviation[there])) ** 2
        noise2 = float(np.median(variance[there] / expected[there] ** 2))
        # That of a square is twice that of its root.
        error = _CERTAIN * 2 * float(np.sqrt(_SPREAD_ERROR2 / len(there)))
        kernels.clipped_to_neighbours(deviation[:-1].copy(), self._around, deviation[:-1])
        of_blocks = deviation[self._members]
        count = np.isfinite(of_blocks).sum(axis=1)
        average = np.nansum(of_blocks, axis=1) / np.maximum(count, 1)
        off = np.abs(average) - _CERTAIN * np.sqrt(spread2 / np.maximum(count, 1))
        compared = np.isfinite(deviation[:-1])
        return _Deviations(
            solution=solution,
            seen=np.where(compared, mean, np.nan),
            expected=np.where(compared, expected, np.nan),
            scatter=float(np.sqrt(max(spread2 - noise2, 0))),
            certain_scatter=float(np.sqrt(max(spread2 / (1 + error) - noise2, 0))),
            mean=average,
            off=np.where(count >= LEAST_CELLS, off, 0.0),
        )


def _light_of(channels: list[_Deviations], members: npt.NDArray[np.int64]) -> tuple[float, float]:
    """Return the light added, a share of the brightest cells', and the share of their own light that is kept.

    Of the cells `members` (B, M), −1 for none, by least absolute deviations, so that a few cells do not decide.
    """
    cells = members[members >= 0]
    own: list[_Array] = []
    seen: list[_Array] = []
    for one in channels:
        there = cells[np.isfinite(one.expected[cells])]
        # Of a channel so dim that its few bright cells lie apart none could be compared.
        if not len(there):
            continue
        top = float(np.nanpercentile(one.expected, _BRIGHT_PERCENTILE))
        own.append(one.expected[there] / top)
        seen.append(one.seen[there] / top)
    if sum(map(len, own)) < LEAST_CELLS:
        return 0.0, 1.0
    return least_absolute_line(np.concatenate(own), np.concatenate(seen))


def _members(block: npt.NDArray[np.int64], blocks: int) -> npt.NDArray[np.int64]:
    """Return the cells (B, M) of each block, given the block (C,) of each cell; −1 beyond the last of a block."""
    count = np.bincount(block, minlength=blocks)
    members = np.full((blocks, int(count.max(initial=1))), -1, dtype=np.int64)
    order = np.argsort(block, kind="stable")
    begin = np.repeat(np.cumsum(count) - count, count)
    members[block[order], np.arange(len(block)) - begin] = order
    return members


def _blocks(cells_mm: _Array) -> tuple[npt.NDArray[np.int64], _Array, float]:
    """Return the block (C,) of each cell, the blocks' middles (B, 2), and the area of one, mm².

    They are squares of about `BLOCK_CELLS`, or fewer.
    """
    low, size = cells_mm.min(axis=0), np.maximum(np.ptp(cells_mm, axis=0), 1e-9)
    cells = min(BLOCK_CELLS, max(LEAST_CELLS + 8, len(cells_mm) // 16))
    side = float(np.sqrt(size[0] * size[1] * cells / len(cells_mm)))
    columns, rows = (max(1, round(float(length) / side)) for length in size)
    across = np.array([columns, rows])
    at = np.minimum((cells_mm - low) / size * across, across - 1e-9).astype(np.int64)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    middles = np.column_stack([x.ravel(), y.ravel()])
    area_mm2 = float(size[0] * size[1]) / (columns * rows)
    return at[:, 1] * columns + at[:, 0], low + (middles + 0.5) * size / across, area_mm2


@dataclass(frozen=True)
class ForeignFrame:
    """A frame whose file states another camera, lens or exposure than most.

    - `found`, `expected`: what it states, and what most state, in words.
    - `ratio`: its exposure over that of most; 1 where another thing differs.
    """

    record: FrameRecord
    found: str
    expected: str
    ratio: float = 1.0


@dataclass(frozen=True)
class OriginFigures:
    """Frames whose files state another thing than most: a camera, a lens, an exposure by 1 % or more, an ISO speed."""

    other_camera: tuple[ForeignFrame, ...] = ()
    other_lens: tuple[ForeignFrame, ...] = ()
    other_exposure: tuple[ForeignFrame, ...] = ()
    other_iso: tuple[ForeignFrame, ...] = ()

    @property
    def exposure_difference(self) -> float:
        """By how much the exposure of a frame differs from that of most, the largest, a share: 1 is twice or half."""
        return max((max(frame.ratio, 1 / frame.ratio) - 1 for frame in self.other_exposure), default=0.0)


# Ratio below which two exposures count as one: shutter speeds differ by 1.26 at least, and are written rounded.
_SAME_EXPOSURE = 1.01


def origin_figures(frames: Sequence[tuple[FrameRecord, FrameOrigin]], iso: int | None = None) -> OriginFigures:
    """Return which frames are of another camera, lens or exposure than most, in the order given.

    `iso`: the ISO speed of the session's settings, which stands for that of most; None where it is not known.
    """
    bodies = [(record, _body(origin)) for record, origin in frames if origin.camera or origin.serial]
    lenses = [(record, origin.lens) for record, origin in frames if origin.lens]
    return OriginFigures(
        other_camera=_others(_stated_alike(bodies)),
        other_lens=_others(lenses),
        other_exposure=_other_exposures(frames),
        other_iso=_others(
            [(record, f"ISO {origin.iso}") for record, origin in frames if origin.iso], f"ISO {iso}" if iso else None
        ),
    )


def _body(origin: FrameOrigin) -> str:
    return f"{origin.camera} no. {origin.serial}" if origin.serial else origin.camera


def _stated_alike(bodies: Sequence[tuple[FrameRecord, str]]) -> Sequence[tuple[FrameRecord, str]]:
    """Return the bodies without serial numbers where some frames of a model state none."""
    models = {body.split(" no. ")[0] for _, body in bodies if " no. " not in body}
    return [(record, body.split(" no. ")[0] if body.split(" no. ")[0] in models else body) for record, body in bodies]


def _others(stated: Sequence[tuple[FrameRecord, str]], asked: str | None = None) -> tuple[ForeignFrame, ...]:
    """Return the frames that state another thing than was asked for, or than most where nothing was."""
    if not stated:
        return ()
    usual = asked or Counter(value for _, value in stated).most_common(1)[0][0]
    return tuple(ForeignFrame(record, value, usual) for record, value in stated if value != usual)


def _other_exposures(frames: Sequence[tuple[FrameRecord, FrameOrigin]]) -> tuple[ForeignFrame, ...]:
    known = [(record, origin) for record, origin in frames if origin.exposure > 0]
    if not known:
        return ()
    usual = Counter(origin.exposure for _, origin in known).most_common(1)[0][0]
    example = next(origin for _, origin in known if origin.exposure == usual)
    found: list[ForeignFrame] = []
    for record, origin in known:
        # Where one of two states no f-number, the lens is taken to be as it is in the other.
        both = bool(origin.aperture) == bool(example.aperture)
        ratio = origin.exposure / usual if both else _light(origin) / _light(example)
        if not 1 / _SAME_EXPOSURE < ratio < _SAME_EXPOSURE:
            found.append(ForeignFrame(record, origin.exposure_text, example.exposure_text, ratio))
    return tuple(found)


def _light(origin: FrameOrigin) -> float:
    return (origin.shutter_s or 0.0) * (origin.iso or 0)
