"""Linearity of the sensor by flux superposition: red, green and blue alone against a light that is made of them.

Light adds: what a patch has under a light of several primaries is what it has under each alone, times how much of each
there is. Counts that are proportional to light add up likewise; those of a sensor that compresses near saturation,
loses counts near black or has its black elsewhere do not. The patches of a chart have all levels from black ink to bare
paper, so that four frames show the whole curve. Neither print, lens nor the photosites' response matters, since the
same photosites see all four; nor does a lamp that was brighter in one of the frames, since how much there is of each
primary is fitted along. Detectors are calibrated so (superposition or flux-addition method: C. L. Sanders, Applied
Optics 1, 1962).

A factor common to all counts is not seen, and matters to no chromaticity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import code_polynomial
from foundation.robust import huber_weights, sigma_by_level

# Shares of saturation between which the deviation is interpolated; it is 0 at black.
NODES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 1.0)

# Standard deviation, before it is measured, of the relative deviation at saturation: EMVA 1288 linearity errors of
# cameras' raw files are below 1 %.
_USUAL_BEND = 0.01

_USUAL_LOSS = 0.0005  # The same of what is lost or added near black, of saturation: some counts of 14 bits

_LOSS_SCALES = (0.0005, 0.002)  # Shares of saturation within which that happens

_USUAL_REST = 0.0003  # The same of what is neither, of each level

_SCALES = (0.03, 0.3, 1.0, 3.0, 10.0)  # By how much a camera may deviate otherwise than usual

_LEAST_PATCHES = 100  # Patches in a channel from which on something is said (judgement)

_CODE_DEGREE = 4  # Of the polynomial in the codes that says what a patch has without its noise

_LOOSE = 10.0  # Standard deviation of how much of a primary a light has, before it is fitted: nothing is known

_OWN_SPECTRUM = 0.001  # The same of how it differs from channel to channel: a primary keeps its spectrum

# What full white may be: how its primaries differ beside what they have in common, how each does from channel to
# channel, and how likely that is beforehand (chosen). The primaries as they are alone; these, of a wheel that
# exposures cut; and light of another spectrum besides, of a projector that brightens white.
_WHITES = ((0.003, _OWN_SPECTRUM, 0.6), (0.05, _OWN_SPECTRUM, 0.3), (_LOOSE, _LOOSE, 0.1))

_GROUPS = 12  # Groups of like levels, in each of which the scatter is measured

_ROUNDS = 3  # Solutions in a row, each weighted and linearised by the one before

_AMOUNTS = 12  # Unknowns before the nodes': of each primary, and what each channel sees otherwise

_Array = npt.NDArray[np.float64]


_SERIES = "give a series of exposures of the chart with --linearity"


@dataclass(frozen=True)
class Unmeasured:
    """Why superposition shows nothing in a session, and what would."""

    why: str
    remedy: str


NO_PRIMARIES = Unmeasured(
    "no lights of each primary alone show it",
    f"plan red, green and blue each alone (acquire illuminations does), or {_SERIES}",
)
MOVED = Unmeasured(
    "the chart moved between the frames of the primaries and the one that is registered first",
    f"see that print and camera stay where they are, or {_SERIES}",
)


@dataclass(frozen=True, eq=False)
class Superposition:
    """How counts deviate from proportion to light, and how well that is known.

    - `full`: counts above black of saturation.
    - `deviation`: (K,) float64 counts at `NODES`, what is measured less what a proportional sensor would have.
    - `covariance`: (K, K) float64 counts².
    - `unmeasured`: why frames do not show it, where it is what is usual of cameras; None where they do.
    """

    full: float
    deviation: _Array
    covariance: _Array
    unmeasured: Unmeasured | None

    @staticmethod
    def usual(full: float, unmeasured: Unmeasured = NO_PRIMARIES) -> Superposition:
        """Return what is usual of cameras, where a session shows nothing of it."""
        return Superposition(full, np.zeros(len(NODES)), _usual(full), unmeasured)

    @property
    def measured(self) -> bool:
        """Whether frames show it."""
        return self.unmeasured is None

    def relative(self, level: _Array) -> tuple[_Array, _Array]:
        """Return the relative deviation (...) at levels (...), counts above black, and its weights (..., K)."""
        weights = _hats(level / self.full) / np.maximum(level, 1e-9)[..., None]
        return weights @ self.deviation, weights

    def errors(self, level: _Array, reference: _Array) -> _Array:
        """Return the mean square (...) of the relative error of levels (...) to references of any shape that fits.

        What is measured is not taken out of the counts: it counts as an error of its full size.
        """
        off, variance = self.beside(level, reference)
        return off**2 + variance

    def beside(self, level: _Array, reference: _Array) -> tuple[_Array, _Array]:
        """Return the relative deviation (...) of levels less that of references, and the square of its error."""
        (found, weights), (at_reference, of_reference) = self.relative(level), self.relative(reference)
        weights = weights - of_reference
        return found - at_reference, np.einsum("...k,kl,...l->...", weights, self.covariance, weights)

    def white_covariance(self, white: _Array) -> _Array:
        """Return the mean square (L, 3, 3) float64 of the relative error that it leaves in whites (L, 3), counts."""
        found, weights = self.relative(white)
        off = found - found.mean(axis=1, keepdims=True)
        return weights @ self.covariance @ np.swapaxes(weights, 1, 2) + off[:, :, None] * off[:, None, :]

    def to_json(self) -> dict[str, Any]:
        """Return it as `report.json` states it: shares of each node's level."""
        level = np.array(NODES) * self.full
        shares = {"deviation": self.deviation / level, "standard_error": np.sqrt(np.diag(self.covariance)) / level}
        rounded = {name: [float(f"{value:.4g}") for value in found.tolist()] for name, found in shares.items()}
        return {"measured": self.measured, "level_share": list(NODES), **rounded}


