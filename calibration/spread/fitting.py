"""The lens's point spread beside its sharp core, and how much of it there is: regression on the light around each cell.

A share is that of a point's light which the lens spreads over a Gaussian of that σ, rather than where it belongs.
Gaussians add up to any spread that falls with the distance. Light that the lens spreads evenly over the frame is the
veil (veiling glare, ISO 9358).

The colours of a chart lie in random order, so that what a cell's neighbours have is unrelated to its own code. A cell's
own level is predicted from the codes next to its own; what it differs by from that is regressed on what each kernel
would bring to it.

- Nothing that carries a cell's own noise is among the regressors: own levels are predicted ones there.
- What the field's fit and the print's unevenness can be wrong by, smooth factors of a cell's level, is fitted along,
  and held near 0. Veil is told from it since it adds the same to dark and bright cells.
- A far kernel's share is not below 0, and a kernel whose omission costs less than `LEAST_GAIN` is left out. Beside
  kernels that are proven far ones and the veil have their likeliest shares, which what is usual of lenses holds.

C cells in the order of colour indices; T unknowns of a channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from calibration.spread.predicting import VARYING_BITS, LevelModel
from experiment.measures.least_squares import page_polynomial, page_powers
from foundation.robust import sigma_by_level

# σ of the near kernels, half-size px: from where a window of 25 pixels begins to see its neighbours to a slot's
# width; in steps of two, within which a smooth spread differs from their sum by less than what is measured.
NEAR_PX = (1.5, 3.0, 6.0)

# σ of the far kernels: one slot, two, a tenth of a full chart's height, and the widest that it tells from a veil.
# Power laws, whose reach is all of the frame, are mixtures of them.
FAR_PX = (12.0, 24.0, 96.0, 384.0)

# Terms of a near kernel's share over the frame: aberrations grow with the field angle, and a lens may be decentred,
# so it is a polynomial, quadratic along either axis (`place_terms`). What is wider comes from scatter, and is the
# same everywhere.
PLACES = 9

_NEAR_TERMS = PLACES * len(NEAR_PX)

_CHANNEL_TERMS = _NEAR_TERMS + len(FAR_PX) + 1

# Unknowns: for each channel near kernels term by term over the frame, far ones, and the veil.
TERMS = 3 * _CHANNEL_TERMS

# By how much a kernel must lower the sum of squares, in units of its variance: a share of four standard errors. All
# together must do as much on parts of the print that they were not fitted on.
LEAST_GAIN = 16.0

_Array = npt.NDArray[np.float64]

# Misfit from which on a veil is not told from other light; 1.5 to 3.3 in simulated rooms whose lens has a veil.
MOST_MISFIT = 5.0

LEAST_COUNTS = 300.0  # Counts above black of bare paper from which on a channel of a frame is used

# Standard deviation of the coefficients of a smooth factor of cells' levels: errors of the fitted field and of an
# even print (chosen).
USUAL_UNEVENNESS = 0.003

LOOSE_UNEVENNESS = 0.03  # The same where several primaries light the print, each with a field of its own (chosen)

FOLDS = 4  # Parts of the print, each of which is predicted from the others

# Parts of the page's width that belong to one fold each, so that every fold has cells all over the print.
_PATCHWORK = 10

# Orders over the page of light that is no kernel's, of smooth factors of a level, as high as a field's, and of a
# density of ink (its level times its logarithm).
_SHAPE_ORDER, _FACTOR_ORDER, _INK_ORDER = 4, 6, 2

DARK_LEVEL = 0.1  # Level, bare paper 1, of cells whose counts a sensor's bend is held against paper's

_LEAST_BEND = 1e-4  # Standard deviation of the sensor's bend, at least

# Standard deviation that a share is expected to have at most: keeps kernels solvable that the windows hardly see.
_PRIOR_SHARE = 0.1

# Standard deviation of the veil that lenses have before it is measured: 0.3 to 1.5 % by ISO 9358 and ISO 18844. Where
# a print is lit so evenly that it shows no veil, this is what is known of it.
USUAL_VEIL = 0.01

_WIDE_KERNELS = 2  # Far kernels that, as the veil does, look like light that lies smoothly over a part of the print

# Standard deviation of each far kernel's share before it is measured, beside what the one before lets expect.
_FAR_STEPS = (0.01, 0.01, 0.004, 0.003)

# How much more than that lenses may have that scatter. Each is as likely beforehand, and is weighed by what the print
# shows.
_FAR_SIZES = (0.3, 1.0, 3.0)

# The same, and of near kernels, too, of a lens that does not scatter, and of the veil of one without: coated glass
# without dust.
_CLEAN = 0.001

# How likely a lens is beforehand that does not scatter, and of these one without a veil (chosen): charts of few
# colours would else state what they have not seen, several times the error that there is.
_CLEAN_ODDS, _CLEAN_ODDS_OF_FEW = 0.3, 0.7

# How likely one that scatters is without a veil, on charts of few colours; others see it (chosen).
_CLEAR_ODDS_OF_FEW = 0.3

# Powers of the distance by which scattered light falls, and how much of the law there is far away: polish, scratches
# and dust (J. E. Harvey, "Light-scattering characteristics of optical surfaces", 1976; I. R. King, "The profile of a
# star image", 1971), and aberrations, which end within a slot.
_LAWS = ((2.0, 1.0), (3.0, 1.0), (3.0, _CLEAN))

_POWER_ODDS = 0.5  # How likely it is that what a lens scatters falls by one of these from its core on (chosen)

_SCATTERED = 0.04  # Standard deviation of all that such a lens scatters (chosen)

# Standard deviation of a kernel's share against the law's, relative: of what is seen beside cells follows what lies
# over all of the frame, channel by channel (chosen).
_OFF_LAW = 0.35

# As `CHANNELS_APART`, of how a lens's light deviates from a law: the form is the lens's, the amount each channel's
# (chosen).
_LAW_APART = 0.7

_SCATTER_APART = 0.5  # The same as `CHANNELS_APART` of such a lens

# Part of a far kernel's share that the next is expected to have: of r⁻² all, of r⁻³ a quarter, of an exponential
# none. What is known of 24 px says something of 384 px, which charts of few colours do not show.
_FAR_FALL = 0.5

# Standard deviation of a channel's far share against what R, G and B have in common, in parts of that: scatter and
# reflections at coated glass change that much over the visible spectrum (chosen).
CHANNELS_APART = 1 / 3

# The same of lenses whose channels are alike, that differ, and whose coatings suit one channel.
_APART = (0.03, CHANNELS_APART, 0.7)

# How likely these are beforehand (chosen); weighed as `_FAR_SIZES` are, so that where the print shows no difference,
# hardly any is put into it.
_APART_ODDS = (0.4, 0.4, 0.2)

# Veil beyond which it is none where shares cannot change over the frame: the worst lens by ISO 9358, and half a
# standard error. Shoulders that grow threefold to the corners were taken for one of 4.6 %, and cells were 11 % off.
MOST_VEIL = 0.02

# Misfit of charts of few colours, at least: what was taken for a veil common to the channels, in 46 rooms of
# `benchmarks.troubles` without one, was 1.6 standard errors without it, RMS; cells' errors are alike in all channels.
_LEAST_MISFIT = 3.0

_LEVELS = 40  # Groups of like levels, in each of which the scatter is measured

_HUBER = 3.0  # Standard deviations beyond which a cell weighs less

_ROUNDS = 2  # Solutions in a row, each weighted by what the one before left

# Step of a stored share: far below its error, far above what another order of sums changes, so that a table's bytes
# do not depend on the machine's linear algebra.
_ROUNDING = 1e-7

# Standard deviation of how a share changes over the frame that is allowed for where cells are too few to see it: half
# of what mild shoulders of 1 % have (chosen).
_SMALL_SHARE = 0.002

_EVEN_TERMS = 3  # Unknowns of a kernel that is the same all over the frame, at most: one for each channel


def place_terms(places_px: npt.NDArray[np.floating], frame_px: tuple[int, int]) -> _Array:
    """Return the terms (N, 9) float64 of a near kernel's share at pixels: products of Legendre polynomials, 1 first.

    `places_px`: (N, 2) float half-size px, x then y.
    """
    unit = 2 * np.clip(places_px / (np.array(frame_px[::-1]) - 1.0), 0, 1) - 1
    x, y = (np.stack([np.ones_like(t), t, 1.5 * t**2 - 0.5], axis=-1) for t in unit.T)
    return (y[:, :, None] * x[:, None, :]).reshape(-1, PLACES)


def terms_of(channel: int) -> npt.NDArray[np.int64]:
    """Return which unknowns (T,) int64 hold in a channel: kernel by kernel, term by term, the veil last."""
    return np.arange(_CHANNEL_TERMS, dtype=np.int64) + channel * _CHANNEL_TERMS


def kernel_of_terms() -> list[tuple[int, int | None]]:
    """Return the kernel and the term over the frame of each unknown of a channel; None: the same all over."""
    near: list[tuple[int, int | None]] = [(kernel, place) for kernel in range(len(NEAR_PX)) for place in range(PLACES)]
    return near + [(kernel, None) for kernel in range(len(NEAR_PX), len(NEAR_PX) + len(FAR_PX) + 1)]


def groups_of_terms() -> list[npt.NDArray[np.int64]]:
    """Return the unknowns (n,) int64 that are kept or left out together.

    A kernel's mean shares, and how they change over the frame.
    """
    terms = np.array([(kernel, 0 if place is None else min(place, 1)) for kernel, place in kernel_of_terms()])
    found: list[npt.NDArray[np.int64]] = []
    for kernel, changing in sorted({(int(kernel), int(changing)) for kernel, changing in terms}):
        own = np.flatnonzero((terms[:, 0] == kernel) & (terms[:, 1] == changing))
        found.append(np.concatenate([terms_of(channel)[own] for channel in range(3)]))
    return found


def far_groups() -> list[npt.NDArray[np.int64]]:
    """Return the unknowns (3,) int64 in R, G and B of each far kernel, and last of the veil."""
    return groups_of_terms()[-len(FAR_PX) - 1 :]


def _bend_of(channel: int) -> int:
    """Return the unknown of the sensor's bend in a channel, behind those of light that is no kernel's."""
    return TERMS + len(page_powers(_SHAPE_ORDER)) - 1 + channel


def free_terms() -> npt.NDArray[np.bool_]:
    """Return which unknowns, (n,) bool of all, may be of either sign: near kernels', which the print shows clearly."""
    return np.arange(TERMS) % _CHANNEL_TERMS < _NEAR_TERMS


