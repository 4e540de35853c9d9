"""What light a table can make: every mixture of its lights, and the mixture for a wanted chromaticity.

A light is a direction in linear camera RGB, its chromaticity. What lights can make together is the cone that they
span; in the rb-chromaticity plane (r = R / (R + G + B), b = B / (R + G + B)) it is their convex hull, in which three
lights suffice for any point (Carathéodory). Which are taken:

1. one light, if one is within `TOLERANCE_DEG` of what is wanted;
2. else two neighbours, if what is wanted is so near to what they can make; of several pairs the closest;
3. else the three neighbours around it, which then match exactly.

Neighbours are those of the Delaunay triangulation of the rb-chromaticities. Near lights have spectra near to what is
wanted, so that not only white but every colour looks as it would under a real light of that chromaticity; far lights
of the same mixed white would be a metamer of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg
from foundation.errors import InputError
from generator.lights.lighting import Mixture, mixture_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut

# Angle to a wanted light within which one light, or two, are taken instead of three, degrees: about a table's own
# error.
TOLERANCE_DEG: Final = 0.01

# What to do about a light that the table cannot make: refuse it, or take the nearest that it can.
OutsideGamut = Literal["refuse", "nearest"]

_Array = npt.NDArray[np.float64]
# Ratio of the singular values of the lights' chromaticities below which they lie on a line: far above what rounding
# makes of a line, far below the breadth of three lights of a projector.
_THIN: Final = 1e-6


@dataclass(frozen=True)
class Match:
    """The mixture found for a wanted light, and the angle between the two in degrees."""

    mixture: Mixture
    angle: float


@dataclass(frozen=True, eq=False)
class Gamut:
    """The mixtures of some lights.

    - `white`: (L, 3) float64 > 0, the ground truths of the lights in linear camera RGB.
    - `table`: name of the table in messages.
    """

    white: _Array
    table: str = "the table"

    @classmethod
    def of(cls, lut: Lut) -> Gamut:
        """Return the gamut of a table."""
        return cls(lut.white, f"the table {lut.folder}")

    @cached_property
    def rb(self) -> _Array:
        """(L, 2) float64, the chromaticities r and b of the lights."""
        return rb_of(self.white)

    @cached_property
    def directions(self) -> _Array:
        """(L, 3) float64, the lights' whites, of length 1."""
        return _unit(self.white)

    @cached_property
    def triangles(self) -> npt.NDArray[np.int64]:
        """(T, 3) int64, the lights at the corners of the Delaunay triangles; none where the lights lie on a line."""
        from scipy.spatial import Delaunay

        if self._along is not None:
            return np.zeros((0, 3), np.int64)
        return np.sort(np.asarray(Delaunay(self.rb).simplices, dtype=np.int64), axis=1)

    @cached_property
    def edges(self) -> npt.NDArray[np.int64]:
        """(E, 2) int64, the pairs of neighbours."""
        if self._along is not None:
            return np.array(list(pairwise(self._along)), np.int64).reshape(-1, 2)
        corners = self.triangles
        return np.unique(np.concatenate([corners[:, [0, 1]], corners[:, [0, 2]], corners[:, [1, 2]]]), axis=0)

    def contains(self, wanted: _Array) -> npt.NDArray[np.bool_]:
        """Return (N,) bool, whether three lights make each light: (N, 3) float64, linear RGB, or (N, 2), r and b."""
        rgb = wanted if wanted.shape[1] == 3 else rgb_of(wanted)
        shares = (self._inverses.reshape(-1, 3) @ rgb.T).reshape(-1, 3, len(rgb))
        return (shares.min(axis=1) >= 0).any(axis=0)

    def match(self, wanted: npt.ArrayLike, outside: OutsideGamut = "refuse") -> Match:
        """Return the mixture of the fewest near lights for a wanted light, by the rule at the head of this file.

        `wanted`: (3,) float64 ≥ 0, linear RGB of the table's camera, of any length.
        """
        light = np.asarray(wanted, dtype=np.float64)
        if light.shape != (3,) or not np.isfinite(light).all() or light.min() < 0 or light.max() <= 0:
            raise InputError(f"{light.tolist()} is no light: expected three numbers from 0, one above 0")
        target = _unit(light)
        nearest = self._nearest_light(target)
        if nearest.angle <= TOLERANCE_DEG:
            return nearest
        pairs, shares, angles = self._pairs(target)
        near = np.flatnonzero(angles <= TOLERANCE_DEG)
        if len(near):
            u, v = self.directions[pairs[near, 0]], self.directions[pairs[near, 1]]
            best = int(near[(u * v).sum(axis=1).argmax()])
            return self._found(pairs[best], shares[best], target)
        if len(self.triangles):
            within = self._inverses @ target
            best = int(within.min(axis=1).argmax())
            if within[best].min() >= 0:
                return self._found(self.triangles[best], within[best], target)
        if len(pairs) and angles.min() < nearest.angle:
            best = int(angles.argmin())
            nearest = self._found(pairs[best], shares[best], target)
        if outside == "nearest":
            return nearest
        r, b = rb_of(target)
        near_r, near_b = rb_of(np.asarray(nearest.mixture.weights) @ self.white[list(nearest.mixture.lights)])
        raise InputError(
            f"the light r={r:.4f}, b={b:.4f} lies {nearest.angle:.2f}° outside what {self.table} can make; the nearest "
            f"it can is r={near_r:.4f}, b={near_b:.4f}: ask for that"
        )

    @cached_property
    def _along(self) -> list[int] | None:
        """The lights in their order along a line, if they lie on one; of lights in one place the first."""
        aside = self.rb - self.rb.mean(axis=0)
        _, sizes, axes = np.linalg.svd(aside, full_matrices=False)
        if len(self.rb) > 2 and sizes[1] > _THIN * max(float(sizes[0]), _THIN):
            return None
        places = np.asarray(aside @ axes[0], dtype=np.float64)
        order = np.argsort(places, kind="stable")
        apart = np.diff(places[order], prepend=-np.inf) > _THIN**2
        return [int(light) for light in order[apart]]

    @cached_property
    def _inverses(self) -> _Array:
        """(T, 3, 3) float64, from a light's RGB to the shares of the three directions at a triangle's corners."""
        corners = self.directions[self.triangles].transpose(0, 2, 1)
        # A triangle without area makes nothing that its edges do not make.
        flat = np.abs(np.linalg.det(corners)) < 1e-15 if len(corners) else np.zeros(0, bool)
        inverses = np.full(corners.shape, -1.0)
        inverses[~flat] = np.linalg.inv(corners[~flat])
        return inverses

    @cached_property
    def _cosines(self) -> _Array:
        """(E,) float64, of the angles between neighbours."""
        return (self.directions[self.edges[:, 0]] * self.directions[self.edges[:, 1]]).sum(axis=1)

    def _nearest_light(self, target: _Array) -> Match:
        light = int((self.directions @ target).argmax())
        return Match(mixture_of({light: 1.0}), float(angles_deg(self.white[light], target)))

    def _pairs(self, target: _Array) -> tuple[npt.NDArray[np.int64], _Array, _Array]:
        """Return the pairs of neighbours between whose lights the target falls.

        Returns their lights (P, 2) int64, the shares (P, 2) float64 that make the nearest to the target, and its angle
        to the target (P,) float64, degrees.
        """
        at_u, at_v = (self.directions @ target)[self.edges.T]
        cosine = self._cosines
        area = np.maximum(1 - cosine**2, 1e-30)
        shares = np.stack([at_u - cosine * at_v, at_v - cosine * at_u], axis=1) / area[:, None]
        between = (shares > 0).all(axis=1)
        # The foot is as long as the cosine of the angle; what foot and target have in common is the square of that.
        common = (shares[:, 0] * at_u + shares[:, 1] * at_v)[between]
        return self.edges[between], shares[between], np.degrees(np.arccos(np.sqrt(np.minimum(common, 1))))

    def _found(self, lights: npt.NDArray[np.int64], shares: _Array, target: _Array) -> Match:
        """Return the match of `shares` (K,) float64 of the directions of `lights` (K,) int64."""
        weights = np.maximum(shares, 0) / np.linalg.norm(self.white[lights], axis=1)
        mixture = mixture_of({int(light): float(weight) for light, weight in zip(lights, weights, strict=True)})
        made = np.asarray(mixture.weights) @ self.white[list(mixture.lights)]
        return Match(mixture, float(angles_deg(made, target)))