def superposition(
    alone: Sequence[_Array],
    together: _Array,
    full: float,
    usable: npt.NDArray[np.bool_],
    known: _Array,
    white: bool,
) -> Superposition:
    """Return what a light of several primaries shows beside each alone; what is usual where that is too little.

    `alone`: three (P, 3) float64 counts above black of patches under red, green and blue alone, nothing but black
    subtracted. `together`: (P, 3) the same under the light. `full`: counts above black of saturation. `usable`: (P,)
    bool, patches that are inside the frames, not clipped and not covered. `known`: (P, M) float64, what patches are
    printed with, which predicts their levels without noise. `white`: whether the light is all of each primary.
    """
    patches, needed = int(usable.sum()), max(_LEAST_PATCHES, 2 * known.shape[1])
    if patches < needed:
        why = f"{patches} patches of the chart can be used for it and {needed} are needed, whichever lights are planned"
        return Superposition.usual(full, Unmeasured(why, f"use a chart of more colours, or {_SERIES}"))
    seen, known = np.stack([together, *alone])[:, usable], known[usable]
    hats, size = _hats(seen / full), _AMOUNTS + len(NODES)
    whites = _WHITES if white else ((_LOOSE, _LOOSE, 1.0),)
    priors = [(_prior(full, scale, like, own), odds) for scale, (like, own, odds) in product(_SCALES, whites)]
    # Unknowns are what is there beside this: sums of squares of the light itself would drown what tells priors apart.
    usual = np.zeros(size)
    usual[:3] = 1.0 if white else np.linalg.lstsq(seen[1:].reshape(3, -1).T, seen[0].ravel(), rcond=None)[0]
    solution, covariance = usual, np.zeros((size, size))
    for _ in range(_ROUNDS):
        matrix, right, misfit = np.zeros((size, size)), np.zeros(size), 1.0
        for channel in range(3):
            own = slice(3 + 3 * channel, 6 + 3 * channel)
            amounts = solution[:3] + solution[own]
            value, parts = seen[0, :, channel], seen[1:, :, channel].T
            # What proportional counts would have: value - m(value) = sum of amount (part - m(part)).
            bend = hats[0, :, channel] - np.einsum("k,kpn->pn", amounts, hats[1:, :, channel])
            design = np.zeros((len(value), size))
            design[:, :3], design[:, own], design[:, _AMOUNTS:] = parts, parts, bend
            left = value - design @ solution
            sigma = sigma_by_level(left, value, _GROUPS) + 1e-9
            root = huber_weights(np.abs(left) / sigma, 1.0) / sigma
            # The primaries' frames have noise, too; what the print gives of them has not (two-stage least squares).
            rows, told = root[:, None] * known, root[:, None] * design
            clean = rows @ np.linalg.lstsq(rows, told, rcond=None)[0]
            matrix += clean.T @ clean
            right += clean.T @ (root * (value - design @ usual))
            misfit = max(misfit, _misfit(rows, root * left))
        beside, covariance = _posterior(matrix / misfit, right / misfit, priors)
        solution = usual + beside
    return Superposition(full, solution[_AMOUNTS:], covariance[_AMOUNTS:, _AMOUNTS:], None)


