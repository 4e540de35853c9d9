"""Kinds of masks: half planes and soft edges, spots, random smooth fields, windows.

A shape draws its places from an image's streams, and gives a function from places in the picture to the lights' shares.
Pixels are computed with +, −, ×, ÷ and √ alone; see `making`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled, inlined
from generator import philox

Array = npt.NDArray[np.floating[Any]]
"""float32: what is computed from float32 arrays and Python's own numbers stays float32."""
_ZERO: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_THREE: Final = np.float32(3)
_STEP: Final = 64
"""Numbers of one stream: as many as the largest shape draws, 1 + 3 · 20 of the spots, and some."""
_BAR: Final = 0.06
"""Breadth of the bars between a window's panes, as a share of the window: 6 cm of a metre, as glazing bars are."""

Shares = Callable[[Array], Array]
"""From v (h, 1), rows' distances from the picture's centre, shares of its longer side, to lights' shares (K, h, W)."""


@dataclass(frozen=True)
class RandomStreams:
    """Uniform random numbers of one image; each `stream` of them is independent of the others, and each purpose."""

    seed: int
    number: int
    purpose: int = philox.MASKS

    def uniform(self, stream: int, count: int = _STEP) -> npt.NDArray[np.float64]:
        """Return (count,) float64 between 0 and 1."""
        word = philox.words(self.seed, np.arange(count), stream, self.number, self.purpose)[0]
        return (word + 0.5) / (1 << 32)


class Shape(Protocol):
    """A kind of masks: from the streams of an image to where its lights fall."""

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to the lights' shares (K, h, W) float32 of their pixels.

        `pixel`: size of a pixel, a share of the longer side. `u`: (1, W) float32, the columns' distances from the
        picture's centre, shares of the longer side.
        """
        ...

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers as plain values."""
        ...


@inlined
def stepped(x: Any) -> Any:
    """Return for float32 x 0 below 0, 1 above 1, and 3x² − 2x³ between (the cubic Hermite step)."""
    x = min(max(x, _ZERO), _ONE)
    return x * x * (_THREE - x - x)


@dataclass(frozen=True)
class HalfPlanes:
    """Parallel strips, one for each light: for two lights a half plane each.

    - `angle`: direction in degrees from the first light to the last, clockwise from the right; None: any.
    - `width`: breadth of the soft edge; 0 is as sharp as pixels allow. None: any from 0.1 to 0.6.
    """

    angle: float | None = None
    width: float | None = 0.0

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `Shape.shares`."""
        drawn: list[float] = streams.uniform(0).tolist()
        angle = math.radians(360 * drawn[0] if self.angle is None else self.angle)
        width = max(0.1 + 0.5 * drawn[1] if self.width is None else self.width, pixel)
        reach = abs(math.cos(angle)) * half[0] + abs(math.sin(angle)) * half[1]
        edges = [reach * (2 * (edge + 0.6 * drawn[1 + edge] - 0.3) / lights - 1) for edge in range(1, lights)]

        right, down = np.float32(math.cos(angle)), np.float32(math.sin(angle))
        edge_places, soft = np.array(edges, np.float32), np.float32(width)

        def fill(v: Array) -> Array:
            strips = np.ones((lights, len(v), u.shape[1]), np.float32)
            _fill_strips(u[0], v[:, 0], right, down, edge_places, soft, strips)
            return strips

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"masks": "half-plane" if self.width == 0 else "soft-edge", "angle": self.angle, "width": self.width}


@dataclass(frozen=True)
class Spots:
    """Soft discs of every light but the first.

    - `count`: discs of each light; None: any from 1 to 4.
    - `radius`: where a disc's light has fallen to a half; None: any from 0.08 to 0.3.
    - `softness`: breadth of the edge over the radius, up to 2.
    """

    count: int | None = None
    radius: float | None = None
    softness: float = 0.8

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `Shape.shares`."""
        discs: list[list[tuple[float, float, float, float]]] = []
        for light in range(1, lights):
            drawn = streams.uniform(light)
            count = 1 + int(4 * drawn[0]) if self.count is None else self.count
            discs.append([])
            for x, y, size in drawn[1 : 1 + 3 * count].reshape(-1, 3).tolist():
                radius = 0.08 + 0.22 * size if self.radius is None else self.radius
                place = (half[0] * (2 * x - 1), half[1] * (2 * y - 1))
                edge = max(self.softness * radius, pixel)
                discs[-1].append((*place, radius, edge))

        places = [np.array(light, np.float32).reshape(-1, 4) for light in discs]

        def fill(v: Array) -> Array:
            shares = np.ones((lights, len(v), u.shape[1]), np.float32)
            for light, its in enumerate(places, start=1):
                _fill_discs(u[0], v[:, 0], its, shares[light])
            return _over_the_first(shares)

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"masks": "spots", "count": self.count, "radius": self.radius, "softness": self.softness}


