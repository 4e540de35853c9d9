"""From a drawing on the print to the light on every photosite.

**Loops.** Compiled by numba on first use, single-threaded and without the interpreter's lock; `sim.world.world` calls
them for blocks of rows from as many threads as there are processors. A row's result depends on its own arguments
only, so neither blocks nor threads change a bit of it. Positions are photosites of the visible frame, centres at
integers, unless said.

**Geometry.** The print is a sheet held at its middle: a point (x, y) mm on it stands `height` mm out of the plane,
towards the camera. The sheet is turned by roll, then tilt, then pan, and seen through a pinhole and Brown's lens
distortion (D. C. Brown, "Close-range camera calibration", 1971; normalised coordinates and coefficient order as
OpenCV has them). The paper does not stretch: its heights are so small against their wavelengths that a point keeps
its x and y. A fold is a crease that does not lie flat: the sheet rises towards it on both sides, so that the crease
stands off the plane, and either flank is turned a little towards the light or away from it.

Pixels are half-size, centres at integers, x right, y down; millimetres on the print, origin at its top-left corner.
Pure functions of frozen values; light is not treated here.

**The print** is rectangles of plain colour on paper, and a map of them that is rendered. Millimetres on the print,
origin at its top-left corner, x right, y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from foundation.compiled import compiled

_RIPPLE: Final = 0.1  # Height of each of the weaker short waves over that of the first; chosen

_NEWTON_STEPS = 6  # An end to steps that do not converge; they stop earlier once every point is met within 10⁻⁷ px
# Half the distance of the differences that stand for derivatives: short beside folds and waves, long beside rounding.
_STEP_MM = 0.05


@dataclass(frozen=True, eq=False)
class Waviness:
    """A smooth paper surface: the sum of a few standing waves.

    - `cycles`: (M, 2) float64, cycles along x and y over the whole page.
    - `phases`: (M,) float64, radians.
    - `amplitudes_mm`: (M,) float64.
    - `page_mm`: width and height of the page.
    """

    cycles: NDArray[np.float64]
    phases: NDArray[np.float64]
    amplitudes_mm: NDArray[np.float64]
    page_mm: tuple[float, float]

    @classmethod
    def random(
        cls, seed: int, peak_to_valley_mm: float, page_mm: tuple[float, float], modes: int = 7, wave_mm: float = 0.0
    ) -> Waviness:
        """Draw a surface whose highest and lowest points lie `peak_to_valley_mm` apart.

        `wave_mm`: the waves' length, within 15 %; 0 for those long ones. One wave in any direction, and weak ones
        across it.
        """
        random = np.random.default_rng([seed, 0x77617679])
        longer = max(page_mm)
        cycles = random.uniform(-3, 3, (modes, 2)) * np.array(page_mm) / longer
        amplitudes = random.uniform(0.5, 1, modes) / (0.5 + np.hypot(cycles[:, 0], cycles[:, 1]))
        if wave_mm:
            length, direction = wave_mm * random.uniform(0.85, 1.15, modes), random.uniform(0, np.pi, modes)
            cycles = np.column_stack([np.cos(direction), np.sin(direction)]) * np.array(page_mm) / length[:, None]
            # Damp paper cockles: ridges beside each other, not quite regular.
            amplitudes = np.where(np.arange(modes) == 0, 1.0, _RIPPLE)
        shape = cls(cycles, random.uniform(0, 2 * np.pi, modes), amplitudes, page_mm)
        x, y = np.meshgrid(np.linspace(0, page_mm[0], 201), np.linspace(0, page_mm[1], 201))
        extent = float(np.ptp(shape.height(np.stack([x, y], axis=-1))))
        return cls(shape.cycles, shape.phases, amplitudes * (peak_to_valley_mm / extent), page_mm)

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm, towards the camera, of points (..., 2) mm on the print, or off the page."""
        share = points_mm / np.array(self.page_mm)
        total = np.zeros(points_mm.shape[:-1])
        for (along_x, along_y), phase, amplitude in zip(self.cycles, self.phases, self.amplitudes_mm, strict=True):
            total += amplitude * np.sin(2 * np.pi * (along_x * share[..., 0] + along_y * share[..., 1]) + phase)
        return total


ROUND_MM = 4.0  # Paper bends; a crease is no sharper than this

FLANK_MM = 40.0  # From the crease to where the sheet lies flat again, to 1 / e


