"""Find a chart without tags: trace the outline of its patch area near given corners.

The corners come from the user or from another frame of the session. Their order determines the orientation of the
chart. The image is compared with the printed codes, so a wrong order and a mirrored image are detected.

Users give corners in pixels of the raw file before any rotation: x to the right, y down, (0, 0) is the first visible
pixel. The first corner is printed top-left, and the other three follow clockwise. Positions in the code are in
half-size pixels. The traced outline includes lens distortion; `homography` does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from drivers.raw.rawfile import Plane
from experiment.chart.model import Chart
from experiment.framing.homography import fit_homography, project
from foundation.errors import InputError, RegistrationError
from foundation.robust import biweight, huber_weights, robust_sigma

# Smallest usable level of the brightest parts of the image (`paper_level`), counts above black.
MIN_SIGNAL = 12.0

# The edge is searched up to this distance from the sides of the given quadrilateral, half-size px.
CORNER_REACH_PX = 24.0

SIDE_POINTS = 160  # Number of points on each side at which the edge is searched


# Shortest side of the patch area, raw pixels: twice the width of the band in which an edge is searched.
LEAST_SIDE_PX = 192


# The printed codes must explain at least this fraction of the variance between patches. The codes of a different chart
# explain almost nothing.
MIN_EXPLAINED = 0.5

# The given orientation is refused if its misfit of colours, divided by this factor, is still larger than the misfit of
# the best orientation.
MIN_ADVANTAGE = 1.3

MIRRORED = 4  # Orientations from this number on are mirrored: 0 … 3 are quarter turns, 4 … 7 mirrored quarter turns

_SMALL_WIDTH_PX = 640  # Width of the reduced image in which the level of paper is estimated, px

# Smallest signal of a channel that is used for colours or for edges, relative to the strongest channel.
_COLOUR_SIGNAL, _EDGE_SIGNAL = 0.03, 0.2

_PROFILE_STEP_PX = 0.5  # Distance of the samples across an edge, half-size px: one photosite

# σ of the Gaussian that smooths a profile before its steepest rise is searched, half-size px.
_EDGE_SIGMA_PX = 1.0

# Rounds of the search: search distance in half-size px, order of the curve along a side, and standard deviation of the
# prior for the edge position in half-size px.
_ROUNDS = ((CORNER_REACH_PX, 2, 1e3), (CORNER_REACH_PX / 2, 5, 12.0), (6.0, 5, 6.0))

_MIN_EDGE = 0.05  # Smallest step from patches to paper that counts as an edge, relative to paper

# Sample positions around an edge point, along and across the edge, half-size px. Outwards, the samples end before the
# marks in the margin.
_REFINE_ALONG_PX = np.arange(-2.0, 2.1)
_REFINE_ACROSS_PX = np.arange(-3.5, 2.1, 0.5)

# Iterations of the fit of a blurred step. Each iteration moves the step by at most 0.5 px.
_REFINE_ROUNDS = 6

_INTERPOLATION_PX = 0.4  # σ of the blur that linear interpolation adds to an edge, half-size px

# Largest correction of an edge position, half-size px. The samples do not reach farther.
_LARGEST_CORRECTION_PX = 1.5

_CLEAR_EDGE = 0.15  # Smallest step from patches to paper, relative to paper, whose position is accurate to 0.1 px

# Order of the curve through the deviations along a side. It is high enough for curled corners, and too low to follow
# marks in the margin.
_SIDE_CURVE_ORDER = 8

# Number of random patches in the comparison of colours: a hundred for each parameter of the fit.
_COMPARED_CELLS = 1500

_Float = npt.NDArray[np.float32]
_Points = npt.NDArray[np.float64]
Corners = tuple[tuple[float, float], ...]


def paper_level(plane: Plane) -> float:
    """Return the level of the brightest parts of a plane, counts above black: 99.5th percentile of 4×4 means."""
    # In a dark frame, noise makes single pixels bright; means over 4×4 pixels suppress it.
    height, width = plane.values.shape
    size = (max(1, width // 4), max(1, height // 4))
    return float(np.percentile(cv2.resize(plane.values, size, interpolation=cv2.INTER_AREA), 99.5))


@dataclass(frozen=True, eq=False)
class DetectedField:
    """The patch area of a chart in an image."""

    corners_px: _Points  # (4, 2), clockwise from the printed top-left
    homography: npt.NDArray[np.float64]  # (3, 3), print (mm) to half-size px, without lens distortion
    outline_mm: _Points  # (N, 2), points of the outline on the print
    outline_px: _Points  # (N, 2), the same points in the image, accurate only across the outline
    normals: _Points  # (N, 2), unit vectors across the outline, outwards
    explained: float  # fraction of the variance between patches that the printed codes explain, 0 … 1

    def curve_residual_px(self, residual_px: _Points) -> _Points:
        """Fit a smooth curve to the residuals of each side, and return the distance (N,) px of each point from it.

        `residual_px`: (N, 2), measured minus modelled positions of the outline points. Only the components across the
        outline are used.
        """
        across: _Points = (residual_px * self.normals).sum(axis=1)
        low, high = self.outline_mm.min(axis=0), self.outline_mm.max(axis=0)
        fraction: _Points = (self.outline_mm - low) / (high - low)
        distances = np.abs(across)
        for axis in (0, 1):
            for end in (0.0, 1.0):
                on_side = np.abs(fraction[:, axis] - end) < 1e-6
                along: _Points = fraction[on_side, 1 - axis]
                if len(along) > 2 * _SIDE_CURVE_ORDER:
                    curve, _ = robust_curve(along, across[on_side], _SIDE_CURVE_ORDER)
                    distances[on_side] = np.abs(across[on_side] - np.polynomial.legendre.legval(2 * along - 1, curve))
        return distances


def field_mm(chart: Chart) -> _Points:
    """Return the corners of the patch area, (4, 2) float64 mm, clockwise from its top-left."""
    half = np.array(chart.cell_mm) / 2
    left, top = chart.centres_mm.min(axis=0) - half
    right, bottom = chart.centres_mm.max(axis=0) + half
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


# Remedy in messages about a patch area whose position is unknown.
HOW_TO_GIVE_CORNERS = (
    "give the corners of its patch area with --corners, for example --corners 297,90 4866,160 4805,3319 296,3326: "
    "x,y in pixels of the raw file as it is stored, clockwise from the corner that is printed top-left; read them from "
    "the border ticks of the image that acquire check --picture saves, or in an image viewer"
)


def find_field(
    planes: Sequence[Plane],
    chart: Chart,
    image_name: str,
    corners_px: npt.ArrayLike | None = None,
    near_px: npt.ArrayLike | None = None,
) -> DetectedField:
    """Return the position of the patch area in an image.

    Parameters
    ----------
    planes
        Red, green and blue plane of one frame.
    image_name
        Name of the image in error messages.
    corners_px
        (4, 2) float, half-size px, accurate to about 20 px: corners given by the user, clockwise from the printed
        top-left. Their order determines the orientation of the chart.
    near_px
        (4, 2) float, half-size px: the corners in another frame of the session, in the same order.

    Raises
    ------
    InputError, RegistrationError
        If the corners do not fit the chart, or the patch area is not detected.
    """
    white = max(paper_level(plane) for plane in planes)
    if white < MIN_SIGNAL:
        raise RegistrationError(
            f"{image_name} is dark: its brightest parts are {max(white, 0.0):.0f} counts above black, expected at "
            f"least {MIN_SIGNAL:.0f} counts; switch the projector on, open its shutter, or expose longer"
        )
    if near_px is not None:
        return _find_near_field(planes, chart, np.asarray(near_px, dtype=np.float64), image_name)
    if corners_px is None:
        raise RegistrationError(
            f"{image_name}: no corners are given, and the chart has no tags by which to locate it; "
            f"{HOW_TO_GIVE_CORNERS}"
        )
    return _find_given_field(PreparedImage.of(planes), chart, np.asarray(corners_px, dtype=np.float64), image_name)


def _find_near_field(planes: Sequence[Plane], chart: Chart, near_px: _Points, image_name: str) -> DetectedField:
    picture = PreparedImage.of(planes)
    outline = trace_outline(picture, near_px)
    if outline is not None:
        placed = _PlacedChart.of(outline, chart, 0)
        explained = 1 - _colour_misfit(picture, placed, chart)[1]
        if explained >= MIN_EXPLAINED:
            return placed.detected_field(explained)
    raise RegistrationError(
        f"{image_name}: the patch area is not within {2 * CORNER_REACH_PX:.0f} pixels of {corners_text(near_px)}, its "
        "position in another frame; uncover the chart and light all of it, or, if it was moved, take the following "
        "frames as a separate session"
    )


def _find_given_field(picture: PreparedImage, chart: Chart, corners_px: _Points, image_name: str) -> DetectedField:
    require_corners(corners_px, picture.shape)
    given_corners = corners_text(corners_px)
    outline = trace_outline(picture, corners_px)
    if outline is None:
        raise RegistrationError(
            f"{image_name}: not all four sides near the given corners {given_corners} have an edge between patches and "
            "paper; give the corners of the patch area (not of the sheet) within 40 pixels, and uncover its margin"
        )
    placed_charts = [_PlacedChart.of(outline, chart, turn) for turn in range(8)]
    misfits = [_colour_misfit(picture, placed, chart) for placed in placed_charts]
    explained = 1 - misfits[0][1]
    best_turn = int(np.argmin([misfit for misfit, _ in misfits]))
    fits_other_turn = best_turn > 0 and MIN_ADVANTAGE * misfits[best_turn][0] < misfits[0][0]
    if explained >= MIN_EXPLAINED and not fits_other_turn:
        return placed_charts[0].detected_field(explained)
    if 1 - misfits[best_turn][1] < MIN_EXPLAINED or not fits_other_turn:
        raise RegistrationError(
            f"{image_name}: within the given corners {given_corners}, the chart's colours explain "
            f"{max(explained, 0):.0%} of the variation, expected at least {MIN_EXPLAINED:.0%}; give the corners of the "
            "patch area (not of the sheet) clockwise from the printed top-left, and the chart.json of this print"
        )
    if best_turn >= MIRRORED:
        raise RegistrationError(
            f"{image_name} is mirrored: within the given corners {given_corners}, the chart's colours fit only in the "
            "mirrored image; take the frame without a mirror, or print the chart unmirrored"
        )
    raise InputError(
        f"{image_name}: the given corners {given_corners} do not start at the printed top-left: the chart's colours "
        f"fit the order {corners_text(np.roll(corners_px, -best_turn, axis=0))}; give the corners in this order"
    )


@dataclass(frozen=True, eq=False)
class _PlacedChart:
    """The chart fitted to an outline in one orientation. The order of its sides is top, right, bottom, left."""

    corners_mm: _Points
    corners_px: _Points
    homography: npt.NDArray[np.float64]
    sides_mm: tuple[_Points, ...]  # points (N, 2) of each side, in ascending x or y
    sides_px: tuple[_Points, ...]  # the same points in the image
    normals: tuple[_Points, ...]

    @classmethod
    def of(cls, outline: Outline, chart: Chart, turn: int) -> _PlacedChart:
        """Fit the chart in orientation `turn`: 0 … 3 are quarter turns, 4 … 7 mirrored quarter turns."""
        order = np.roll(np.arange(4), -turn)
        if turn >= MIRRORED:
            order = order[::-1]
        corners_mm, corners_px = field_mm(chart), outline.corners_px[order]
        homography = fit_homography(corners_mm, corners_px)
        if homography is None:
            homography = np.eye(3)
        to_mm = np.asarray(np.linalg.inv(homography), dtype=np.float64)
        sides: list[tuple[_Points, _Points, _Points]] = []
        for side in range(4):
            corner_numbers = {int(order[side]), int(order[(side + 1) % 4])}
            k = next(k for k in range(4) if {k, (k + 1) % 4} == corner_numbers)
            along = side % 2
            points = project(to_mm, outline.sides_px[k])
            points[:, 1 - along] = corners_mm[side, 1 - along]
            ascending = np.argsort(points[:, along])
            sides.append((points[ascending], outline.sides_px[k][ascending], outline.normals[k][ascending]))
        mm, px, normals = zip(*sides, strict=True)
        return cls(corners_mm, corners_px, homography, mm, px, normals)

    def to_pixels(self, points_mm: _Points) -> _Points:
        """Map points (N, 2) to the image by the homography, and add its errors, interpolated from the four sides."""
        mapped = project(self.homography, points_mm)
        (left, top), (right, bottom) = self.corners_mm[0], self.corners_mm[2]
        fraction = (points_mm - (left, top)) / (right - left, bottom - top)
        weights = (1 - fraction[:, 1], fraction[:, 0], fraction[:, 1], 1 - fraction[:, 0])
        for side, weight in enumerate(weights):
            along = side % 2
            mm, normals = self.sides_mm[side], self.normals[side]
            deviation = self.sides_px[side] - project(self.homography, mm)
            deviation = (deviation * normals).sum(axis=1, keepdims=True) * normals
            position, side_position = points_mm[:, along], mm[:, along]
            for axis in (0, 1):
                mapped[:, axis] += weight * np.interp(position, side_position, deviation[:, axis])
        return mapped

    def detected_field(self, explained: float) -> DetectedField:
        mm, px, normals = (np.concatenate(sides) for sides in (self.sides_mm, self.sides_px, self.normals))
        return DetectedField(self.corners_px, self.homography, mm, px, normals, explained)


def _colour_misfit(picture: PreparedImage, placed: _PlacedChart, chart: Chart) -> tuple[float, float]:
    """Return two misfits between the image and the printed codes, each 0 … 1.

    Two models are fitted to each channel: light and codes, and light alone. The scatter of the patches around the first
    fit is divided by the scatter around the second. The first misfit is the product of these ratios, the second is the
    mean of their squares.
    """
    sampled_patches = np.random.default_rng(1).permutation(chart.colour_count)[:_COMPARED_CELLS]
    points = chart.centres_mm[sampled_patches]
    positions = placed.to_pixels(points)
    height, width = picture.shape
    inside = np.asarray(((positions >= 0) & (positions <= (width - 1, height - 1))).all(axis=1))
    if inside.mean() < 0.9:
        return 1.0, 1.0
    positions, points = positions[inside], points[inside]
    codes = chart.rgb[sampled_patches[inside]] / 255.0
    page = 2 * points / chart.page_mm - 1
    # The logarithm of the counts is modelled by a polynomial over the page (light) and a polynomial of the codes (ink).
    light = np.column_stack([np.ones(len(page)), page, page**2, page[:, 0] * page[:, 1]])
    pairs = [(i, j) for i in range(3) for j in range(i, 3)] if chart.bits > 1 else []
    colour = np.column_stack([codes, *(codes[:, i] * codes[:, j] for i, j in pairs)])
    product = 1.0
    unexplained: list[float] = []
    for channel, plane in zip(picture.channels, picture.planes, strict=True):
        x, y = (positions - plane.offset_px).astype(np.float32).T
        counts = cv2.remap(plane.values, x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0].astype(np.float64)
        value = np.log(np.maximum(counts, 0.01 * float(np.median(np.abs(counts)) + 1e-9)))
        light_spread, _ = _robust_fit(light, value)
        colour_spread, solution = _robust_fit(np.column_stack([light, colour]), value)
        slope = solution[len(light[0]) + channel]
        for index, (i, j) in enumerate(pairs):
            slope += solution[len(light[0]) + 3 + index] * (
                (i == channel) * codes[:, j].mean() + (j == channel) * codes[:, i].mean()
            )
        # If a channel does not become brighter with its own code, the codes explain nothing.
        ratio = min(colour_spread / light_spread, 1.0) if slope > 0 else 1.0
        product *= ratio
        unexplained.append(ratio**2)
    return product, float(np.mean(unexplained))


def _robust_fit(design: _Points, values: npt.NDArray[np.float64]) -> tuple[float, npt.NDArray[np.float64]]:
    """Return the standard deviation of the residuals and the coefficients of a linear fit, both robust to outliers."""
    weights = np.ones(len(values))
    terms = int(design.shape[1])
    solution, spread = np.zeros(terms), 1.0
    ridge = 1e-9 * len(values) * np.eye(terms)
    for _ in range(4):
        weighted = design * weights[:, None]
        # Use einsum, because for so few unknowns the threads of a linear-algebra library cost more time than they save.
        gram = np.einsum("ni,nj->ij", weighted, design) + ridge
        solution = np.asarray(np.linalg.solve(gram, np.einsum("ni,n->i", weighted, values)), dtype=np.float64)
        residual = np.abs(values - design @ solution)
        spread = robust_sigma(residual) + 1e-9
        weights = huber_weights(residual, spread)
    return spread, solution


def parse_corners(texts: Sequence[str]) -> Corners:
    """Return four corners (x, y), half-size px, from four texts X,Y in raw pixels."""
    if len(texts) != 4:
        raise InputError(
            f"{len(texts)} corners are given, {' '.join(texts)}, 4 expected; give X,Y of each in pixels of the raw file"
        )
    corners: list[tuple[float, float]] = []
    for text in texts:
        try:
            x, y = (float(coordinate) for coordinate in text.split(","))
        except ValueError:
            x = y = math.nan
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"{text!r} is not a corner, X,Y expected; give two numbers, in pixels of the raw file")
        corners.append(((x - 0.5) / 2, (y - 0.5) / 2))
    require_corners(np.array(corners))
    return tuple(corners)


def corners_text(corners_px: npt.ArrayLike) -> str:
    """Return corners (N, 2) float half-size px as the text "X,Y X,Y" in whole raw pixels."""
    return " ".join(f"{2 * x + 0.5:.0f},{2 * y + 0.5:.0f}" for x, y in np.asarray(corners_px).reshape(-1, 2))


def require_corners(corners_px: _Points, shape: tuple[int, int] | None = None) -> None:
    """Raise `InputError` if corners cannot belong to a patch area in an image of `shape` (height, width).

    `corners_px`: (4, 2) float64, half-size px, clockwise from the printed top-left.
    """
    given_corners = corners_text(corners_px)
    remedy = "give four positions X,Y, clockwise from the printed top-left corner of the patch area"
    contour = corners_px.astype(np.float32)[:, None]
    if corners_px.shape != (4, 2) or not cv2.isContourConvex(contour) or cv2.contourArea(contour) < 1:
        raise InputError(f"the given corners {given_corners} are not a convex quadrilateral; {remedy}")
    if cv2.contourArea(contour, oriented=True) < 0:
        raise InputError(
            f"the given corners {given_corners} run counter-clockwise; {remedy}, and take the frame without a mirror"
        )
    if shape is not None and ((corners_px < -0.5).any() or (corners_px > (shape[1] - 0.5, shape[0] - 0.5)).any()):
        raise InputError(
            f"the given corners {given_corners} are outside the image of {2 * shape[1]}×{2 * shape[0]} pixels; "
            "give pixels of the raw file before any rotation"
        )
    shortest = 2 * float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).min())
    if shortest < LEAST_SIDE_PX:
        raise InputError(
            f"two of the given corners {given_corners} are {shortest:.0f} pixels apart, expected at least "
            f"{LEAST_SIDE_PX} pixels; give the corners of the whole patch area"
        )


@dataclass(frozen=True, eq=False)
class PreparedImage:
    """An image prepared for the search of the edge between patches and paper."""

    planes: tuple[Plane, ...]  # planes with enough light, slightly smoothed
    channels: tuple[int, ...]  # channel of each plane: 0, 1, 2
    levels: tuple[_Float, ...]  # for each plane, the local level of paper, estimated in a reduced image
    bright: tuple[bool, ...]  # for each plane, whether patches differ from paper by more than noise
    shape: tuple[int, int]  # height and width, half-size px
    factor: int  # half-size pixels per pixel of the reduced image

    @classmethod
    def of(cls, planes: Sequence[Plane]) -> PreparedImage:
        """Prepare the red, green and blue plane of a frame."""
        height, width = planes[0].values.shape
        factor = max(1, round(width / _SMALL_WIDTH_PX))
        size = (width // factor, height // factor)
        brightest = [paper_level(plane) for plane in planes]
        usable = [k for k, level in enumerate(brightest) if level >= max(MIN_SIGNAL, _COLOUR_SIGNAL * max(brightest))]
        levels: list[_Float] = []
        for k in usable:
            cropped = planes[k].values[: size[1] * factor, : size[0] * factor]
            small = cv2.blur(cv2.resize(cropped, size, interpolation=cv2.INTER_AREA), (3, 3))
            # The local maximum is the level of paper, because paper or an equally bright patch is near every point.
            reach = size[0] // 5 | 1
            level = cv2.blur(cv2.dilate(small, np.ones((reach, reach), dtype=np.uint8)), (reach, reach))
            level = np.maximum(level, np.float32(0.2 * brightest[k])).astype(np.float32)
            levels.append(level)
        smooth = tuple(replace(planes[k], values=cv2.blur(planes[k].values, (3, 3)).astype(np.float32)) for k in usable)
        bright = tuple(brightest[k] >= _EDGE_SIGNAL * max(brightest) for k in usable)
        return cls(smooth, tuple(usable), tuple(levels), bright, (height, width), factor)

    def to_small(self, points_px: _Points) -> _Points:
        """Convert points (..., 2) float64 from half-size px to pixels of the reduced image."""
        return (points_px - (self.factor - 1) / 2) / self.factor

    def paleness_at(self, points_px: _Points) -> _Float:
        """Return the brightness relative to paper, (...) float32, at points (..., 2) float64 half-size px.

        It is the minimum over the channels with enough light.
        """
        x, y = (np.ascontiguousarray(points_px[..., axis], dtype=np.float32) for axis in (0, 1))
        small_points = self.to_small(points_px).astype(np.float32)
        sx, sy = small_points[..., 0], small_points[..., 1]
        paleness = np.full(x.shape, np.inf, dtype=np.float32)
        for plane, paper_levels, bright in zip(self.planes, self.levels, self.bright, strict=True):
            if not bright:
                continue
            dx, dy = (np.float32(offset) for offset in plane.offset_px)
            level = cv2.remap(plane.values, x - dx, y - dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            paper = cv2.remap(paper_levels, sx, sy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            paleness = np.minimum(paleness, level / paper)
        return paleness


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed outline in an image."""

    corners_px: _Points  # (4, 2), clockwise in the image
    sides_px: tuple[_Points, ...]  # points (N, 2) of each side, from corner k to the next
    normals: tuple[_Points, ...]  # (N, 2) for each side, outwards