def rb_of(rgb: _Array) -> _Array:
    """Return the chromaticities (..., 2) float64, r and b, of linear RGB (..., 3) float64 of any length."""
    return rgb[..., [0, 2]] / rgb.sum(axis=-1, keepdims=True)


def rgb_of(rb: npt.ArrayLike) -> _Array:
    """Return linear RGB (..., 3) float64 of sum 1 for chromaticities (..., 2), r and b."""
    rb = np.asarray(rb, dtype=np.float64)
    return np.stack([rb[..., 0], 1 - rb[..., 0] - rb[..., 1], rb[..., 1]], axis=-1)


def _unit(rgb: _Array) -> _Array:
    """Return (..., 3) float64 at length 1."""
    return rgb / np.linalg.norm(rgb, axis=-1, keepdims=True)


def black_body(lut: Lut, cct_k: float) -> Mixture:
    """Return the light of a black body between those of the table: its two neighbours, in proportion by mired.

    The temperature says what was asked of the projector, which shows three primaries in the proportion that looks, to
    the CIE 1931 standard observer, like the black body (`experiment.lights.blackbody_light`). The camera
    is not that observer: its white under this light is what the ground truth says, and not what the black body's own
    spectrum would give. So a temperature names one of the table's lights, or one between, and is no measurement by the
    camera.

    Chromaticities along the black bodies are close to linear in mired (10⁶ / K). Between lights 200 K apart that is
    as good as a cubic spline and within what the projector's codes of 8 bits allow: 0.05° median, 0.2° worst.
    """
    bodies = sorted((light.cct_k, light.index) for light in lut.illuminations if light.cct_k is not None)
    if not bodies:
        raise InputError(f"the table {lut.folder} has no black bodies; ask for a chromaticity as r=…,b=… instead")
    if not bodies[0][0] <= cct_k <= bodies[-1][0]:
        raise InputError(
            f"{cct_k:g} K is outside the black bodies of the table {lut.folder}, {bodies[0][0]:g} to "
            f"{bodies[-1][0]:g} K; ask for one of these, or for a chromaticity as r=…,b=…"
        )
    for (cold, first), (hot, second) in pairwise(bodies):
        if cold < cct_k < hot:
            share = (1e6 / cold - 1e6 / cct_k) / (1e6 / cold - 1e6 / hot)
            one, other = lut.white[first].sum(), lut.white[second].sum()
            return mixture_of({first: (1 - share) / one, second: share / other})
    return mixture_of({next(index for kelvin, index in bodies if kelvin == cct_k): 1.0})