@dataclass(frozen=True)
class Fold:
    """A crease across the sheet, from its upper to its lower edge.

    - `at_mm`: A point of the crease.
    - `along`: its direction, a unit vector.
    - `height_mm`: how far the crease stands off the plane, towards the camera.
    - `slant`: change of the light with a flank's slope: the tangent of the angle under which the light falls in.
    """

    at_mm: tuple[float, float]
    along: tuple[float, float]
    height_mm: float
    slant: float

    def _away(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (...) of points from the crease, positive on its right."""
        x, y = np.moveaxis(points_mm - np.array(self.at_mm), -1, 0)
        return x * self.along[1] - y * self.along[0]

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm of points (..., 2)."""
        rounded = np.hypot(self._away(points_mm), ROUND_MM) - ROUND_MM
        return self.height_mm * np.exp(-rounded / FLANK_MM)

    def shade(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light (...) on points (..., 2) over that on a flat sheet."""
        away = self._away(points_mm)
        slope = -self.height(points_mm) * away / np.hypot(away, ROUND_MM) / FLANK_MM
        return 1 + self.slant * slope


@dataclass(frozen=True, eq=False)
class Sheet:
    """The shape of a sheet of paper: waves, a curl and a crease, added.

    - `waves`: its smooth waves.
    - `curl_mm`: height of its left and right edges above its middle, towards the camera: a cylinder, to second order a
      parabola.
    - `fold`: its crease.
    """

    waves: Waviness
    curl_mm: float = 0.0
    fold: Fold | None = None

    @property
    def page_mm(self) -> tuple[float, float]:
        """Width and height of the page."""
        return self.waves.page_mm

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm, towards the camera, of points (..., 2) mm on the print, or off the page."""
        height = self.waves.height(points_mm)
        if self.curl_mm:
            across = 2 * points_mm[..., 0] / self.page_mm[0] - 1
            height = height + self.curl_mm * across**2
        return height if self.fold is None else height + self.fold.height(points_mm)


@dataclass(frozen=True, eq=False)
class View:
    """A camera in front of a print.

    - `surface`: the print's surface and size.
    - `rotation`: (3, 3) float64, from the print's axes (x right, y down, z away from the camera) to the camera's.
    - `distance_mm`: from the pinhole to the print's centre.
    - `focal_px`: focal length.
    - `centre_px`: where the optical axis meets the picture.
    - `distortion`: k1, k2, p1, p2.
    """

    surface: Sheet
    rotation: NDArray[np.float64]
    distance_mm: float
    focal_px: float
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float]

    @classmethod
    def framed(
        cls,
        surface: Sheet,
        frame_px: tuple[float, float],
        *,
        fill: float,
        focal_diagonals: float,
        turn_deg: tuple[float, float, float],
        distortion: tuple[float, float, float, float],
    ) -> View:
        """Stand so far off that the print, were it not turned, fills a share of the frame.

        `turn_deg`: tilt (about the horizontal axis), pan (about the vertical), roll (about the optical axis), degrees.
        """
        width, height = frame_px
        focal = focal_diagonals * float(np.hypot(width, height))
        distance = focal * max(surface.page_mm[0] / width, surface.page_mm[1] / height) / fill
        centre = ((width - 1) / 2, (height - 1) / 2)
        return cls(surface, _rotation(*turn_deg), distance, focal, centre, distortion)

    def project(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the half-size pixels where points of the print are seen.

        `points_mm`: (..., 2) float64, millimetres; may lie off the page, where the surface goes on. Returns (..., 2)
        float64, x then y.
        """
        page = np.array(self.surface.page_mm)
        flat = points_mm - page / 2
        turned = flat @ self.rotation[:, :2].T - self.surface.height(points_mm)[..., None] * self.rotation[:, 2]
        depth = turned[..., 2] + self.distance_mm
        x, y = turned[..., 0] / depth, turned[..., 1] / depth
        k1, k2, p1, p2 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        seen = np.stack([bent_x, bent_y], axis=-1)
        return seen * self.focal_px + np.array(self.centre_px)

    def locate(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points of the print that are seen at half-size pixels: the inverse of `project`.

        Newton's method with central differences; the error is below a millionth of a pixel wherever the surface is
        seen without a fold, which is everywhere for sheets that lie within a few millimetres.

        `pixels`: (..., 2) float64. Returns (..., 2) float64, millimetres; off the page where the picture shows what
        lies beyond it.
        """
        page = np.array(self.surface.page_mm)
        points = (pixels - np.array(self.centre_px)) * (self.distance_mm / self.focal_px) + page / 2
        along_x, along_y = np.array([_STEP_MM, 0]), np.array([0, _STEP_MM])
        for _ in range(_NEWTON_STEPS):
            miss = pixels - self.project(points)
            if float(np.abs(miss).max(initial=0)) < 1e-7:
                break
            by_x = (self.project(points + along_x) - self.project(points - along_x)) / (2 * _STEP_MM)
            by_y = (self.project(points + along_y) - self.project(points - along_y)) / (2 * _STEP_MM)
            determinant = by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]
            step_x = (miss[..., 0] * by_y[..., 1] - miss[..., 1] * by_y[..., 0]) / determinant
            step_y = (by_x[..., 0] * miss[..., 1] - by_x[..., 1] * miss[..., 0]) / determinant
            points = points + np.stack([step_x, step_y], axis=-1)
        return points


def _rotation(tilt_deg: float, pan_deg: float, roll_deg: float) -> NDArray[np.float64]:
    """Return the (3, 3) rotation by roll, then tilt, then pan."""
    (ct, st), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in np.radians([tilt_deg, pan_deg, roll_deg]))
    tilt = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    pan = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return pan @ tilt @ roll