def _outward_normal(start: _Points, end: _Points) -> _Points:
    """Return the outward unit normal (2,) of the side from start to end in a clockwise outline."""
    x, y = (end - start) / np.linalg.norm(end - start)
    return np.array([y, -x])


def trace_outline(picture: PreparedImage, corners_px: _Points) -> Outline | None:
    """Trace the edge between patches and paper near a quadrilateral; None if one side has no such edge.

    Each round searches the steepest rise towards paper across each side. Then a Legendre series is fitted to the
    detected points by iteratively reweighted least squares with Tukey's biweight.

    `corners_px`: (4, 2) float64 half-size px, clockwise in the image, accurate to `CORNER_REACH_PX`.
    """
    corners = np.asarray(corners_px, dtype=np.float64)
    curves = [np.zeros(1)] * 4
    along = (np.arange(SIDE_POINTS) + 0.5) / SIDE_POINTS
    sides_px: list[_Points] = []
    normals: list[_Points] = []
    for reach, order, sigma_px in _ROUNDS:
        across = np.arange(-reach, reach + 0.01, _PROFILE_STEP_PX)
        sides_px, normals = [], []
        smooth_sides: list[_Points] = []
        for side in range(4):
            start, end = corners[side], corners[(side + 1) % 4]
            if np.linalg.norm(end - start) < 4 * reach:
                return None
            normal = _outward_normal(start, end)
            middle = _bent_points(along, curves[side], start, end)
            profiles = picture.paleness_at(middle[:, None] + across[None, :, None] * normal)
            offsets, strength = _steepest_rises(profiles, across, sigma_px)
            has_edge = strength > _MIN_EDGE
            if has_edge.mean() < 0.4:
                return None
            change, fits = robust_curve(along[has_edge], offsets[has_edge], order)
            if fits.mean() < 0.5:
                return None
            smooth_sides.append(_bent_points(np.linspace(0, 1, 41), _sum_series(curves[side], change), start, end))
            sides_px.append((middle[has_edge] + offsets[has_edge, None] * normal)[fits])
            normals.append(np.tile(normal, (len(sides_px[-1]), 1)))
        corners = _intersections(smooth_sides)
        curves = [_fit_curve(corners[side], corners[(side + 1) % 4], smooth_sides[side], order) for side in range(4)]
    return Outline(corners, tuple(sides_px), tuple(normals))