def _posterior(matrix: _Array, right: _Array, priors: Sequence[tuple[_Array, float]]) -> tuple[_Array, _Array]:
    """Return mean (U,) and covariance (U, U) of the unknowns: of each prior's solution by how likely it makes the data.

    `priors`: the inverse (U, U) of each one's covariance, and how likely it is beforehand.

    Bayesian model averaging (J. A. Hoeting and others, Statistical Science 14, 1999): of a small bend the usual prior
    says more than a chart of few cells, of a large one the cells do.
    """
    covariances: list[_Array] = []
    means: list[_Array] = []
    evidence = np.zeros(len(priors))
    for number, (prior, odds) in enumerate(priors):
        # Brought to a diagonal of 1: amounts of light and counts near black differ by ten powers of ten.
        size = np.sqrt(np.diag(matrix + prior))
        scaled = (matrix + prior) / np.outer(size, size)
        covariance: _Array = np.linalg.inv(scaled) / np.outer(size, size)
        mean: _Array = np.linalg.solve(scaled, right / size) / size
        known = np.linalg.slogdet(scaled)[1] + 2 * np.log(size).sum()
        evidence[number] = 0.5 * (right @ mean - known + np.linalg.slogdet(prior)[1]) + np.log(odds)
        covariances.append(covariance)
        means.append(mean)
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    mean = np.einsum("m,mu->u", weights, means)
    apart = np.array(means) - mean
    return mean, np.einsum("m,muv->uv", weights, covariances) + np.einsum("m,mu,mv->uv", weights, apart, apart)


def printed_predictors(codes: npt.ArrayLike, references: npt.NDArray[np.integer]) -> _Array:
    """Return what cells and references are printed with, (C + N, M) float64, as `superposition` asks for.

    `codes`: (C, 3) int, 0 … 255. `references`: (N,) int, which of them have one colour, from 0.
    """
    cells = code_polynomial(codes, _CODE_DEGREE)
    alike = np.eye(int(references.max(initial=-1)) + 1)[references]
    corner = np.zeros((len(cells), alike.shape[1])), np.zeros((len(alike), cells.shape[1]))
    return np.block([[cells, corner[0]], [corner[1], alike]])


def _prior(full: float, scale: float, like: float, own: float) -> _Array:
    """Return the inverse of the prior covariance of all unknowns; `like`, `own`: as in `_WHITES`."""
    prior = np.zeros((_AMOUNTS + len(NODES), _AMOUNTS + len(NODES)))
    prior[:3, :3] = np.linalg.inv(_LOOSE**2 * np.ones((3, 3)) + like**2 * np.eye(3))
    prior[3:_AMOUNTS, 3:_AMOUNTS] = np.eye(_AMOUNTS - 3) / own**2
    prior[_AMOUNTS:, _AMOUNTS:] = np.linalg.inv(scale**2 * _usual(full))
    return prior


def _usual(full: float) -> _Array:
    """Return the covariance (K, K) float64 counts² that is usual: bends of all counts, what is lost near black."""
    level = np.array(NODES)
    bends = [_USUAL_BEND * level**2, _USUAL_BEND * level**3]
    losses = [_USUAL_LOSS * (1 - np.exp(-level / scale)) for scale in _LOSS_SCALES]
    # The amounts of the primaries go along with any straight line: of all that fit as well, the one with none.
    shapes = [shape - level * float((shape / level).mean()) for shape in (*bends, *losses)]
    found: _Array = full**2 * (
        np.sum([np.outer(one, one) for one in shapes], axis=0) + np.diag(_USUAL_REST * level) ** 2
    )
    return found


def _hats(share: _Array) -> _Array:
    """Return the weights (..., K) float64 of the nodes at shares (...) of saturation, linear between them."""
    nodes = np.array([0.0, *NODES])
    inside = np.clip(share, 0, nodes[-1])
    right = np.clip(np.searchsorted(nodes, inside, side="right"), 1, len(nodes) - 1)
    part = (inside - nodes[right - 1]) / (nodes[right] - nodes[right - 1])
    weights = np.zeros((*share.shape, len(nodes)))
    np.put_along_axis(weights, right[..., None], part[..., None], axis=-1)
    np.put_along_axis(weights, right[..., None] - 1, 1 - part[..., None], axis=-1)
    return weights[..., 1:]


def _misfit(known: _Array, left: _Array) -> float:
    """Return what the print explains of what is left, for each of its unknowns, over chance: at least 1."""
    explained = known @ np.linalg.lstsq(known, left, rcond=None)[0]
    return max(1.0, float(explained @ explained) / known.shape[1])