@dataclass(frozen=True)
class SmoothFields:
    """Lights that pass into one another: a random field for each, smoothed by cubic B-splines (I. Schoenberg, 1946).

    - `scale`: distance over which a field changes, a share of the longer side.
    - `contrast`: how much one light prevails where its field is largest.
    """

    scale: float = 0.5
    contrast: float = 2.0

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `Shape.shares`."""
        del half, pixel
        knots = math.ceil(2 / self.scale) + 4
        fields: list[Array] = []
        for light in range(lights):
            drawn = streams.uniform(light, knots * knots).reshape(knots, knots)
            # The spline leaves 0.479 of the knots' variance in each direction, on the average.
            field = (self.contrast / 0.479 * math.sqrt(12) * (drawn - 0.5)).astype(np.float32)
            fields.append(np.ascontiguousarray(self._splined(np.ascontiguousarray(field.T), u[0]).T))

        def fill(v: Array) -> Array:
            return np.stack([_growth(self._splined(field, v[:, 0])) for field in fields])

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"masks": "smooth", "scale": self.scale, "contrast": self.contrast}

    def _splined(self, knots: Array, at: Array) -> Array:
        """Return (n, m) float32 for `knots` (K, m), whose first index runs over places `at` (n,) from −0.5 to 0.5."""
        place = (at + 0.5) * (2 / self.scale)
        first = np.floor(place)
        index = first.astype(np.intp)
        t = place - first
        s = 1 - t
        weights = (
            s * s * s / 6,
            (4 - 6 * t * t + 3 * t * t * t) / 6,
            (4 - 6 * s * s + 3 * s * s * s) / 6,
            t * t * t / 6,
        )
        total = np.zeros((len(at), knots.shape[1]), np.float32)
        _add_splines(knots, index, np.stack(weights), total)
        return total


@dataclass(frozen=True)
class Windows:
    """Daylight through a window on wall or floor: panes in perspective, a window for each light but the first.

    - `columns`, `rows`: panes across and down; None: 2 or 3.
    - `softness`: breadth of the half shadow, a share of the window; None: any from 0.02 to 0.1.
    """

    columns: int | None = None
    rows: int | None = None
    softness: float | None = None

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `Shape.shares`."""
        windows = [self._window(streams.uniform(light), half, pixel) for light in range(1, lights)]

        def fill(v: Array) -> Array:
            shares = np.ones((lights, len(v), u.shape[1]), np.float32)
            for light, (matrix, columns, rows, soft) in enumerate(windows, start=1):
                x, y, w = (row[0] * u + row[1] * v + row[2] for row in matrix)
                # Behind the vanishing line there is no window.
                seen = w > 1e-3
                w = np.where(seen, w, 1)
                shares[light] = _panes(x / w, columns, soft) * _panes(y / w, rows, soft) * seen
            return _over_the_first(shares)

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"masks": "window", "columns": self.columns, "rows": self.rows, "softness": self.softness}

    def _window(
        self, drawn: npt.NDArray[np.float64], half: tuple[float, float], pixel: float
    ) -> tuple[list[list[float]], int, int, float]:
        """Return the homography (3, 3) from the picture to the window's unit square, its panes, and its softness.

        `drawn` (64,) float64 are random numbers between 0 and 1.
        """
        size = 0.45 + 0.35 * drawn[0]
        shape = 0.7 + 0.7 * drawn[1]
        width, height = size * math.sqrt(shape), size / math.sqrt(shape)
        centre = np.array([half[0] * (drawn[2] - 0.5), half[1] * (drawn[3] - 0.5)])
        slant = 0.8 * (drawn[4] - 0.5)
        turn = math.radians(40 * (drawn[5] - 0.5))
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        # One side of the window is farther away, hence shorter.
        far = 1 - 0.4 * drawn[6:8] * np.sign(corners[:, ::-1] * (drawn[8:10] - 0.5)).clip(0)
        corners = corners * far * [width, height]
        corners[:, 0] += slant * corners[:, 1]
        rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        matrix = _homography(corners @ rotation + centre)
        columns = self.columns or 2 + int(2 * drawn[10])
        rows = self.rows or 2 + int(2 * drawn[11])
        soft = 0.02 + 0.08 * float(drawn[12]) if self.softness is None else self.softness
        return matrix.tolist(), columns, rows, max(soft, pixel / float(min(width, height)))