def refine_edges(
    planes: Sequence[Plane], points_px: _Points, normals: _Points, blur_px: float
) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Refine the position of an edge in each colour plane by fitting a blurred step.

    Each colour is fitted separately, because a lens shifts red and blue edges (lateral chromatic aberration).

    Parameters
    ----------
    points_px, normals
        (N, 2) float64, half-size px: points of the edge, accurate to a pixel, and outward unit vectors.
    blur_px
        σ of the edges in the image, half-size px.

    Returns
    -------
        Positions (K, N, 2) half-size px, and step heights (K, N) relative to paper. If an edge is not clear, its height
        is 0 and its position is unchanged.
    """
    tangents = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    grid = points_px[:, None, None] + _REFINE_ALONG_PX[None, :, None, None] * tangents[:, None, None]
    grid = grid + _REFINE_ACROSS_PX[None, None, :, None] * normals[:, None, None]
    positions = np.repeat(points_px[None], len(planes), axis=0)
    heights = np.zeros(positions.shape[:2])
    for index, plane in enumerate(planes):
        level = paper_level(plane)
        if level < MIN_SIGNAL:
            continue
        x, y = (np.ascontiguousarray((grid - plane.offset_px)[..., axis].reshape(len(grid), -1)) for axis in (0, 1))
        counts = cv2.remap(plane.values, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        profile = np.asarray(counts, dtype=np.float64).reshape(grid.shape[:-1]).mean(axis=1) / level
        offsets, step_heights = _fitted_step(profile, float(np.hypot(blur_px, _INTERPOLATION_PX)))
        is_clear = (step_heights > _CLEAR_EDGE) & (np.abs(offsets) < _LARGEST_CORRECTION_PX)
        positions[index] += np.where(is_clear, offsets, 0.0)[:, None] * normals
        heights[index] = np.where(is_clear, step_heights, 0.0)
    return positions, heights


def _fitted_step(profile: _Points, sigma: float) -> tuple[_Points, _Points]:
    """Fit a step blurred by `sigma` px to each profile (N, M); return the offsets (N,) px and heights (N,)."""
    offsets: _Points = np.zeros(len(profile))
    heights: _Points = np.zeros(len(profile))
    for _ in range(_REFINE_ROUNDS):
        distances = (_REFINE_ACROSS_PX[None] - offsets[:, None]) / sigma
        step, slope = ndtr(distances), np.exp(-0.5 * distances**2) / np.sqrt(2 * np.pi) / sigma
        # The brightness changes from patch to patch, so the patches' side of the step also has a slope.
        design = np.stack([np.ones_like(step), step, slope, np.minimum(_REFINE_ACROSS_PX[None], 0) + 0 * step], axis=-1)
        gram = np.einsum("kni,knj->kij", design, design) + 1e-9 * np.eye(4)
        solution = np.linalg.solve(gram, np.einsum("kni,kn->ki", design, profile)[..., None])[..., 0].astype(np.float64)
        heights = solution[:, 1]
        offsets = offsets - np.clip(solution[:, 2] / np.where(np.abs(heights) > 0.01, heights, 0.01), -0.5, 0.5)
    return offsets, heights


def _bent_points(share: _Points, curve: _Points, start: _Points, end: _Points) -> _Points:
    """Return points (N, 2) at fractions (N,) of the line from start to end, moved outwards by a Legendre series."""
    outwards = np.polynomial.legendre.legvander(2 * share - 1, len(curve) - 1) @ curve
    return start + share[:, None] * (end - start) + outwards[:, None] * _outward_normal(start, end)


def _sum_series(first: _Points, second: _Points) -> _Points:
    total = np.zeros(max(len(first), len(second)))
    total[: len(first)] += first
    total[: len(second)] += second
    return total


def _steepest_rises(paleness: _Float, across: _Points, sigma_px: float) -> tuple[_Points, _Points]:
    """Return the position and height (N,) of the steepest rise to the level of paper in each profile (N, M).

    `sigma_px`: standard deviation of the prior for the position, whose mean is 0.
    """
    # Average neighbouring profiles, which suppresses noise and the ticks of a ruler.
    profile = cv2.blur(cv2.GaussianBlur(paleness, (0, 0), _EDGE_SIGMA_PX / _PROFILE_STEP_PX, sigmaY=0.1), (1, 3))
    step = round(_EDGE_SIGMA_PX / _PROFILE_STEP_PX)
    rise = np.zeros_like(profile)
    rise[:, step:-step] = profile[:, 2 * step :] - profile[:, : -2 * step]
    level_beyond = np.roll(profile, -2 * step, axis=1)
    # If a profile has several rises, for example at marks in the margin, the weights prefer the expected position.
    weights = np.exp(-2 * (across / sigma_px) ** 2).astype(np.float32)
    coarse = (rise * weights * np.clip(level_beyond, 0, 1) ** 4).argmax(axis=1)
    row = np.arange(len(coarse))
    candidates = np.clip(coarse[:, None] + np.arange(-2 * step, 2 * step + 1), 1, len(across) - 2)
    best = candidates[row, rise[row[:, None], candidates].argmax(axis=1)]
    left, middle, right = (rise[row, best + shift] for shift in (-1, 0, 1))
    fraction = np.clip(0.5 * (left - right) / np.minimum(left - 2 * middle + right, -1e-9), -1, 1)
    return across[best] + fraction * _PROFILE_STEP_PX, middle.astype(np.float64)


def robust_curve(along: _Points, offsets: _Points, order: int) -> tuple[_Points, npt.NDArray[np.bool_]]:
    """Fit a Legendre series to the majority of the points on a side.

    `along`: (N,) float64, position along the side, 0 … 1. `offsets`: (N,) float64, distance from the side, half-size
    px. Returns the coefficients (order + 1,) float64 on −1 … 1, and a mask (N,) bool of the points that fit.
    """
    basis = np.polynomial.legendre.legvander(2 * along - 1, order)
    scale = max(robust_sigma(offsets - np.median(offsets)), 0.5)
    weights = 1 / np.maximum(np.abs(offsets - np.median(offsets)), scale)
    solution = np.zeros(order + 1)
    for _ in range(8):
        root = np.sqrt(weights)
        solution = np.linalg.lstsq(basis * root[:, None], offsets * root, rcond=None)[0]
        residual = np.abs(offsets - basis @ solution)
        scale = max(robust_sigma(residual), 0.15)
        weights = biweight(residual, scale) + 1e-6
    return solution.astype(np.float64), np.asarray(np.abs(offsets - basis @ solution) < 3 * scale)


def _intersections(sides: Sequence[_Points]) -> _Points:
    corners = np.zeros((4, 2))
    for k in range(4):
        previous, following = sides[k - 1], sides[k]
        normals = np.stack([_outward_normal(*previous[-2:]), _outward_normal(*following[:2])])
        corners[k] = np.linalg.solve(normals, np.array([normals[0] @ previous[-1], normals[1] @ following[0]]))
    return corners


def _fit_curve(start: _Points, end: _Points, points: _Points, order: int) -> _Points:
    normal = _outward_normal(start, end)
    share = (points - start) @ (end - start) / float((end - start) @ (end - start))
    basis = np.polynomial.legendre.legvander(2 * share - 1, order)
    return np.linalg.lstsq(basis, (points - start) @ normal, rcond=None)[0].astype(np.float64)