PAPER: Final = (255, 255, 255)  # The code that prints nothing

_FINEST_MM: Final = 1e-3  # Coordinates nearer than a micrometre are one: rounding parts them, and no lens does

_MOST_LINES: Final = 6000  # Distinct coordinates along an axis of the map, so that its labels stay below 150 MB


@dataclass(frozen=True, eq=False)
class Print:
    """A drawing on paper: rectangles of plain colour, each over those before it.

    - `page_mm`: width and height of the sheet; bare paper where no rectangle lies.
    - `rectangles_mm`: (N, 4) float64: left, top, right, bottom.
    - `rgb`: (N, 3) uint8, the code printed; (255, 255, 255) prints nothing.
    """

    page_mm: tuple[float, float]
    rectangles_mm: NDArray[np.float64]
    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        count = len(self.rectangles_mm)
        if self.rectangles_mm.shape != (count, 4) or self.rgb.shape != (count, 3):
            raise ValueError(
                f"rectangles {self.rectangles_mm.shape} and codes {self.rgb.shape}; (N, 4), (N, 3) expected"
            )
        if np.any(self.rectangles_mm[:, 2:] < self.rectangles_mm[:, :2]):
            raise ValueError("a rectangle's right or bottom lies before its left or top")


@dataclass(frozen=True, eq=False)
class LabelMap:
    """A print as a map of labels between lines.

    - `x_lines`, `y_lines`: (M,) float64, ascending, mm: every x and every y at which the print changes.
    - `labels`: (len(y_lines) + 1, len(x_lines) + 1) int32: row of `codes` between the lines; `len(codes)` beyond the
      page.
    - `codes`: (N, 3) int64, distinct codes of the print, ascending; bare paper is one of them.
    """

    x_lines: NDArray[np.float64]
    y_lines: NDArray[np.float64]
    labels: NDArray[np.int32]
    codes: NDArray[np.int64]


def label_map(sheet: Print) -> LabelMap:
    """Return the map of a print; what of a rectangle lies off the page is left out."""
    codes, label = np.unique(np.concatenate([sheet.rgb.astype(np.int64), [PAPER]]), axis=0, return_inverse=True)
    boxes = np.concatenate([sheet.rectangles_mm, [[0, 0, *sheet.page_mm]]])
    boxes = np.clip(boxes, 0, [*sheet.page_mm, *sheet.page_mm])
    (x_lines, left, right), (y_lines, top, bottom) = _lines(boxes[:, 0::2]), _lines(boxes[:, 1::2])
    labels = np.full((len(y_lines) + 1, len(x_lines) + 1), len(codes), dtype=np.int32)
    label = label.reshape(-1).astype(np.int32)
    # The page, which comes last, lies under everything.
    for k in (len(label) - 1, *range(len(label) - 1)):
        labels[top[k] + 1 : bottom[k] + 1, left[k] + 1 : right[k] + 1] = label[k]
    return LabelMap(x_lines, y_lines, labels, codes)


