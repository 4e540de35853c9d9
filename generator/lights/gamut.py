"""Gamut of a LUT: the mixtures of its illuminants, and the mixture for a given chromaticity.

An illuminant is a direction in linear camera RGB. The mixtures of several illuminants form a cone. In the chromaticity
plane of r = R / (R + G + B) and b = B / (R + G + B), this cone is the convex hull of the illuminants. Three illuminants
suffice for any point in it (Carathéodory). `Gamut.match` selects, in this order:

1. one illuminant, if it is within `TOLERANCE_DEG` of the target;
2. two neighbours, if a mixture of them is within this angle; of several such pairs, the pair with the smallest angle
   between its illuminants;
3. the three neighbours around the target, which match exactly.

Neighbours are defined by the Delaunay triangulation of the rb-chromaticities. Neighbours have similar spectra, so their
mixture renders all colours like a real illuminant. A mixture of distant illuminants would match only white, as a
metamer.
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

# One or two illuminants are used instead of three if they come within this angle of the target, in degrees. It is about
# the error of a LUT.
TOLERANCE_DEG: Final = 0.01

# Treatment of a target outside the gamut: refuse it, or use the nearest mixture.
OutsideGamut = Literal["refuse", "nearest"]

_Array = npt.NDArray[np.float64]
# Illuminants are on a line if the singular values of their chromaticities have a ratio below this limit. It is far
# above rounding errors and far below the ratio for three illuminants of a projector.
_THIN: Final = 1e-6


@dataclass(frozen=True)
class Match:
    """The mixture for a target."""

    mixture: Mixture
    angle: float  # between mixture and target, degrees


@dataclass(frozen=True, eq=False)
class Gamut:
    """All mixtures of some illuminants."""

    white: _Array  # (L, 3) float64 > 0, ground truths in linear camera RGB
    table: str = "the LUT"  # name of the LUT in messages

    @classmethod
    def of(cls, lut: Lut) -> Gamut:
        """Return the gamut of a LUT."""
        return cls(lut.white, f"the LUT {lut.folder}")

    @cached_property
    def rb(self) -> _Array:
        """(L, 2) float64, the chromaticities r and b of the illuminants."""
        return rb_of(self.white)

    @cached_property
    def directions(self) -> _Array:
        """(L, 3) float64, the ground truths scaled to length 1."""
        return _unit(self.white)

    @cached_property
    def triangles(self) -> npt.NDArray[np.int64]:
        """(T, 3) int64, illuminants at the corners of the Delaunay triangles; T is 0 if all are on a line."""
        from scipy.spatial import Delaunay

        if self._order_on_line is not None:
            return np.zeros((0, 3), np.int64)
        return np.sort(np.asarray(Delaunay(self.rb).simplices, dtype=np.int64), axis=1)

    @cached_property
    def edges(self) -> npt.NDArray[np.int64]:
        """(E, 2) int64, the pairs of neighbours."""
        if self._order_on_line is not None:
            return np.array(list(pairwise(self._order_on_line)), np.int64).reshape(-1, 2)
        corners = self.triangles
        return np.unique(np.concatenate([corners[:, [0, 1]], corners[:, [0, 2]], corners[:, [1, 2]]]), axis=0)

    def contains(self, points: _Array) -> npt.NDArray[np.bool_]:
        """Return (N,) bool: whether points, (N, 3) float64 linear RGB or (N, 2) r and b, are in the gamut."""
        rgb = points if points.shape[1] == 3 else rgb_of(points)
        shares = (self._inverses.reshape(-1, 3) @ rgb.T).reshape(-1, 3, len(rgb))
        return (shares.min(axis=1) >= 0).any(axis=0)

    def match(self, rgb: npt.ArrayLike, outside: OutsideGamut = "refuse") -> Match:
        """Return the mixture for the target `rgb`, (3,) float64 ≥ 0, linear RGB of the camera, of any length.

        Raises InputError if the target is outside the gamut and `outside` is ``"refuse"``.
        """
        light = np.asarray(rgb, dtype=np.float64)
        if light.shape != (3,) or not np.isfinite(light).all() or light.min() < 0 or light.max() <= 0:
            raise InputError(
                f"{light.tolist()} is not an illuminant, expected three numbers ≥ 0 with a sum above 0; correct it"
            )
        target = _unit(light)
        nearest = self._nearest_light(target)
        if nearest.angle <= TOLERANCE_DEG:
            return nearest
        pairs, shares, angles = self._pairs(target)
        near = np.flatnonzero(angles <= TOLERANCE_DEG)
        if len(near):
            u, v = self.directions[pairs[near, 0]], self.directions[pairs[near, 1]]
            best = int(near[(u * v).sum(axis=1).argmax()])
            return self._match_of(pairs[best], shares[best], target)
        if len(self.triangles):
            triangle_shares = self._inverses @ target
            best = int(triangle_shares.min(axis=1).argmax())
            if triangle_shares[best].min() >= 0:
                return self._match_of(self.triangles[best], triangle_shares[best], target)
        if len(pairs) and angles.min() < nearest.angle:
            best = int(angles.argmin())
            nearest = self._match_of(pairs[best], shares[best], target)
        if outside == "nearest":
            return nearest
        r, b = rb_of(target)
        near_r, near_b = rb_of(np.asarray(nearest.mixture.weights) @ self.white[list(nearest.mixture.lights)])
        raise InputError(
            f"the illuminant r={r:.4f}, b={b:.4f} is {nearest.angle:.2f}° outside the gamut of {self.table}; use the "
            f"nearest chromaticity in the gamut, r={near_r:.4f}, b={near_b:.4f}"
        )

    @cached_property
    def _order_on_line(self) -> list[int] | None:
        """The illuminants in their order along a line, or None if they are not on a line; duplicates are omitted."""
        centred = self.rb - self.rb.mean(axis=0)
        _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
        if len(self.rb) > 2 and sizes[1] > _THIN * max(float(sizes[0]), _THIN):
            return None
        coordinates = np.asarray(centred @ axes[0], dtype=np.float64)
        order = np.argsort(coordinates, kind="stable")
        is_distinct = np.diff(coordinates[order], prepend=-np.inf) > _THIN**2
        return [int(light) for light in order[is_distinct]]

    @cached_property
    def _inverses(self) -> _Array:
        # (T, 3, 3) float64: for each triangle, the matrix from RGB to the shares of its three corners.
        corners = self.directions[self.triangles].transpose(0, 2, 1)
        # A triangle without area has no inverse. Entries of -1 make all shares negative, so that an edge is used
        # instead of the triangle.
        flat = np.abs(np.linalg.det(corners)) < 1e-15 if len(corners) else np.zeros(0, bool)
        inverses = np.full(corners.shape, -1.0)
        inverses[~flat] = np.linalg.inv(corners[~flat])
        return inverses

    @cached_property
    def _cosines(self) -> _Array:
        # (E,) float64, cosines of the angles between neighbours.
        return (self.directions[self.edges[:, 0]] * self.directions[self.edges[:, 1]]).sum(axis=1)

    def _nearest_light(self, target: _Array) -> Match:
        light = int((self.directions @ target).argmax())
        return Match(mixture_of({light: 1.0}), float(angles_deg(self.white[light], target)))

    def _pairs(self, target: _Array) -> tuple[npt.NDArray[np.int64], _Array, _Array]:
        # Returns the pairs of neighbours (P, 2) int64 with the target between them. For each pair, also returns the
        # shares (P, 2) float64 of the mixture that is nearest to the target, and its angle to the target (P,) float64
        # in degrees.
        at_u, at_v = (self.directions @ target)[self.edges.T]
        cosine = self._cosines
        area = np.maximum(1 - cosine**2, 1e-30)
        shares = np.stack([at_u - cosine * at_v, at_v - cosine * at_u], axis=1) / area[:, None]
        between = (shares > 0).all(axis=1)
        # The scalar product of the target with its projection is the square of the cosine of the angle.
        cos_squared = (shares[:, 0] * at_u + shares[:, 1] * at_v)[between]
        return self.edges[between], shares[between], np.degrees(np.arccos(np.sqrt(np.minimum(cos_squared, 1))))

    def _match_of(self, lights: npt.NDArray[np.int64], shares: _Array, target: _Array) -> Match:
        weights = np.maximum(shares, 0) / np.linalg.norm(self.white[lights], axis=1)
        mixture = mixture_of({int(light): float(weight) for light, weight in zip(lights, weights, strict=True)})
        mixed = np.asarray(mixture.weights) @ self.white[list(mixture.lights)]
        return Match(mixture, float(angles_deg(mixed, target)))


def rb_of(rgb: _Array) -> _Array:
    """Return the chromaticities (..., 2) float64, r and b, of linear RGB (..., 3) float64 of any length."""
    return rgb[..., [0, 2]] / rgb.sum(axis=-1, keepdims=True)


def rgb_of(rb: npt.ArrayLike) -> _Array:
    """Return linear RGB (..., 3) float64 of sum 1 for chromaticities (..., 2), r and b."""
    rb = np.asarray(rb, dtype=np.float64)
    return np.stack([rb[..., 0], 1 - rb[..., 0] - rb[..., 1], rb[..., 1]], axis=-1)


def _unit(rgb: _Array) -> _Array:
    return rgb / np.linalg.norm(rgb, axis=-1, keepdims=True)


def black_body(lut: Lut, cct_k: float) -> Mixture:
    """Return the illuminant of a black body, interpolated in mired between its two neighbours in the LUT.

    The temperature is the setting of the projector. Its three primaries were mixed so that the CIE 1931 standard
    observer sees the colour of the black body (`experiment.lights.blackbody_light`). The camera is not this observer,
    so the ground truth differs from the response of the camera to the real black body.
    """
    # Chromaticities of black bodies are nearly linear in mired (10⁶ / K). For steps of 200 K the error is at most 0.2°.
    # This is less than the quantisation of 8-bit projector codes; a cubic spline is not better.
    bodies = sorted((light.cct_k, light.index) for light in lut.illuminations if light.cct_k is not None)
    if not bodies:
        raise InputError(f"the LUT {lut.folder} has no black bodies; give a chromaticity r=…,b=… instead")
    if not bodies[0][0] <= cct_k <= bodies[-1][0]:
        raise InputError(
            f"{cct_k:g} K is outside the range of the black bodies of the LUT {lut.folder}, {bodies[0][0]:g} to "
            f"{bodies[-1][0]:g} K; choose a value in this range, or give a chromaticity r=…,b=…"
        )
    for (cold, first), (hot, second) in pairwise(bodies):
        if cold < cct_k < hot:
            share = (1e6 / cold - 1e6 / cct_k) / (1e6 / cold - 1e6 / hot)
            first_sum, second_sum = lut.white[first].sum(), lut.white[second].sum()
            return mixture_of({first: (1 - share) / first_sum, second: share / second_sum})
    return mixture_of({next(index for kelvin, index in bodies if kelvin == cct_k): 1.0})