@dataclass(frozen=True, eq=False)
class PointSpread:
    """What a lens spreads beside its sharp core, as measured on the print.

    - `shares`: (TERMS,) float64, unknowns as `terms_of` has them, by which frames are corrected: 0 where a kernel is
      not proven, all of them where none is. Every lens has far light: beside a proven kernel it has its likeliest
      shares.
    - `covariance`: (TERMS, TERMS) float64, of all unknowns measured together, proven or not.
    - `gain`: by how much the kernels lower the sum of squares of what cells of known colour differ by, in units of its
      variance: what chance gives is one for each unknown; the proven ones'.
    - `held_out`: the same for parts of the print that the shares were not fitted on, each from the others.
    - `misfit`: what is left of light that lies smoothly over the print and is none of the kernels', over what chance
      leaves, ≥ 1: the covariance has been multiplied by it.
    - `likeliest`: (TERMS,) float64, as `shares`, whether they are proven or not: what is known beside the covariance.
    """

    shares: _Array
    covariance: _Array
    gain: float
    held_out: float
    misfit: float
    likeliest: _Array

    @property
    def unexplained(self) -> _Array:
        """(T, T) float64, mean square of what the T shares may be off by: their variance, and what is left out.

        Of what is likely but not subtracted the standard errors alone would say too little.
        """
        return self.off_by(self.shares)

    def off_by(self, subtracted: _Array) -> _Array:
        """Return the same (T, T) float64 where other shares (T,) are subtracted."""
        left_out = self.likeliest - subtracted
        return self.covariance + np.outer(left_out, left_out)

    @property
    def proven(self) -> bool:
        """Whether there is anything to correct, and it holds on parts of the print that it was not fitted on."""
        return bool(self.shares.any()) and self.held_out > LEAST_GAIN * self.misfit

    def amounts(self) -> _Array:
        """Return the share (9, 3, K) float64 of each kernel: terms over the frame, by channel, the veil last."""
        return self._by_kernel(self.shares)

    def errors(self) -> _Array:
        """Return the standard error (9, 3, K) float64 of each of them."""
        return self._by_kernel(np.sqrt(np.diag(self.covariance)))

    def _by_kernel(self, values: _Array) -> _Array:
        found = np.zeros((PLACES, 3, len(NEAR_PX) + len(FAR_PX) + 1))
        for channel in range(3):
            for (kernel, place), value in zip(kernel_of_terms(), values[terms_of(channel)], strict=True):
                found[place or 0, channel, kernel] = value
        return found

    def to_json(self) -> dict[str, Any]:
        """Return the spread as `lut.json` and `report.json` state it."""
        return {
            "sigma_px": [*NEAR_PX, *FAR_PX, None],
            "share": self.amounts().round(7).tolist(),
            "standard_error": self.errors().round(7).tolist(),
            "gain": float(f"{self.gain:.4g}"),
            "gain_held_out": float(f"{self.held_out:.4g}"),
            "misfit": float(f"{self.misfit:.4g}"),
        }