def _lines(ends: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Return the sorted distinct coordinates of (N, 2) ends, and the index of each beginning and each end among them.

    Coordinates within a micrometre are one; where a drawing has more than a few thousand, nearer ones are joined, each
    then standing at the mean of those it stands for.
    """
    finest = _FINEST_MM
    while True:
        rounded, index = np.unique(np.round(ends / finest), return_inverse=True)
        if len(rounded) <= _MOST_LINES:
            break
        finest *= 1.5
    index = index.reshape(ends.shape)
    count = np.bincount(index.ravel())
    return np.bincount(index.ravel(), weights=ends.ravel()) / count, index[:, 0], index[:, 1]


GRID_PX = 16  # Photosites between the nodes of the position grid

REACH = 4.0  # Standard deviations after which the blur's tail (3·10⁻⁵) is dropped

_PHI_STEPS = 1024  # Entries per standard deviation: the error of linear interpolation stays below 2·10⁻⁷
_PHI: NDArray[np.float32] = np.array(
    [0.5 * (1 + math.erf((i / _PHI_STEPS) / math.sqrt(2))) for i in range(int(REACH * _PHI_STEPS) + 2)],
    dtype=np.float32,
)


@compiled
def _phi(z: float) -> float:
    """Return the normal distribution's share below z; error < 2·10⁻⁷ within `REACH`, 0 or 1 beyond it."""
    size = abs(z)
    if size >= REACH:
        return 1.0 if z > 0 else 0.0
    scaled = size * _PHI_STEPS
    i = int(scaled)
    share = _PHI[i] + (_PHI[i + 1] - _PHI[i]) * (scaled - i)
    return share if z > 0 else 1.0 - share


@compiled
def _cubic(t: float, weights: NDArray[np.float64]) -> None:
    """Write Lagrange's weights for nodes −1, 0, 1, 2 at 0 ≤ t ≤ 1."""
    weights[0] = -t * (t - 1) * (t - 2) / 6
    weights[1] = (t + 1) * (t - 1) * (t - 2) / 2
    weights[2] = -(t + 1) * t * (t - 2) / 2
    weights[3] = (t + 1) * t * (t - 1) / 6


@compiled
def _reached(lines: NDArray[np.float64], centre: float, reach: float, near: int) -> tuple[int, int]:
    """Return the first and the last interval between lines that `centre` ± `reach` touches, searching from `near`."""
    first = near
    while first > 0 and lines[first - 1] > centre - reach:
        first -= 1
    while first < len(lines) and lines[first] <= centre - reach:
        first += 1
    last = first
    while last < len(lines) and lines[last] < centre + reach:
        last += 1
    return first, last


@compiled
def _alike(labels: NDArray[np.int32], i: int, i1: int, j: int, j1: int) -> bool:
    """Return whether all labels of rows j … j1 and columns i … i1 are the same."""
    for b in range(j, j1 + 1):
        for a in range(i, i1 + 1):
            if labels[b, a] != labels[j, i]:
                return False
    return True


@compiled
def _shares(
    lines: NDArray[np.float64], centre: float, sigma: float, first: int, last: int, out: NDArray[np.float64]
) -> None:
    """Write the share of a normal distribution that falls into each interval from first to last; they add up to 1."""
    before = 0.0
    for k in range(first, last):
        below = _phi((lines[k] - centre) / sigma)
        out[k] = below - before
        before = below
    out[last] = 1.0 - before


@compiled
def light(
    first_row: int,
    nodes: NDArray[np.float64],
    sigma_px: float,
    x_lines: NDArray[np.float64],
    y_lines: NDArray[np.float64],
    labels: NDArray[np.int32],
    signals: NDArray[np.float32],
    channels: NDArray[np.int64],
    vignetting: NDArray[np.float64],
    falloff: NDArray[np.float64],
    response: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write the signal of each photosite of some rows under each primary.

    The blur and the photosite's aperture are one Gaussian, in print coordinates with axes along the print's; the
    drawing is rectangles, so its integral over each is a product of two differences of normal distributions: exact,
    however an edge lies to the photosites.

    `nodes`: (1 or 3, ny, nx, 2) float64, the place on the print in mm, of photosite (16 (i − 1), 16 (j − 1)) at [j, i]:
    one for all camera channels, or one for each. `sigma_px`: blur and aperture, photosites. `x_lines`, `y_lines`: (A,)
    and (B,) float64, every x and every y, ascending, at which the drawing changes, mm. `labels`: (B + 1, A + 1) int32,
    row of `signals` between the lines. `signals`: (n, 3, 3) float32, signal of a colour [label, camera channel,
    primary] in full light, DN. `channels`: (2, 2) int64, camera channel of a photosite by the parity of its row and
    column. `vignetting`: (3,) float64: x, y and c; the lens passes 1 / (1 + c r²)² at r photosites from there.
    `falloff`: (3, 4) float64, for each primary x, y, c and g: the projector gives g / (1 + c d²) at d mm from there.
    `response`: (rows, columns) float32, response of each photosite, about 1. `out`: (3, rows, columns) float32,
    written: signal under each primary, DN.
    """
    rows, columns = out.shape[1], out.shape[2]
    views, node_columns = nodes.shape[0], nodes.shape[2]
    across = np.empty((GRID_PX, 4))
    for k in range(GRID_PX):
        _cubic(k / GRID_PX, across[k])
    down = np.empty(4)
    u_row = np.empty((views, node_columns))
    v_row = np.empty((views, node_columns))
    u_down = np.empty((views, node_columns))
    v_down = np.empty((views, node_columns))
    u_sigmas = np.empty(views)
    v_sigmas = np.empty(views)
    u_share = np.empty(labels.shape[1])
    v_share = np.empty(labels.shape[0])
    for row in range(rows):
        y = first_row + row
        node_y = y // GRID_PX
        _cubic((y - node_y * GRID_PX) / GRID_PX, down)
        for s in range(views):
            for c in range(node_columns):
                u_row[s, c] = (
                    down[0] * nodes[s, node_y, c, 0]
                    + down[1] * nodes[s, node_y + 1, c, 0]
                    + down[2] * nodes[s, node_y + 2, c, 0]
                    + down[3] * nodes[s, node_y + 3, c, 0]
                )
                v_row[s, c] = (
                    down[0] * nodes[s, node_y, c, 1]
                    + down[1] * nodes[s, node_y + 1, c, 1]
                    + down[2] * nodes[s, node_y + 2, c, 1]
                    + down[3] * nodes[s, node_y + 3, c, 1]
                )
                u_down[s, c] = (nodes[s, node_y + 2, c, 0] - nodes[s, node_y + 1, c, 0]) / GRID_PX
                v_down[s, c] = (nodes[s, node_y + 2, c, 1] - nodes[s, node_y + 1, c, 1]) / GRID_PX
        i, j = 0, 0
        for start in range(0, columns, GRID_PX):
            c = start // GRID_PX + 1
            for s in range(views):
                u_across = (u_row[s, c + 1] - u_row[s, c]) / GRID_PX
                v_across = (v_row[s, c + 1] - v_row[s, c]) / GRID_PX
                u_sigmas[s] = sigma_px * math.sqrt(u_across * u_across + u_down[s, c] * u_down[s, c])
                v_sigmas[s] = sigma_px * math.sqrt(v_across * v_across + v_down[s, c] * v_down[s, c])
            for x in range(start, min(start + GRID_PX, columns)):
                w = across[x - start]
                channel = channels[y & 1, x & 1]
                s = channel if views > 1 else 0
                u_sigma, v_sigma = u_sigmas[s], v_sigmas[s]
                u = w[0] * u_row[s, c - 1] + w[1] * u_row[s, c] + w[2] * u_row[s, c + 1] + w[3] * u_row[s, c + 2]
                v = w[0] * v_row[s, c - 1] + w[1] * v_row[s, c] + w[2] * v_row[s, c + 1] + w[3] * v_row[s, c + 2]
                i, i1 = _reached(x_lines, u, REACH * u_sigma, i)
                j, j1 = _reached(y_lines, v, REACH * v_sigma, j)
                label = labels[j, i]
                red, green, blue = signals[label, channel, 0], signals[label, channel, 1], signals[label, channel, 2]
                if not _alike(labels, i, i1, j, j1):
                    _shares(x_lines, u, u_sigma, i, i1, u_share)
                    _shares(y_lines, v, v_sigma, j, j1, v_share)
                    red, green, blue = np.float32(0), np.float32(0), np.float32(0)
                    # Unsigned, for whether a signed index counts from the end is asked at each of hundreds of shares.
                    for b in range(np.uintp(j), np.uintp(j1 + 1)):
                        of_row = v_share[b]
                        for a in range(np.uintp(i), np.uintp(i1 + 1)):
                            share = np.float32(u_share[a] * of_row)
                            at = np.uintp(labels[b, a])
                            red += share * signals[at, channel, 0]
                            green += share * signals[at, channel, 1]
                            blue += share * signals[at, channel, 2]
                off_x, off_y = x - vignetting[0], y - vignetting[1]
                passed = 1 / (1 + vignetting[2] * (off_x * off_x + off_y * off_y))
                passed *= passed * response[row, x]
                du, dv = u - falloff[0, 0], v - falloff[0, 1]
                out[0, row, x] = red * passed * falloff[0, 3] / (1 + falloff[0, 2] * (du * du + dv * dv))
                du, dv = u - falloff[1, 0], v - falloff[1, 1]
                out[1, row, x] = green * passed * falloff[1, 3] / (1 + falloff[1, 2] * (du * du + dv * dv))
                du, dv = u - falloff[2, 0], v - falloff[2, 1]
                out[2, row, x] = blue * passed * falloff[2, 3] / (1 + falloff[2, 2] * (du * du + dv * dv))
