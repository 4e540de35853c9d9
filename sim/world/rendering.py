"""Geometry of the print and rendering of the light on each photosite.

**Geometry.** Point (x, y) mm of the print is `height` mm above the plane of the print, towards the camera. Waves change
the height of a point but not its x and y, because they are low compared with their wavelength. The sheet is rotated by
roll, then tilt, then pan. A pinhole camera with Brown's lens distortion projects it (D. C. Brown, "Close-range camera
calibration", 1971; coordinates and coefficients as in OpenCV).

**Rendering.** `light` is compiled by numba and runs without the interpreter lock, so `sim.world.world` calls it from
several threads for blocks of rows.

Pixels are half-size, centres at integers, x right, y down. Millimetres are on the print, from its top left corner.
Photosites are counted in the visible frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from foundation.compiled import compiled

_RIPPLE: Final = 0.1  # If `wave_mm` is given: height of the weak waves relative to the strong wave, assumed.

_NEWTON_STEPS = 6  # Maximum number of steps of `View.locate`, which ends earlier if all errors are below 10⁻⁷ px.

# Half the step of numerical derivatives, mm: small compared with folds, but large compared with rounding errors.
_STEP_MM = 0.05


@dataclass(frozen=True, eq=False)
class Waviness:
    """A smooth paper surface: the sum of some sine waves."""

    cycles: NDArray[np.float64]  # (M, 2) float64, cycles along x and y over the page
    phases: NDArray[np.float64]  # (M,) float64, radians
    amplitudes_mm: NDArray[np.float64]  # (M,) float64
    page_mm: tuple[float, float]  # Width and height

    @classmethod
    def random(
        cls, seed: int, peak_to_valley_mm: float, page_mm: tuple[float, float], modes: int = 7, wave_mm: float = 0.0
    ) -> Waviness:
        """Draw a surface with a given distance between its highest and lowest points.

        `wave_mm`: approximate wavelength of one strong wave and of weak waves in random directions; 0 for long waves.
        """
        random = np.random.default_rng([seed, 0x77617679])
        longer = max(page_mm)
        cycles = random.uniform(-3, 3, (modes, 2)) * np.array(page_mm) / longer
        amplitudes = random.uniform(0.5, 1, modes) / (0.5 + np.hypot(cycles[:, 0], cycles[:, 1]))
        if wave_mm:
            length, direction = wave_mm * random.uniform(0.85, 1.15, modes), random.uniform(0, np.pi, modes)
            cycles = np.column_stack([np.cos(direction), np.sin(direction)]) * np.array(page_mm) / length[:, None]
            # Damp paper has almost parallel ridges.
            amplitudes = np.where(np.arange(modes) == 0, 1.0, _RIPPLE)
        shape = cls(cycles, random.uniform(0, 2 * np.pi, modes), amplitudes, page_mm)
        x, y = np.meshgrid(np.linspace(0, page_mm[0], 201), np.linspace(0, page_mm[1], 201))
        extent = float(np.ptp(shape.height(np.stack([x, y], axis=-1))))
        return cls(shape.cycles, shape.phases, amplitudes * (peak_to_valley_mm / extent), page_mm)

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) mm towards the camera at points (..., 2) mm, also off the page."""
        scaled = points_mm / np.array(self.page_mm)
        total = np.zeros(points_mm.shape[:-1])
        for (along_x, along_y), phase, amplitude in zip(self.cycles, self.phases, self.amplitudes_mm, strict=True):
            total += amplitude * np.sin(2 * np.pi * (along_x * scaled[..., 0] + along_y * scaled[..., 1]) + phase)
        return total


ROUND_MM = 4.0  # Radius of a crease, mm: paper does not bend more sharply.

FLANK_MM = 40.0  # Distance from the crease, mm, in which its height falls to 1 / e.


@dataclass(frozen=True)
class Fold:
    """A crease from the upper to the lower edge of the sheet."""

    at_mm: tuple[float, float]  # A point of the crease
    along: tuple[float, float]  # Direction, a unit vector
    height_mm: float  # Height towards the camera
    slant: float  # Tangent of the angle of incidence: relative change of the light on a slope of 1

    def _distance(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        # Positive on the right of the crease.
        x, y = np.moveaxis(points_mm - np.array(self.at_mm), -1, 0)
        return x * self.along[1] - y * self.along[0]

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) mm at points (..., 2)."""
        rounded = np.hypot(self._distance(points_mm), ROUND_MM) - ROUND_MM
        return self.height_mm * np.exp(-rounded / FLANK_MM)

    def shade(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light (...) at points (..., 2), relative to a flat sheet."""
        distance = self._distance(points_mm)
        slope = -self.height(points_mm) * distance / np.hypot(distance, ROUND_MM) / FLANK_MM
        return 1 + self.slant * slope