@compiled
def _fill_strips(u: Any, v: Any, right: Any, down: Any, edges: Any, width: Any, shares: Any) -> None:
    """Fill the lights' shares (K, n, m), all 1, with strips between K − 1 soft edges."""
    for y in range(len(v)):
        for edge in range(len(edges)):
            for x in range(len(u)):
                past = stepped((u[x] * right + v[y] * down - edges[edge]) / width + _HALF)
                shares[edge, y, x] -= past
                shares[edge + 1, y, x] = past


@compiled
def _fill_discs(u: Any, v: Any, discs: Any, light: Any) -> None:
    """Fill a light's shares (n, m), all 1, with discs."""
    for y in range(len(v)):
        for disc in range(len(discs)):
            x0, y0, radius, edge = discs[disc, 0], discs[disc, 1], discs[disc, 2], discs[disc, 3]
            for x in range(len(u)):
                distance = np.sqrt((u[x] - x0) * (u[x] - x0) + (v[y] - y0) * (v[y] - y0))
                light[y, x] *= stepped((distance - radius) / edge + _HALF)
        for x in range(len(u)):
            light[y, x] = _ONE - light[y, x]


@compiled
def _add_splines(knots: Any, index: Any, weights: Any, total: Any) -> None:
    """Add to each row of `total` (n, m) four rows of `knots`, from that of `index` (n,) on, times `weights` (4, n)."""
    for y in range(total.shape[0]):
        for step in range(4):
            weight, row = weights[step, y], index[y] + step
            for x in range(total.shape[1]):
                total[y, x] += weight * knots[row, x]


@compiled
def _grow(levels: Any) -> None:
    """Replace float32 x in `levels` (n, m) by (x + √(1 + x²))²."""
    for y in range(levels.shape[0]):
        for x in range(levels.shape[1]):
            level = levels[y, x]
            root = np.sqrt(_ONE + level * level)
            grown = root + level if level >= _ZERO else _ONE / (root - level)
            levels[y, x] = grown * grown


def _growth(levels: Array) -> Array:
    """Return (x + √(1 + x²))² for each float32 x, in place: it grows from 0 to ∞ as an exponential, of √ alone."""
    _grow(levels)
    return levels


def _homography(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the homography (3, 3) float64 from four places (4, 2), clockwise, to the corners of the unit square."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows: list[list[float]] = []
    for (u, v), (x, y) in zip(corners.tolist(), square.tolist(), strict=True):
        rows += [[u, v, 1.0, 0.0, 0.0, 0.0, -u * x, -v * x], [0.0, 0.0, 0.0, u, v, 1.0, -u * y, -v * y]]
    return np.append(np.linalg.solve(np.array(rows), square.reshape(-1)), 1.0).reshape(3, 3)


@compiled
def _add_panes(at: Any, sides: Any, soft: Any, light: Any) -> None:
    """Add to `light` (n, m) float32 the panes between `sides` (P, 2) at places `at` (n, m), and clip it to 0 … 1."""
    for y in range(at.shape[0]):
        for pane in range(sides.shape[0]):
            left, right = sides[pane, 0], sides[pane, 1]
            for x in range(at.shape[1]):
                light[y, x] += stepped((at[y, x] - left) / soft + _HALF) - stepped((at[y, x] - right) / soft + _HALF)
        for x in range(at.shape[1]):
            light[y, x] = min(max(light[y, x], _ZERO), _ONE)


def _panes(at: Array, count: int, soft: float) -> Array:
    """Return the light (n, m) float32 through `count` panes at places `at` (n, m) float32, 0 … 1 across the window."""
    sides = [
        (
            pane / count + (_BAR / 2 if pane else 0.0),
            (pane + 1) / count - (_BAR / 2 if pane < count - 1 else 0.0),
        )
        for pane in range(count)
    ]
    light = np.zeros_like(at)
    _add_panes(at, np.array(sides, np.float32), np.float32(soft), light)
    return light


def _over_the_first(shares: Array) -> Array:
    """Return the lights' shares (K, h, W) float32, in place: the first light's, all 1, times what the others leave."""
    for light in shares[1:]:
        shares[0] *= 1 - light
    return shares
