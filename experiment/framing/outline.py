"""Outlines in a picture: large quadrilaterals that may be the field of a chart, each drawn onto the edge of its cells.

Knows paper and what is darker, not which colours a chart has (`experiment.framing.tagless_field`). Places are
half-size pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from experiment.framing.planes import MIN_SIGNAL, Plane, paper_level
from foundation.robust import biweight, sigma_of

CORNER_REACH_PX = 24.0
"""How far from a guess the field's outline is looked for."""

_SMALL_WIDTH_PX = 640
"""Width of the small raster on which outlines are looked for: cells of a few pixels close into one dark field there."""

SAME_PX = 3.0
"""Half-size pixels by which corners of the same outline may differ when it is reached from different guesses."""

_LEAST_AREA = 0.1
"""Share of the picture that a field takes at least; what is smaller cannot be sampled."""

_LEAST_LIGHT, _MUCH_LIGHT = 0.03, 0.2
"""Light of a colour over that of the strongest: to be looked at for colours, and for edges."""

_THRESHOLDS = (0.35, 0.45, 0.55, 0.65, 0.75, 0.85)
"""Of paper: levels at which outlines are looked for, since nobody knows how dark the cells at the edge are."""

SIDE_POINTS = 160
"""Places along a side at which the edge is looked for: many times the six coefficients of its curve."""

_PROFILE_STEP_PX = 0.5
"""Step of the profiles across an edge: half a half-size pixel, a photosite."""

_EDGE_SIGMA_PX = 1.0
"""σ by which profiles are smoothed before their steepest rise is looked for: the blur of a picture just usable."""

_ROUNDS = ((CORNER_REACH_PX, 2, 1e3), (CORNER_REACH_PX / 2, 5, 12.0), (6.0, 5, 6.0))
"""How far from the guess the edge is looked for, the order of the curve drawn through it, and how well it is known."""

_MIN_EDGE = 0.05
"""Of paper white: what the step from cells to paper must have to be taken for the outline."""

_REFINE_ALONG_PX = np.arange(-2.0, 2.1)
_REFINE_ACROSS_PX = np.arange(-3.5, 2.1, 0.5)
"""Around a place of the edge: one cell inwards, and outwards not as far as marks in the margin begin."""

_REFINE_STEPS = 6
"""Rounds of the fit of a blurred step; each moves it by half a pixel at most, and three pixels are looked at."""

_INTERPOLATION_PX = 0.4
"""σ that linear interpolation adds to an edge."""

_REFINED_PX = 1.5
"""How far from where it was taken to be an edge may be: beyond, the profile ends before the blur does."""

_CLEAR_EDGE = 0.15
"""Of paper: a lower step from cells to margin does not give its place to a tenth of a pixel."""