@dataclass(frozen=True, eq=False)
class SpreadData:
    """A channel of a frame: what cells show, and what kernels would change of it.

    - `level`: (C,) float64, bare paper 1, the field divided out.
    - `changes`: (C, T) float64, change of `level` for a whole share of each unknown of the channel, by the light that
      comes in.
    - `even`: (C,) float64, change of `level` for light that lies evenly over all of the frame.
    - `field`: (C,) float64, the frame's light there, about 1.
    - `unevenness`: standard deviation of the coefficients of smooth factors.
    - `bend`: standard deviation of what counts of bare paper may lack beside those of dark cells, relative.
    """

    channel: int
    level: _Array
    changes: _Array
    even: _Array
    field: _Array
    usable: npt.NDArray[np.bool_]
    unevenness: float
    bend: float


@dataclass(frozen=True, eq=False)
class ReferenceData:
    """A channel of a frame at references of one colour, whose level no model of colours has to predict.

    - `level`: (N,) float64, bare paper 1, the field divided out.
    - `changes`: (N, T) float64, as in `SpreadData`.
    - `field`: (N,) float64, as in `SpreadData`.
    - `places_mm`: (N, 2) float64.
    - `order`: order over the page of what the field's fit takes out of them, or may leave.
    """

    channel: int
    level: _Array
    changes: _Array
    field: _Array
    places_mm: _Array
    order: int


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of the regression, fold by fold.

    (N,) values, (N, T + M) design, (N,) levels, where each fold's rows are, the columns' unknowns, and what share of
    the noise's squares is left in the values.
    """

    value: _Array
    design: _Array
    level: _Array
    folds: tuple[slice, ...]
    unknowns: npt.NDArray[np.int64]
    freedom: float = 1.0


def fit_spread(
    data: Sequence[SpreadData],
    cells_mm: _Array,
    page_mm: tuple[float, float],
    bits: int,
    references: Sequence[ReferenceData] = (),
) -> PointSpread | None:
    """Return the point spread that explains best what cells differ by; None where nothing can be fitted.

    `cells_mm`: (C, 2) float64 mm, the cells' centres.
    """
    if not data:
        return None
    rows = [_rows(one, number, cells_mm, page_mm, bits) for number, one in enumerate(data)]
    shapes = len(page_powers(_SHAPE_ORDER)) - 1
    size = max(int(one.unknowns.max()) for one in rows) + 1
    factors = np.full(size, 1 / _PRIOR_SHARE**2)
    for one, row in zip(data, rows, strict=True):
        factors[row.unknowns[len(terms_of(0)) + shapes :]] = 1 / one.unevenness**2
        factors[_bend_of(one.channel)] = 1 / max(one.bend, _LEAST_BEND) ** 2
        factors[row.unknowns[-(len(page_powers(_INK_ORDER)) - 1) :]] = 1 / USUAL_UNEVENNESS**2
    prior = np.diag(factors)
    usual = np.asarray(np.linalg.inv(_usual_shares(bits, _Lens())), dtype=np.float64)
    prior[:TERMS, :TERMS] = usual
    shape = np.arange(TERMS, TERMS + shapes)
    everything = np.delete(np.arange(size), shape)
    solution = np.zeros(size)
    normal, right = np.zeros((FOLDS, size, size)), np.zeros((FOLDS, size))
    at_references = [_reference_rows(one, page_mm) for one in references]
    for again in range(_ROUNDS):
        if again and bits < VARYING_BITS:
            lens = [solution[terms_of(one.channel)] for one in data]
            rows = [_rows(one, n, cells_mm, page_mm, bits, lens[n]) for n, one in enumerate(data)]
        normal, right = _normal_equations([*rows, *at_references], solution)
        solution[everything] = _solved(*_of(normal.sum(axis=0), right.sum(axis=0), prior, everything), np.arange(TERMS))
    few = bits < VARYING_BITS
    misfit = _misfit(normal.sum(axis=0), right.sum(axis=0), prior, shapes)
    normal, right = normal[:, everything][:, :, everything], right[:, everything]
    prior = prior[np.ix_(everything, everything)]
    matrix, vector = _without_factors(normal.sum(axis=0), right.sum(axis=0), prior)
    # What is known beforehand does not become less by what the print shows of other light.
    variance = max(misfit, _LEAST_MISFIT) if few else misfit
    inflated = _without_factors(normal.sum(axis=0), right.sum(axis=0), variance * prior)
    known = inflated[0] / variance - usual, inflated[1] / variance
    lenses = _Lenses.of((matrix - usual, vector), known, bits)
    matrix = matrix + lenses.likeliest_prior - usual
    candidates = groups_of_terms()
    if few:
        candidates = [group for group in candidates if len(group) <= _EVEN_TERMS]
    far = far_groups()
    veil = far[-1]
    unknown = np.zeros((TERMS, TERMS))
    for one in data:
        # Counts that are lost near black, as many as the bend may be there, hide as much of a veil.
        hidden = DARK_LEVEL * one.bend / float(np.median(one.even * one.field))
        unknown[veil[one.channel], veil[one.channel]] += hidden**2
    even = _positive(matrix, vector, _terms(candidates))[0][veil]
    # Other light lies smoothly over the frame, or shares grow towards the corners where cells are too few to see it.
    untold = misfit > MOST_MISFIT or (few and even.mean() > MOST_VEIL)
    if untold:
        # What an even veil would have been taken for is not known.
        unknown[np.ix_(veil, veil)] += np.outer(even, even)
        candidates.pop()
        far.pop()
    kept = _selected(matrix, vector, misfit, candidates)
    if untold:
        unknown += _usual_wide_light(bits, scatters=len(kept) > 0)
    _, gain = _positive(matrix, vector, kept)
    # No lens is without far light: to leave out what is not certain is to be wrong by all of it.
    shares, covariance = lenses.shares(np.union1d(kept, _terms(far)))
    covariance += unknown
    held_out = 0.0
    for fold in range(FOLDS):
        others = normal.sum(axis=0) - normal[fold], right.sum(axis=0) - right[fold]
        with_kernels, without = (_solved(*others, prior, chosen) for chosen in (kept, kept[:0]))
        held_out += _explained(normal[fold], right[fold], with_kernels) - _explained(normal[fold], right[fold], without)
    found = PointSpread(shares, covariance, gain, held_out, misfit, likeliest=shares)
    return found if found.proven else replace(found, shares=np.zeros(TERMS))


@dataclass(frozen=True, eq=False)
class _Lenses:
    """The equations under each thing that is supposed of a lens: how much it scatters, how alike its channels are.

    - `matrices`, `vector`: (L, TERMS, TERMS), and (TERMS,) of all: the equations.
    - `covariances`: (L, TERMS, TERMS), of all shares.
    - `weights`: (L,), how likely each is by what the print shows, of sum 1.
    - `likeliest_prior`: (TERMS, TERMS), inverse of the shares' covariance beforehand, of the likeliest.
    """

    matrices: _Array
    vector: _Array
    covariances: _Array
    weights: _Array
    likeliest_prior: _Array

    @staticmethod
    def of(shown: tuple[_Array, _Array], known: tuple[_Array, _Array], bits: int) -> _Lenses:
        """Return what becomes of equations (TERMS, TERMS), (TERMS,) of what the print shows.

        `known`: the same, as much of it as is certain in spite of what fits no lens.
        """
        matrix, vector = known
        lenses = _supposed_lenses(bits < VARYING_BITS)
        priors = np.array([np.linalg.inv(_usual_shares(bits, lens)) for lens in lenses])
        # The logarithm of the integral over all shares (D. MacKay, Bayesian interpolation, 1992), about the likeliest
        # of those that a lens can have: a veil below 0 is no reason to suppose one.
        gains = np.array([_positive(matrix + prior, vector, np.arange(TERMS))[1] for prior in priors])
        evidence = gains + np.linalg.slogdet(priors)[1] - np.linalg.slogdet(matrix + priors)[1]
        odds = np.array([lens.odds for lens in lenses])
        weights = odds * np.exp(0.5 * (evidence - evidence.max()))
        return _Lenses(
            shown[0] + priors,
            shown[1],
            np.asarray(np.linalg.inv(matrix + priors), dtype=np.float64),
            weights / weights.sum(),
            priors[int(np.argmax(weights))],
        )

    def shares(self, kept: npt.NDArray[np.int64]) -> tuple[_Array, _Array]:
        """Return the mean shares (TERMS,), others than the kept ones 0, and the covariance about them."""
        each = np.array([_positive(matrix, self.vector, kept)[0] for matrix in self.matrices])
        mean = np.round(self.weights @ each / _ROUNDING) * _ROUNDING
        apart = (each - mean) * np.sqrt(self.weights)[:, None]
        return mean, np.tensordot(self.weights, self.covariances, axes=1) + apart.T @ apart


@dataclass(frozen=True)
class _Lens:
    """What may be supposed of a lens: scatter and reflections have little to do with each other.

    - `near`, `far`, `veil`: size of near and far kernels' shares and of the veil over the usual ones.
    - `far_apart`, `veil_apart`: as `CHANNELS_APART`.
    - `power`: of the distance, by which what it scatters falls; 0 where no kernel's share follows from another's.
    - `odds`: how likely it is beforehand.
    """

    near: float = 1.0
    far: float = 1.0
    far_apart: float = CHANNELS_APART
    power: float = 0.0
    veil: float = 1.0
    veil_apart: float = CHANNELS_APART
    odds: float = 1.0


def _supposed_lenses(few: bool) -> list[_Lens]:
    """Return all that is supposed of lenses; `few`: where cells are so few that they may see nothing of a usual one."""
    clean, clear = (_CLEAN_ODDS_OF_FEW, _CLEAR_ODDS_OF_FEW) if few else (_CLEAN_ODDS, 0.0)
    apart = list(zip(_APART, _APART_ODDS, strict=True))
    scatter = [(_Lens(near=_CLEAN, far=_CLEAN, odds=clean), clean)]
    law = (1 - clean) * _POWER_ODDS / len(_LAWS)
    scatter += [(_Lens(power=power, far=far, far_apart=_SCATTER_APART, odds=law), clear) for power, far in _LAWS]
    other = (1 - clean) * (1 - _POWER_ODDS) / len(_FAR_SIZES)
    scatter += [
        (_Lens(far=size, far_apart=one, odds=other * odds), clear) for size, (one, odds) in product(_FAR_SIZES, apart)
    ]
    found = [replace(one, veil=_CLEAN, odds=one.odds * without) for one, without in scatter if without]
    return found + [
        replace(one, veil_apart=alike, odds=one.odds * (1 - without) * odds)
        for (one, without), (alike, odds) in product(scatter, apart)
    ]


def _usual_wide_light(bits: int, scatters: bool) -> _Array:
    """Return the mean squares (TERMS, TERMS) beforehand of the shares that spread over much of the frame, 0 of others.

    `scatters`: whether it is known that the lens does.
    """
    wide = _terms(far_groups()[-_WIDE_KERNELS - 1 :])
    supposed = [lens for lens in _supposed_lenses(bits < VARYING_BITS) if lens.near == 1 or not scatters]
    found = np.zeros((TERMS, TERMS))
    for lens in supposed:
        share = lens.odds / sum(one.odds for one in supposed)
        found[np.ix_(wide, wide)] += share * _usual_shares(bits, lens)[np.ix_(wide, wide)]
    return found


def _usual_shares(bits: int, lens: _Lens) -> _Array:
    """Return the covariance (TERMS, TERMS) of shares before they are measured."""
    usual = np.diag(np.full(TERMS, (lens.near * _PRIOR_SHARE) ** 2))
    if bits < VARYING_BITS:
        varying = np.concatenate([group for group in groups_of_terms() if len(group) > _EVEN_TERMS])
        usual[varying, varying] = (lens.near * _SMALL_SHARE) ** 2
    *kernels, veil = (group for group in groups_of_terms() if len(group) <= _EVEN_TERMS)
    if lens.power:
        law = _law(lens.power)
        law[len(NEAR_PX) :] *= lens.far
        sizes = _SCATTERED**2 * np.outer(law, law)
        off_law = np.diag(_OFF_LAW**2 * np.diag(sizes))
    else:
        kernels = kernels[len(NEAR_PX) :]
        handed_on = np.eye(len(FAR_PX))
        # The first of them is as much a near one.
        for kernel in range(2, len(FAR_PX)):
            handed_on[kernel] += _FAR_FALL * handed_on[kernel - 1]
        sizes = (handed_on * (lens.far * np.array(_FAR_STEPS)) ** 2) @ handed_on.T
        off_law = np.zeros_like(sizes)
    for one, row, own in zip(kernels, sizes, off_law, strict=True):
        for other, both, alone in zip(kernels, row, own, strict=True):
            usual[np.ix_(one, other)] = both * channels_alike(lens.far_apart) + alone * channels_alike(_LAW_APART)
    usual[np.ix_(veil, veil)] = (lens.veil * USUAL_VEIL) ** 2 * channels_alike(lens.veil_apart)
    return usual


def _law(power: float) -> _Array:
    """Return the share (K,) of each kernel, near and far, in light that falls by a power of the distance.

    Such a law is a mixture of Gaussians of all sizes, σ^(1 − power) dσ of each; a kernel stands for those nearer to it
    than to others by the ratio of sizes.
    """
    scale = np.array(NEAR_PX + FAR_PX)
    between = np.sqrt(scale[1:] * scale[:-1])
    edges = np.array([scale[0] ** 2 / between[0], *between, scale[-1] ** 2 / between[-1]])
    amount = np.log(edges) if power == 2 else edges ** (2 - power) / (2 - power)
    share: _Array = np.diff(amount) / (amount[-1] - amount[0])
    return share


def channels_alike(apart: float = CHANNELS_APART) -> _Array:
    """Return the correlation (3, 3) float64 of far shares of R, G and B before they are measured."""
    return (1 - apart**2) + apart**2 * np.eye(3)


def _of(normal: _Array, right: _Array, prior: _Array, chosen: npt.NDArray[np.int64]) -> tuple[_Array, _Array, _Array]:
    return normal[np.ix_(chosen, chosen)], right[chosen], prior[np.ix_(chosen, chosen)]


def _misfit(normal: _Array, right: _Array, prior: _Array, shapes: int) -> float:
    """Return what smooth light beyond the kernels' explains for each of its unknowns, over chance, at least 1.

    The unknowns behind the shares are light that changes smoothly over the frame and adds to dark and bright cells
    alike. Where the kernels and an even veil are all that there is, each of them lowers the sum of squares by about 1.
    """
    with_shape = _without_factors(normal, right, prior, TERMS + shapes)
    without = np.delete(np.arange(len(prior)), np.arange(TERMS, TERMS + shapes))
    plain = _without_factors(*_of(normal, right, prior, without))
    gains = [_explained(*found, np.asarray(np.linalg.solve(*found), dtype=np.float64)) for found in (with_shape, plain)]
    return max(1.0, (gains[0] - gains[1]) / shapes)


def _rows(
    one: SpreadData, number: int, cells_mm: _Array, page_mm: tuple[float, float], bits: int, lens: _Array | None = None
) -> _Rows:
    """Return the rows of a channel of a frame, whose smooth factors are the `number`-th.

    `lens`: (T,), shares of the channel by which levels are corrected before others are predicted by them.
    """
    level = np.where(one.usable, one.level, np.nan)
    # A cell that cannot be used gets its neighbour's value, so that it does no more harm than one outlier.
    there = np.flatnonzero(one.usable)
    nearest = there[np.clip(np.searchsorted(there, np.arange(len(level))), 0, len(there) - 1)]
    level = np.where(one.usable, level, one.level[nearest])
    model = LevelModel.of(level if lens is None else level - one.changes @ lens, one.usable, bits)
    left = model.residual_of(level)
    expected = model.predicted
    factor = page_polynomial(cells_mm, page_mm, _FACTOR_ORDER)[:, 1:]
    shape = page_polynomial(cells_mm, page_mm, _SHAPE_ORDER)[:, 1:]
    ink = factor[:, : len(page_powers(_INK_ORDER)) - 1]
    dense = expected * np.log(np.clip(expected, 0.01, None))
    even = shape * one.even[:, None]
    smooth = np.column_stack([factor * expected[:, None], ink * dense[:, None]])
    columns = np.column_stack([one.changes, even, bent(expected, one.field), smooth])
    chosen, folds = _by_fold(np.flatnonzero(model.known & one.usable), cells_mm, page_mm)
    common = TERMS + even.shape[1] + 3
    own = smooth.shape[1]
    shapes: npt.NDArray[np.int64] = np.arange(TERMS, common - 3, dtype=np.int64)
    return _Rows(
        value=left[chosen],
        design=model.residual(columns)[chosen],
        level=expected[chosen],
        folds=folds,
        unknowns=np.concatenate(
            [
                terms_of(one.channel),
                shapes,
                np.array([common - 3 + one.channel]),
                np.arange(own, dtype=np.int64) + common + number * own,
            ]
        ),
        freedom=model.freedom,
    )


def bent(level: _Array, field: _Array) -> _Array:
    """Return how levels (N,) change where counts fall short in proportion to the light, whites setting the field."""
    return level * (1 - level) * field


def _by_fold(
    points: npt.NDArray[np.int64], places_mm: _Array, page_mm: tuple[float, float]
) -> tuple[npt.NDArray[np.int64], tuple[slice, ...]]:
    """Return points (N,) ordered by the fold of their places (P, 2), and where each fold's are."""
    patch = np.floor(places_mm[points] / (max(page_mm) / _PATCHWORK)).astype(np.int64)
    fold = (patch[:, 0] + 2 * patch[:, 1]) % FOLDS
    order = np.argsort(fold, kind="stable")
    ends = np.searchsorted(fold[order], np.arange(FOLDS + 1)).tolist()
    return points[order], tuple(slice(start, end) for start, end in pairwise(ends))