@dataclass(frozen=True, eq=False)
class Sheet:
    """Shape of a sheet of paper: the sum of waves, curl and fold."""

    waves: Waviness
    curl_mm: float = 0.0  # Height of the left and right edges above the centre, towards the camera; a parabola
    fold: Fold | None = None

    @property
    def page_mm(self) -> tuple[float, float]:
        """Width and height of the page."""
        return self.waves.page_mm

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) mm towards the camera at points (..., 2) mm, also off the page."""
        height = self.waves.height(points_mm)
        if self.curl_mm:
            across = 2 * points_mm[..., 0] / self.page_mm[0] - 1
            height = height + self.curl_mm * across**2
        return height if self.fold is None else height + self.fold.height(points_mm)


@dataclass(frozen=True, eq=False)
class View:
    """Position of a camera in front of a print."""

    surface: Sheet
    # (3, 3) float64, from axes of the print (x right, y down, z away from the camera) to axes of the camera
    rotation: NDArray[np.float64]
    distance_mm: float  # From the pinhole to the centre of the print
    focal_px: float
    centre_px: tuple[float, float]  # Position of the optical axis in the image
    distortion: tuple[float, float, float, float]  # k1, k2, p1, p2

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
        """Return the view in which the print, without rotation, fills the share `fill` of the frame's width or height.

        `turn_deg`: tilt (about the horizontal axis), pan (vertical axis) and roll (optical axis), degrees.
        """
        width, height = frame_px
        focal = focal_diagonals * float(np.hypot(width, height))
        distance = focal * max(surface.page_mm[0] / width, surface.page_mm[1] / height) / fill
        centre = ((width - 1) / 2, (height - 1) / 2)
        return cls(surface, _rotation(*turn_deg), distance, focal, centre, distortion)

    def project(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions (..., 2) float64 in the image, half-size pixels, of points (..., 2) mm of the print."""
        page = np.array(self.surface.page_mm)
        flat = points_mm - page / 2
        rotated = flat @ self.rotation[:, :2].T - self.surface.height(points_mm)[..., None] * self.rotation[:, 2]
        depth = rotated[..., 2] + self.distance_mm
        x, y = rotated[..., 0] / depth, rotated[..., 1] / depth
        k1, k2, p1, p2 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        distorted = np.stack([distorted_x, distorted_y], axis=-1)
        return distorted * self.focal_px + np.array(self.centre_px)

    def locate(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points (..., 2) float64 of the print, mm, at half-size pixels (..., 2): inverse of `project`.

        Newton's method with central differences. For a sheet that is flat within a few millimetres, the error is below
        10⁻⁶ px. Points may be off the page.
        """
        page = np.array(self.surface.page_mm)
        points = (pixels - np.array(self.centre_px)) * (self.distance_mm / self.focal_px) + page / 2
        along_x, along_y = np.array([_STEP_MM, 0]), np.array([0, _STEP_MM])
        for _ in range(_NEWTON_STEPS):
            error = pixels - self.project(points)
            if float(np.abs(error).max(initial=0)) < 1e-7:
                break
            by_x = (self.project(points + along_x) - self.project(points - along_x)) / (2 * _STEP_MM)
            by_y = (self.project(points + along_y) - self.project(points - along_y)) / (2 * _STEP_MM)
            determinant = by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]
            step_x = (error[..., 0] * by_y[..., 1] - error[..., 1] * by_y[..., 0]) / determinant
            step_y = (by_x[..., 0] * error[..., 1] - by_x[..., 1] * error[..., 0]) / determinant
            points = points + np.stack([step_x, step_y], axis=-1)
        return points


def _rotation(tilt_deg: float, pan_deg: float, roll_deg: float) -> NDArray[np.float64]:
    # Roll first, then tilt, then pan.
    (ct, st), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in np.radians([tilt_deg, pan_deg, roll_deg]))
    tilt = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    pan = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return pan @ tilt @ roll


PAPER: Final = (255, 255, 255)  # Code that prints nothing.

_FINEST_MM: Final = 1e-3  # Coordinates with a smaller distance are equal except for rounding.

_MAX_LINES: Final = 6000  # Maximum number of distinct coordinates per axis, so that labels need less than 150 MB.


@dataclass(frozen=True, eq=False)
class Print:
    """A drawing: rectangles of uniform colour on paper, later ones on top."""

    page_mm: tuple[float, float]  # Width and height of the sheet; bare paper outside of rectangles
    rectangles_mm: NDArray[np.float64]  # (N, 4) float64: left, top, right, bottom
    rgb: NDArray[np.uint8]  # (N, 3) uint8, printed codes; (255, 255, 255) prints nothing

    def __post_init__(self) -> None:
        count = len(self.rectangles_mm)
        if self.rectangles_mm.shape != (count, 4) or self.rgb.shape != (count, 3):
            raise ValueError(
                f"rectangles {self.rectangles_mm.shape} and codes {self.rgb.shape}, expected (N, 4) and (N, 3)"
            )
        if np.any(self.rectangles_mm[:, 2:] < self.rectangles_mm[:, :2]):
            raise ValueError("right < left or bottom < top in a rectangle, expected (left, top, right, bottom)")


@dataclass(frozen=True, eq=False)
class LabelMap:
    """A print divided by vertical and horizontal lines into areas of uniform colour."""

    x_lines: NDArray[np.float64]  # (A,) float64, ascending, mm: positions of vertical edges
    y_lines: NDArray[np.float64]  # (B,) float64, ascending, mm: positions of horizontal edges
    labels: NDArray[np.int32]  # (B + 1, A + 1) int32: row of `codes` of each area; `len(codes)` off the page
    codes: NDArray[np.int64]  # (N, 3) int64, distinct codes of the print, ascending, including bare paper


def label_map(sheet: Print) -> LabelMap:
    """Return the map of a print; parts of rectangles off the page are omitted."""
    codes, label = np.unique(np.concatenate([sheet.rgb.astype(np.int64), [PAPER]]), axis=0, return_inverse=True)
    boxes = np.concatenate([sheet.rectangles_mm, [[0, 0, *sheet.page_mm]]])
    boxes = np.clip(boxes, 0, [*sheet.page_mm, *sheet.page_mm])
    (x_lines, left, right), (y_lines, top, bottom) = _lines(boxes[:, 0::2]), _lines(boxes[:, 1::2])
    labels = np.full((len(y_lines) + 1, len(x_lines) + 1), len(codes), dtype=np.int32)
    label = label.reshape(-1).astype(np.int32)
    # Draw the page first, although it is last in the list, because it is below all rectangles.
    for k in (len(label) - 1, *range(len(label) - 1)):
        labels[top[k] + 1 : bottom[k] + 1, left[k] + 1 : right[k] + 1] = label[k]
    return LabelMap(x_lines, y_lines, labels, codes)


def _lines(ends: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Return the sorted distinct coordinates of (N, 2) starts and ends, and the indices of starts and ends in them.

    Coordinates within 1 µm are replaced by their mean. If more than `_MAX_LINES` remain, this distance is increased.
    """
    resolution = _FINEST_MM
    while True:
        rounded, index = np.unique(np.round(ends / resolution), return_inverse=True)
        if len(rounded) <= _MAX_LINES:
            break
        resolution *= 1.5
    index = index.reshape(ends.shape)
    count = np.bincount(index.ravel())
    return np.bincount(index.ravel(), weights=ends.ravel()) / count, index[:, 0], index[:, 1]


GRID_PX = 16  # Photosites between the nodes of the position grid.

REACH = 4.0  # Radius of the blur in standard deviations. The share of 3·10⁻⁵ on each side is omitted.

_PHI_STEPS = 1024  # Table entries per standard deviation; the error of linear interpolation is below 2·10⁻⁷.
_PHI: NDArray[np.float32] = np.array(
    [0.5 * (1 + math.erf((i / _PHI_STEPS) / math.sqrt(2))) for i in range(int(REACH * _PHI_STEPS) + 2)],
    dtype=np.float32,
)


@compiled
def _phi(z: float) -> float:
    # Normal distribution function; error < 2·10⁻⁷ within `REACH`, 0 or 1 outside.
    size = abs(z)
    if size >= REACH:
        return 1.0 if z > 0 else 0.0
    scaled = size * _PHI_STEPS
    i = int(scaled)
    share = _PHI[i] + (_PHI[i + 1] - _PHI[i]) * (scaled - i)
    return share if z > 0 else 1.0 - share


@compiled
def _cubic(t: float, weights: NDArray[np.float64]) -> None:
    # Lagrange weights of the nodes −1, 0, 1, 2 for 0 ≤ t ≤ 1.
    weights[0] = -t * (t - 1) * (t - 2) / 6
    weights[1] = (t + 1) * (t - 1) * (t - 2) / 2
    weights[2] = -(t + 1) * t * (t - 2) / 2
    weights[3] = (t + 1) * t * (t - 1) / 6


@compiled
def _touched_intervals(lines: NDArray[np.float64], centre: float, reach: float, near: int) -> tuple[int, int]:
    """Return the first and last interval between `lines` that `centre` ± `reach` touches, searching from `near`."""
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
def _is_uniform(labels: NDArray[np.int32], i: int, i1: int, j: int, j1: int) -> bool:
    # Rows j to j1, columns i to i1.
    for b in range(j, j1 + 1):
        for a in range(i, i1 + 1):
            if labels[b, a] != labels[j, i]:
                return False
    return True


@compiled
def _shares(
    lines: NDArray[np.float64], centre: float, sigma: float, first: int, last: int, out: NDArray[np.float64]
) -> None:
    # Share of a normal distribution in each interval; the sum is 1.
    previous = 0.0
    for k in range(first, last):
        below = _phi((lines[k] - centre) / sigma)
        out[k] = below - previous
        previous = below
    out[last] = 1.0 - previous


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

    Blur and aperture of the photosite are one Gaussian, whose axes are parallel to the edges of the print. Its integral
    over a rectangle is the product of two differences of the normal distribution function.

    Parameters
    ----------
    first_row
        Row of the visible frame where `out` starts.
    nodes
        (1 or 3, ny, nx, 2) float64, mm. Entry [:, j, i] is the point on the print that the photosite in column
        16 (i − 1) and row 16 (j − 1) sees. The first axis has one entry for all channels, or one for each channel.
    sigma_px
        Standard deviation of blur and aperture, photosites.
    x_lines, y_lines, labels
        See `LabelMap`; a label is an index of `signals`.
    signals
        (n, 3, 3) float32, signal of a colour [label, camera channel, primary] in full light, DN.
    channels
        (2, 2) int64, camera channel by parity of row and column.
    vignetting
        (3,) float64: x, y and c; the lens transmits 1 / (1 + c r²)² at r photosites from (x, y).
    falloff
        (3, 4) float64, x, y, c and g of each primary: the projector gives g / (1 + c d²) at d mm from (x, y).
    response
        (rows, columns) float32, response of each photosite, about 1.
    out
        (3, rows, columns) float32, written: signal under each primary, DN.
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
                i, i1 = _touched_intervals(x_lines, u, REACH * u_sigma, i)
                j, j1 = _touched_intervals(y_lines, v, REACH * v_sigma, j)
                label = labels[j, i]
                red, green, blue = signals[label, channel, 0], signals[label, channel, 1], signals[label, channel, 2]
                if not _is_uniform(labels, i, i1, j, j1):
                    _shares(x_lines, u, u_sigma, i, i1, u_share)
                    _shares(y_lines, v, v_sigma, j, j1, v_share)
                    red, green, blue = np.float32(0), np.float32(0), np.float32(0)
                    # Unsigned indices are faster, because numba does not check them for negative values.
                    for b in range(np.uintp(j), np.uintp(j1 + 1)):
                        row_share = v_share[b]
                        for a in range(np.uintp(i), np.uintp(i1 + 1)):
                            share = np.float32(u_share[a] * row_share)
                            entry = np.uintp(labels[b, a])
                            red += share * signals[entry, channel, 0]
                            green += share * signals[entry, channel, 1]
                            blue += share * signals[entry, channel, 2]
                off_x, off_y = x - vignetting[0], y - vignetting[1]
                transmission = 1 / (1 + vignetting[2] * (off_x * off_x + off_y * off_y))
                transmission *= transmission * response[row, x]
                du, dv = u - falloff[0, 0], v - falloff[0, 1]
                out[0, row, x] = red * transmission * falloff[0, 3] / (1 + falloff[0, 2] * (du * du + dv * dv))
                du, dv = u - falloff[1, 0], v - falloff[1, 1]
                out[1, row, x] = green * transmission * falloff[1, 3] / (1 + falloff[1, 2] * (du * du + dv * dv))
                du, dv = u - falloff[2, 0], v - falloff[2, 1]
                out[2, row, x] = blue * transmission * falloff[2, 3] / (1 + falloff[2, 2] * (du * du + dv * dv))