_Float = npt.NDArray[np.float32]
_Points = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PreparedPicture:
    """A picture prepared for the search.

    - `planes`: the colours that carry light, slightly smoothed.
    - `channels`: which these are: 0, 1, 2.
    - `levels`: for each, how bright paper would be, on the small raster.
    - `bright`: for each, whether it carries enough light for its noise not to be taken for something darker than paper.
    - `shape`: height and width, half-size px.
    - `factor`: half-size pixels per element of the small raster.
    - `paleness`: (h, w) float32 on the small raster: the least of the colours over paper's, 1 for paper.
    """

    planes: tuple[Plane, ...]
    channels: tuple[int, ...]
    levels: tuple[_Float, ...]
    bright: tuple[bool, ...]
    shape: tuple[int, int]
    factor: int
    paleness: _Float

    @classmethod
    def of(cls, planes: Sequence[Plane]) -> PreparedPicture:
        """Return the planes of red, green and blue prepared for the search."""
        height, width = planes[0].values.shape
        factor = max(1, round(width / _SMALL_WIDTH_PX))
        size = (width // factor, height // factor)
        brightest = [paper_level(plane) for plane in planes]
        used = [k for k, level in enumerate(brightest) if level >= max(MIN_SIGNAL, _LEAST_LIGHT * max(brightest))]
        levels: list[_Float] = []
        paleness = np.full(size[::-1], np.inf, dtype=np.float32)
        for k in used:
            whole = planes[k].values[: size[1] * factor, : size[0] * factor]
            small = cv2.blur(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), (3, 3))
            # Somewhere near every place lies paper or a cell that is as bright in this colour.
            reach = size[0] // 5 | 1
            level = cv2.blur(cv2.dilate(small, np.ones((reach, reach), dtype=np.uint8)), (reach, reach))
            level = np.maximum(level, np.float32(0.2 * brightest[k])).astype(np.float32)
            levels.append(level)
            if brightest[k] >= _MUCH_LIGHT * max(brightest):
                paleness = np.minimum(paleness, small / level)
        smooth = tuple(replace(planes[k], values=cv2.blur(planes[k].values, (3, 3)).astype(np.float32)) for k in used)
        bright = tuple(brightest[k] >= _MUCH_LIGHT * max(brightest) for k in used)
        shape = height, width
        return cls(smooth, tuple(used), tuple(levels), bright, shape, factor, paleness.astype(np.float32))

    def small(self, places_px: _Points) -> _Points:
        """Return places (..., 2) float64 half-size px as places on the small raster."""
        return (places_px - (self.factor - 1) / 2) / self.factor

    def pale_at(self, places_px: _Points) -> _Float:
        """Return the paleness (...) float32, 1 for paper, at places (..., 2) float64 half-size px."""
        x, y = (np.ascontiguousarray(places_px[..., axis], dtype=np.float32) for axis in (0, 1))
        near = self.small(places_px).astype(np.float32)
        found = np.full(x.shape, np.inf, dtype=np.float32)
        for plane, level, bright in zip(self.planes, self.levels, self.bright, strict=True):
            if not bright:
                continue
            dx, dy = (np.float32(offset) for offset in plane.offset_px)
            seen = cv2.remap(plane.values, x - dx, y - dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            paper = cv2.remap(level, near[..., 0], near[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            found = np.minimum(found, seen / paper)
        return found

    def quads(self) -> list[_Points]:
        """Return large quadrilaterals, (4, 2) float64 half-size px, clockwise, that outlines in the picture resemble.

        Outlines at several thresholds (S. Suzuki and K. Abe, "Topological structural analysis of digitized binary
        images by border following", 1985, as OpenCV's `findContours` has it); their convex hulls are reduced to four
        corners.
        """
        found: list[_Points] = []
        area = float(self.paleness.size)
        for threshold in _THRESHOLDS:
            pale = (self.paleness > threshold).astype(np.uint8)
            outlines = list(cv2.findContours(pale, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0])
            dark = cv2.findContours(1 - pale, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
            inner = [outline for outline in dark if not self._touches_border(outline)]
            if inner:
                # A bright cell at the field's edge may open its outline; what is dark inside still spans it.
                outlines.append(np.concatenate(inner))
            for outline in outlines:
                hull = cv2.convexHull(outline)
                if len(hull) < 4 or not _LEAST_AREA * area < cv2.contourArea(hull) < 0.99 * area:
                    continue
                quad = np.asarray(cv2.approxPolyN(hull, 4), dtype=np.float64).reshape(-1, 2)
                if len(quad) != 4 or cv2.contourArea(hull) < 0.85 * cv2.contourArea(quad.astype(np.float32)):
                    continue
                quad = quad * self.factor + (self.factor - 1) / 2
                if cv2.contourArea(quad.astype(np.float32), oriented=True) < 0:
                    quad = quad[::-1]
                if not any(same_corners(quad, other, 2.0 * self.factor) for other in found):
                    found.append(quad)
        return found

    def _touches_border(self, outline: npt.NDArray[np.generic]) -> bool:
        x, y, width, height = cv2.boundingRect(np.asarray(outline, dtype=np.int32))
        return x <= 0 or y <= 0 or x + width >= self.paleness.shape[1] or y + height >= self.paleness.shape[0]


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed line through a picture: corners (4, 2) px clockwise as seen, and points on each of its four sides.

    `sides_px[k]` (N, 2) run from corner k to the next, `normals[k]` (N, 2) point outwards.
    """

    corners_px: _Points
    sides_px: tuple[_Points, ...]
    normals: tuple[_Points, ...]


def same_corners(one: _Points, other: _Points, tolerance: float) -> bool:
    """Return whether two quadrilaterals (4, 2) agree to a tolerance in their unit, whichever corner they begin with."""
    return any(np.abs(one - np.roll(other, turn, axis=0)).max() < tolerance for turn in range(4))


def _outwards(start: _Points, end: _Points) -> _Points:
    """Return the unit vector (2,) out of a clockwise outline whose side leads from start to end."""
    x, y = (end - start) / np.linalg.norm(end - start)
    return np.array([y, -x])


def trace_outline(picture: PreparedPicture, corners_px: _Points) -> Outline | None:
    """Return the edge between cells and paper near a quadrilateral; None where there is none along one of its sides.

    In rounds of shrinking reach (`_ROUNDS`) the steepest rise to paper is looked for across each side, and a curve, a
    Legendre series over the side, is fitted through most of the places found (iterated reweighted least squares with
    Tukey's biweight).

    `corners_px`: (4, 2) float64 half-size px, clockwise as seen, to `CORNER_REACH_PX`.
    """
    corners = np.asarray(corners_px, dtype=np.float64)
    curves = [np.zeros(1)] * 4
    along = (np.arange(SIDE_POINTS) + 0.5) / SIDE_POINTS
    seen_px: list[_Points] = []
    normals: list[_Points] = []
    for reach, order, known in _ROUNDS:
        across = np.arange(-reach, reach + 0.01, _PROFILE_STEP_PX)
        seen_px, normals = [], []
        smooth: list[_Points] = []
        for side in range(4):
            start, end = corners[side], corners[(side + 1) % 4]
            if np.linalg.norm(end - start) < 4 * reach:
                return None
            normal = _outwards(start, end)
            middle = _bent(along, curves[side], start, end)
            off, strength = _edges(picture.pale_at(middle[:, None] + across[None, :, None] * normal), across, known)
            seen = strength > _MIN_EDGE
            if seen.mean() < 0.4:
                return None
            change, fits = robust_curve(along[seen], off[seen], order)
            if fits.mean() < 0.5:
                return None
            smooth.append(_bent(np.linspace(0, 1, 41), _sum(curves[side], change), start, end))
            seen_px.append((middle[seen] + off[seen, None] * normal)[fits])
            normals.append(np.tile(normal, (len(seen_px[-1]), 1)))
        corners = _corners_of(smooth)
        curves = [_curve_between(corners[side], corners[(side + 1) % 4], smooth[side], order) for side in range(4)]
    return Outline(corners, tuple(seen_px), tuple(normals))


def refine_edges(
    planes: Sequence[Plane], places_px: _Points, normals: _Points, blur_px: float
) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Return where each colour sees the edge, (K, N, 2) float64 half-size px, and how high its step is there, (K, N).

    A blurred step is fitted to each colour by itself, for a lens shows an edge elsewhere in red and in blue. Heights
    are in parts of paper; 0 where the edge is not clear, and the place is that given. Farther than a mark in the margin
    begins nothing is looked at: a ruler's ticks would draw the edge by a tenth of a pixel.

    `places_px`, `normals`: (N, 2) float64 half-size px, places known to a pixel, and unit vectors outwards. `blur_px`:
    σ of the picture's edges, half-size px.
    """
    tangents = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    grid = places_px[:, None, None] + _REFINE_ALONG_PX[None, :, None, None] * tangents[:, None, None]
    grid = grid + _REFINE_ACROSS_PX[None, None, :, None] * normals[:, None, None]
    places = np.repeat(places_px[None], len(planes), axis=0)
    heights = np.zeros(places.shape[:2])
    for number, plane in enumerate(planes):
        level = paper_level(plane)
        if level < MIN_SIGNAL:
            continue
        x, y = (np.ascontiguousarray((grid - plane.offset_px)[..., axis].reshape(len(grid), -1)) for axis in (0, 1))
        seen = cv2.remap(plane.values, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        profile = np.asarray(seen, dtype=np.float64).reshape(grid.shape[:-1]).mean(axis=1) / level
        off, rise = _fitted_step(profile, float(np.hypot(blur_px, _INTERPOLATION_PX)))
        clear = (rise > _CLEAR_EDGE) & (np.abs(off) < _REFINED_PX)
        places[number] += np.where(clear, off, 0.0)[:, None] * normals
        heights[number] = np.where(clear, rise, 0.0)
    return places, heights


def _fitted_step(profile: _Points, sigma: float) -> tuple[_Points, _Points]:
    """Return where steps blurred by `sigma` px lie in profiles (N, M) across edges, (N,) px, and their heights (N,)."""
    off: _Points = np.zeros(len(profile))
    rise: _Points = np.zeros(len(profile))
    for _ in range(_REFINE_STEPS):
        aside = (_REFINE_ACROSS_PX[None] - off[:, None]) / sigma
        step, slope = ndtr(aside), np.exp(-0.5 * aside**2) / np.sqrt(2 * np.pi) / sigma
        # Cells and margin need not be even: the cells' side has a slope of its own.
        design = np.stack([np.ones_like(step), step, slope, np.minimum(_REFINE_ACROSS_PX[None], 0) + 0 * step], axis=-1)
        gram = np.einsum("kni,knj->kij", design, design) + 1e-9 * np.eye(4)
        found = np.asarray(np.linalg.solve(gram, np.einsum("kni,kn->ki", design, profile)[..., None]), dtype=np.float64)
        solution = found[..., 0]
        rise = solution[:, 1]
        off = off - np.clip(solution[:, 2] / np.where(np.abs(rise) > 0.01, rise, 0.01), -0.5, 0.5)
    return off, rise


def _bent(share: _Points, curve: _Points, start: _Points, end: _Points) -> _Points:
    """Return the points (N, 2) at shares (N,) of a chord, moved outwards by a Legendre series."""
    outwards = np.polynomial.legendre.legvander(2 * share - 1, len(curve) - 1) @ curve
    return start + share[:, None] * (end - start) + outwards[:, None] * _outwards(start, end)


def _sum(one: _Points, other: _Points) -> _Points:
    """Return the sum of two series of different lengths."""
    total = np.zeros(max(len(one), len(other)))
    total[: len(one)] += one
    total[: len(other)] += other
    return total


def _edges(paleness: _Float, across: _Points, known_px: float) -> tuple[_Points, _Points]:
    """Return where each profile (N, M) rises most to what is as pale as paper, and by how much it rises there.

    `known_px` is how well the place of the edge is known before.
    """
    # Neighbours along the side see the same edge; a mean over them hides ticks and noise.
    profile = cv2.blur(cv2.GaussianBlur(paleness, (0, 0), _EDGE_SIGMA_PX / _PROFILE_STEP_PX, sigmaY=0.1), (1, 3))
    step = round(_EDGE_SIGMA_PX / _PROFILE_STEP_PX)
    rise = np.zeros_like(profile)
    rise[:, step:-step] = profile[:, 2 * step :] - profile[:, : -2 * step]
    beyond = np.roll(profile, -2 * step, axis=1)
    # Of several, as where marks stand in the margin, the one nearer to what is expected.
    likely = np.exp(-2 * (across / known_px) ** 2).astype(np.float32)
    coarse = (rise * likely * np.clip(beyond, 0, 1) ** 4).argmax(axis=1)
    row = np.arange(len(coarse))
    near = np.clip(coarse[:, None] + np.arange(-2 * step, 2 * step + 1), 1, len(across) - 2)
    best = near[row, rise[row[:, None], near].argmax(axis=1)]
    left, middle, right = (rise[row, best + aside] for aside in (-1, 0, 1))
    part = np.clip(0.5 * (left - right) / np.minimum(left - 2 * middle + right, -1e-9), -1, 1)
    return across[best] + part * _PROFILE_STEP_PX, middle.astype(np.float64)


def robust_curve(along: _Points, off: _Points, order: int) -> tuple[_Points, npt.NDArray[np.bool_]]:
    """Return the curve through most of the points on a side, and which points it fits.

    `along`: (N,) float64, shares 0 … 1 of the side. `off`: (N,) float64 half-size px across it. Returns (order + 1,)
    float64, the series' coefficients on −1 … 1; (N,) bool.
    """
    basis = np.polynomial.legendre.legvander(2 * along - 1, order)
    scale = max(sigma_of(off - np.median(off)), 0.5)
    weights = 1 / np.maximum(np.abs(off - np.median(off)), scale)
    solution = np.zeros(order + 1)
    for _ in range(8):
        root = np.sqrt(weights)
        solution = np.linalg.lstsq(basis * root[:, None], off * root, rcond=None)[0]
        residual = np.abs(off - basis @ solution)
        scale = max(sigma_of(residual), 0.15)
        weights = biweight(residual, scale) + 1e-6
    return solution.astype(np.float64), np.asarray(np.abs(off - basis @ solution) < 3 * scale)


def _corners_of(sides: Sequence[_Points]) -> _Points:
    """Return where four curves (N, 2), each beginning about where the one before ends, meet."""
    corners = np.zeros((4, 2))
    for k in range(4):
        before, after = sides[k - 1], sides[k]
        one, other = _outwards(before[-2], before[-1]), _outwards(after[0], after[1])
        normals = np.stack([one, other])
        corners[k] = np.linalg.solve(normals, np.array([one @ before[-1], other @ after[0]]))
    return corners


def _curve_between(start: _Points, end: _Points, points: _Points, order: int) -> _Points:
    """Return the Legendre coefficients of a curve's offset from a chord, over its share of the chord."""
    normal = _outwards(start, end)
    share = (points - start) @ (end - start) / float((end - start) @ (end - start))
    basis = np.polynomial.legendre.legvander(2 * share - 1, order)
    return np.linalg.lstsq(basis, (points - start) @ normal, rcond=None)[0].astype(np.float64)