def _reference_rows(one: ReferenceData, page_mm: tuple[float, float]) -> _Rows:
    """Return the rows of references of one colour: what is not smooth over the page, of values and changes alike."""
    smooth = page_polynomial(one.places_mm, page_mm, one.order)
    columns = np.column_stack([one.level, one.changes, bent(one.level, one.field)])
    rough = columns - smooth @ np.linalg.lstsq(smooth, columns, rcond=None)[0]
    chosen, folds = _by_fold(np.arange(len(rough)), one.places_mm, page_mm)
    return _Rows(
        value=rough[chosen, 0],
        design=rough[chosen, 1:],
        level=np.full(len(one.level), float(one.level.mean())),
        folds=folds,
        unknowns=np.append(terms_of(one.channel), _bend_of(one.channel)),
    )


def _weights(left: _Array, level: _Array) -> _Array:
    """Return the weight (N,) of each row from what is left of it: over the usual variance of its level, Huber's."""
    groups = min(_LEVELS, len(left) // 8) if float(np.ptp(level)) > 0 else 1
    variance = sigma_by_level(left, level, groups) ** 2 + 1e-12
    far = np.abs(left) / np.sqrt(variance)
    weights: _Array = np.minimum(1.0, _HUBER / np.maximum(far, 1e-9)) / variance
    return weights


def _normal_equations(rows: Sequence[_Rows], solution: _Array) -> tuple[_Array, _Array]:
    """Return matrix (FOLDS, T, T) and right side (FOLDS, T), weighted by what a solution (T,) leaves."""
    size = len(solution)
    normal, right = np.zeros((FOLDS, size, size)), np.zeros((FOLDS, size))
    for one in rows:
        root = np.sqrt(one.freedom * _weights(one.value - one.design @ solution[one.unknowns], one.level))
        weighted, value = one.design * root[:, None], one.value * root
        for fold, there in enumerate(one.folds):
            normal[fold][np.ix_(one.unknowns, one.unknowns)] += weighted[there].T @ weighted[there]
            right[fold][one.unknowns] += weighted[there].T @ value[there]
    return normal, right


def _without_factors(normal: _Array, right: _Array, prior: _Array, kept: int = TERMS) -> tuple[_Array, _Array]:
    """Return the equations (kept, kept), (kept,) of the first unknowns alone: smooth factors eliminated (Schur)."""
    full = normal + prior
    share = np.linalg.solve(full[kept:, kept:], full[kept:, :kept]).T
    matrix = full[:kept, :kept] - share @ full[kept:, :kept]
    return 0.5 * (matrix + matrix.T), right[:kept] - share @ right[kept:]


def _solved(normal: _Array, right: _Array, prior: _Array, kept: npt.NDArray[np.int64]) -> _Array:
    """Return all unknowns (T,), shares other than the kept ones 0."""
    shares, _ = _positive(*_without_factors(normal, right, prior), kept)
    full = normal + prior
    solution = np.empty(len(right))
    solution[:TERMS] = shares
    solution[TERMS:] = np.linalg.solve(full[TERMS:, TERMS:], right[TERMS:] - full[TERMS:, :TERMS] @ shares)
    return solution


def _explained(matrix: _Array, vector: _Array, solution: _Array) -> float:
    return float(2 * vector @ solution - solution @ matrix @ solution)


def _positive(matrix: _Array, vector: _Array, kept: npt.NDArray[np.int64]) -> tuple[_Array, float]:
    """Return the shares (TERMS,) that lower the sum of squares most, others than the kept ones 0, and by how much.

    Far kernels' and the veil's are 0 or more: non-negative least squares of the equations' Cholesky factor (C. Lawson
    and R. Hanson, Solving Least Squares Problems, 1974), the free ones eliminated.
    """
    shares = np.zeros(TERMS)
    free, bound = (kept[free_terms()[kept] == wanted] for wanted in (True, False))
    inner, across = matrix[np.ix_(free, free)], matrix[np.ix_(free, bound)]
    if len(bound):
        reduced = matrix[np.ix_(bound, bound)] - across.T @ np.linalg.solve(inner, across)
        right = vector[bound] - across.T @ np.linalg.solve(inner, vector[free])
        factor = np.linalg.cholesky(0.5 * (reduced + reduced.T))
        shares[bound] = nnls(factor.T, np.linalg.solve(factor, right))[0]
    if len(free):
        shares[free] = np.linalg.solve(inner, vector[free] - across @ shares[bound])
    return shares, _explained(matrix, vector, shares)


def _selected(
    matrix: _Array, vector: _Array, misfit: float, candidates: list[npt.NDArray[np.int64]]
) -> npt.NDArray[np.int64]:
    """Return the unknowns that are worth their place: the weakest kernel is left out until each one gains enough."""
    kernels = list(candidates)
    _, gain = _positive(matrix, vector, _terms(kernels))
    while kernels:
        without = [
            np.concatenate([*kernels[:k], *kernels[k + 1 :], np.zeros(0, dtype=np.int64)]) for k in range(len(kernels))
        ]
        gains = [_positive(matrix, vector, np.sort(rest))[1] for rest in without]
        # Chance gains one for each unknown.
        worth = [gain - less - misfit * (LEAST_GAIN + len(own) - 1) for less, own in zip(gains, kernels, strict=True)]
        weakest = int(np.argmin(worth))
        if worth[weakest] > 0:
            break
        gain = gains[weakest]
        kernels.pop(weakest)
    return _terms(kernels)


def _terms(kernels: Sequence[npt.NDArray[np.int64]]) -> npt.NDArray[np.int64]:
    return np.sort(np.concatenate([*kernels, np.zeros(0, dtype=np.int64)]))
