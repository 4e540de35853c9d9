"""A chart without tags in a picture: the outline of its field of cells, traced from corners that are given.

The corners are given by hand, or they are the corners in another frame of the session. The outline is drawn onto the
edge between cells and paper near them. The chart's colours must fit what is seen inside; corners in a wrong order, and
a mirrored picture, are an error.

Corners given by hand are pixels of the raw file as it is stored, not turned by a viewer; x right, y down, the first
pixel of the visible picture at 0,0; clockwise from the corner that is printed top-left. All other places are half-size
pixels. Lenses bend the outline: it is followed as it is, and `homography` is the straight one nearest to it.
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

# Counts above black that the brightest parts of the strongest plane must have for a chart to be looked for.
MIN_SIGNAL = 12.0

CORNER_REACH_PX = 24.0  # How far from a guess the field's outline is looked for

SIDE_POINTS = 160  # Places along a side at which the edge is looked for: many times the six coefficients of its curve


# Raw pixels a side must have for its edge to be looked for around it: four times the 24 half-size pixels that the
# search reaches to either side (`experiment.framing.field.CORNER_REACH_PX`).
LEAST_SIDE_PX = 192


# Share of the cells' variation that the chart's colours must explain; another order of cells explains none.
MIN_EXPLAINED = 0.5

# How many times better than the second best the best orientation must fit, in standard deviations of the residual.
MIN_ADVANTAGE = 1.3

MIRRORED = 4  # Of the eight orientations of a rectangle the first that is mirrored

_SMALL_WIDTH_PX = 640  # Width of the small raster on which the level of paper is looked for

# Light of a colour over that of the strongest: to be looked at for colours, and for edges.
_LEAST_LIGHT, _MUCH_LIGHT = 0.03, 0.2

_PROFILE_STEP_PX = 0.5  # Step of the profiles across an edge: half a half-size pixel, a photosite

# σ by which profiles are smoothed before their steepest rise is looked for: the blur of a picture just usable.
_EDGE_SIGMA_PX = 1.0

# How far from the guess the edge is looked for, the order of the curve drawn through it, and how well it is known.
_ROUNDS = ((CORNER_REACH_PX, 2, 1e3), (CORNER_REACH_PX / 2, 5, 12.0), (6.0, 5, 6.0))

_MIN_EDGE = 0.05  # Of paper white: what the step from cells to paper must have to be taken for the outline

_REFINE_ALONG_PX = np.arange(-2.0, 2.1)
# Around a place of the edge: one cell inwards, and outwards not as far as marks in the margin begin.
_REFINE_ACROSS_PX = np.arange(-3.5, 2.1, 0.5)

# Rounds of the fit of a blurred step; each moves it by half a pixel at most, and three pixels are looked at.
_REFINE_STEPS = 6

_INTERPOLATION_PX = 0.4  # σ that linear interpolation adds to an edge

_REFINED_PX = 1.5  # How far from where it was taken to be an edge may be: beyond, the profile ends before the blur does

_CLEAR_EDGE = 0.15  # Of paper: a lower step from cells to margin does not give its place to a tenth of a pixel

# Of the run of a side beside a map: corners that curl by 6 px are followed to .1 px, marks in the margin along a
# twelfth of a side are not.
_RUN_ORDER = 8

# Cells whose colours are compared, chosen at random: a hundred for each parameter of the fit, at little cost.
_TRIED_CELLS = 1500

_Float = npt.NDArray[np.float32]
_Points = npt.NDArray[np.float64]
Corners = tuple[tuple[float, float], ...]


def paper_level(plane: Plane) -> float:
    """Return how bright the brightest parts of a plane are, counts above black: means of 4×4 pixels, 99.5th percentile.

    Means, so that a dark frame's noise is not taken for light.
    """
    height, width = plane.values.shape
    size = (max(1, width // 4), max(1, height // 4))
    return float(np.percentile(cv2.resize(plane.values, size, interpolation=cv2.INTER_AREA), 99.5))


@dataclass(frozen=True, eq=False)
class FoundField:
    """The field of cells in a picture.

    - `corners_px`: (4, 2) float64, its corners, clockwise from the printed top-left.
    - `homography`: (3, 3) float64, millimetres on the print to half-size px, lens distortion not included.
    - `outline_mm`, `outline_px`: (N, 2) float64, points of the outline on the print and where they are seen; they may
      be off along the outline.
    - `normals`: (N, 2) float64, directions across the outline, outwards, in which the places are measured.
    - `explained`: share of the cells' variation that the chart's colours explain, 0 … 1.
    """

    corners_px: _Points
    homography: npt.NDArray[np.float64]
    outline_mm: _Points
    outline_px: _Points
    normals: _Points
    explained: float

    def off_run_px(self, residual_px: _Points) -> _Points:
        """Return how far points of the outline lie from the smooth run of their side beside a map, (N,) float64 px.

        `residual_px` (N, 2) is how far they lie from the map.
        """
        across: _Points = (residual_px * self.normals).sum(axis=1)
        low, high = self.outline_mm.min(axis=0), self.outline_mm.max(axis=0)
        share: _Points = (self.outline_mm - low) / (high - low)
        off = np.abs(across)
        for axis in (0, 1):
            for end in (0.0, 1.0):
                of_side = np.abs(share[:, axis] - end) < 1e-6
                along: _Points = share[of_side, 1 - axis]
                if len(along) > 2 * _RUN_ORDER:
                    run, _ = robust_curve(along, across[of_side], _RUN_ORDER)
                    off[of_side] = np.abs(across[of_side] - np.polynomial.legendre.legval(2 * along - 1, run))
        return off


def field_mm(chart: Chart) -> _Points:
    """Return the corners of the field of cells, (4, 2) float64 mm, clockwise from its top-left."""
    half = np.array(chart.cell_mm) / 2
    left, top = chart.centres_mm.min(axis=0) - half
    right, bottom = chart.centres_mm.max(axis=0) + half
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


# The remedy of every message about a field of cells whose place is not known.
HOW_TO_GIVE_CORNERS = (
    "give the corners of its field of cells by --corners, for example --corners 297,90 4866,160 4805,3319 296,3326: "
    "x,y in pixels of the raw file as it is stored, clockwise from the corner that is printed top-left; read them off "
    "the ticks at the border of the picture that acquire check --picture saves, or in an image viewer"
)


def find_field(
    planes: Sequence[Plane],
    chart: Chart,
    what: str,
    corners_px: npt.ArrayLike | None = None,
    near_px: npt.ArrayLike | None = None,
) -> FoundField:
    """Return where the field of a chart's cells lies in a picture.

    `corners_px`: (4, 2) float half-size px, the field's corners if they are given by hand, clockwise from the printed
    top-left, to some 20 px; their order gives the orientation of the chart. `near_px`: (4, 2) float half-size px, the
    field's corners in another frame of the session, in the same order.
    """
    white = max(paper_level(plane) for plane in planes)
    if white < MIN_SIGNAL:
        raise RegistrationError(
            f"{what} is dark: its brightest parts are {max(white, 0.0):.0f} counts above black, at least "
            f"{MIN_SIGNAL:.0f} expected; switch the projector on, open its shutter, expose longer"
        )
    if near_px is not None:
        return _moved_field(planes, chart, np.asarray(near_px, dtype=np.float64), what)
    if corners_px is None:
        raise RegistrationError(
            f"{what}: the chart has no tags by which it is found, and no corners are given; {HOW_TO_GIVE_CORNERS}"
        )
    return _given_field(PreparedPicture.of(planes), chart, np.asarray(corners_px, dtype=np.float64), what)


def _moved_field(planes: Sequence[Plane], chart: Chart, near_px: _Points, what: str) -> FoundField:
    """Return the field near its corners (4, 2) half-size px in another frame."""
    picture = PreparedPicture.of(planes)
    outline = trace_outline(picture, near_px)
    if outline is not None:
        placed = _Placed.of(outline, chart, 0)
        explained = 1 - _misfit(picture, placed, chart)[1]
        if explained >= MIN_EXPLAINED:
            return placed.field(explained)
    raise RegistrationError(
        f"{what}: the field of cells was expected within {2 * CORNER_REACH_PX:.0f} pixels of {corners_text(near_px)}, "
        "where it lies in another frame, and it is not there; uncover the chart and light all of it, or, if it was "
        "moved, make a session of its own of the frames that follow"
    )


def _given_field(picture: PreparedPicture, chart: Chart, corners_px: _Points, what: str) -> FoundField:
    """Return the field whose corners (4, 2) half-size px are given by hand."""
    require_corners(corners_px, picture.shape)
    text = corners_text(corners_px)
    outline = trace_outline(picture, corners_px)
    if outline is None:
        raise RegistrationError(
            f"{what}: near the corners given, {text}, no edge is seen between cells and bare paper on all four sides; "
            "give the corners of the field of cells (not of the sheet) to some 40 pixels, and uncover its margin"
        )
    placings = [_Placed.of(outline, chart, turn) for turn in range(8)]
    misfits = [_misfit(picture, placed, chart) for placed in placings]
    explained = 1 - misfits[0][1]
    likely = int(np.argmin([misfit for misfit, _ in misfits]))
    other = likely > 0 and MIN_ADVANTAGE * misfits[likely][0] < misfits[0][0]
    if explained >= MIN_EXPLAINED and not other:
        return placings[0].field(explained)
    if 1 - misfits[likely][1] < MIN_EXPLAINED or not other:
        raise RegistrationError(
            f"{what}: within the corners given, {text}, the chart's colours explain {max(explained, 0):.0%} of the "
            f"brightness seen, at least {MIN_EXPLAINED:.0%} expected; give the corners of the field of cells (not of "
            "the sheet) clockwise from the printed top-left, and name the chart.json of this print"
        )
    if likely >= MIRRORED:
        raise RegistrationError(
            f"{what} is mirrored: within the corners given, {text}, the chart's colours fit only in a mirror; "
            "take the frame without a mirror, or print the chart unmirrored"
        )
    raise InputError(
        f"{what}: the corners given, {text}, do not begin at the printed top-left: the chart's colours fit if they are "
        f"{corners_text(np.roll(corners_px, -likely, axis=0))}; give them in this order"
    )


@dataclass(frozen=True, eq=False)
class _Placed:
    """The chart laid into an outline: printed corners and sides (top, right, bottom, left), each with its places.

    `sides_mm[k]` (N, 2) rise along x or y, `sides_px[k]` and `normals[k]` (N, 2) belong to them.
    """

    corners_mm: _Points
    corners_px: _Points
    homography: npt.NDArray[np.float64]
    sides_mm: tuple[_Points, ...]
    sides_px: tuple[_Points, ...]
    normals: tuple[_Points, ...]

    @classmethod
    def of(cls, outline: Outline, chart: Chart, turn: int) -> _Placed:
        """Return the chart laid into an outline in orientation `turn`: 0 … 3 quarter turns, 4 … 7 the same mirrored."""
        order = np.roll(np.arange(4), -turn)
        if turn >= MIRRORED:
            order = order[::-1]
        corners_mm, corners_px = field_mm(chart), outline.corners_px[order]
        homography = fit_homography(corners_mm, corners_px)
        if homography is None:
            homography = np.eye(3)
        back = np.asarray(np.linalg.inv(homography), dtype=np.float64)
        sides: list[tuple[_Points, _Points, _Points]] = []
        for printed in range(4):
            ends = {int(order[printed]), int(order[(printed + 1) % 4])}
            seen = next(k for k in range(4) if {k, (k + 1) % 4} == ends)
            along = printed % 2
            points = project(back, outline.sides_px[seen])
            points[:, 1 - along] = corners_mm[printed, 1 - along]
            rising = np.argsort(points[:, along])
            sides.append((points[rising], outline.sides_px[seen][rising], outline.normals[seen][rising]))
        mm, px, normals = zip(*sides, strict=True)
        return cls(corners_mm, corners_px, homography, mm, px, normals)

    def to_pixels(self, points_mm: _Points) -> _Points:
        """Return places (N, 2) of points (N, 2) of the field: the homography, and what the sides ask for, blended."""
        places = project(self.homography, points_mm)
        (left, top), (right, bottom) = self.corners_mm[0], self.corners_mm[2]
        share = (points_mm - (left, top)) / (right - left, bottom - top)
        weights = (1 - share[:, 1], share[:, 0], share[:, 1], 1 - share[:, 0])
        for printed, weight in enumerate(weights):
            along = printed % 2
            mm, normals = self.sides_mm[printed], self.normals[printed]
            off = self.sides_px[printed] - project(self.homography, mm)
            off = (off * normals).sum(axis=1, keepdims=True) * normals
            at, known = points_mm[:, along], mm[:, along]
            for axis in (0, 1):
                places[:, axis] += weight * np.interp(at, known, off[:, axis])
        return places

    def field(self, explained: float) -> FoundField:
        """Return the field that lies as the chart does here."""
        mm, px, normals = (np.concatenate(parts) for parts in (self.sides_mm, self.sides_px, self.normals))
        return FoundField(self.corners_px, self.homography, mm, px, normals, explained)


def _misfit(picture: PreparedPicture, placed: _Placed, chart: Chart) -> tuple[float, float]:
    """Return how badly the chart's colours fit what is seen, and the share of its variation that they leave, 0 … 1.

    The former is the product, over the colours that carry light, of what is left over what there was, in standard
    deviations. Logarithms of counts are fitted with a polynomial in the codes and one over the page, which is
    light; a colour that does not rise with its own code is not explained.
    """
    chosen = np.random.default_rng(1).permutation(chart.colour_count)[:_TRIED_CELLS]
    points = chart.centres_mm[chosen]
    places = placed.to_pixels(points)
    height, width = picture.shape
    inside = np.asarray(((places >= 0) & (places <= (width - 1, height - 1))).all(axis=1))
    if inside.mean() < 0.9:
        return 1.0, 1.0
    places, points = places[inside], points[inside]
    codes = chart.rgb[chosen[inside]] / 255.0
    page = 2 * points / chart.page_mm - 1
    light = np.column_stack([np.ones(len(page)), page, page**2, page[:, 0] * page[:, 1]])
    pairs = [(i, j) for i in range(3) for j in range(i, 3)] if chart.bits > 1 else []
    colour = np.column_stack([codes, *(codes[:, i] * codes[:, j] for i, j in pairs)])
    product = 1.0
    left: list[float] = []
    for channel, plane in zip(picture.channels, picture.planes, strict=True):
        x, y = (places - plane.offset_px).astype(np.float32).T
        seen = cv2.remap(plane.values, x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0].astype(np.float64)
        value = np.log(np.maximum(seen, 0.01 * float(np.median(np.abs(seen)) + 1e-9)))
        before, _ = _robust(light, value)
        after, solution = _robust(np.column_stack([light, colour]), value)
        slope = solution[len(light[0]) + channel]
        for number, (i, j) in enumerate(pairs):
            slope += solution[len(light[0]) + 3 + number] * (
                (i == channel) * codes[:, j].mean() + (j == channel) * codes[:, i].mean()
            )
        share = min(after / before, 1.0) if slope > 0 else 1.0
        product *= share
        left.append(share**2)
    return product, float(np.mean(left))


def _robust(design: _Points, values: npt.NDArray[np.float64]) -> tuple[float, npt.NDArray[np.float64]]:
    """Return the spread of what a linear fit leaves, and the fit; patches that are covered count for little."""
    weights = np.ones(len(values))
    terms = int(design.shape[1])
    solution, spread = np.zeros(terms), 1.0
    ridge = 1e-9 * len(values) * np.eye(terms)
    for _ in range(4):
        weighted = design * weights[:, None]
        # Summed by einsum: threads of a linear-algebra library cost more than they bring here.
        gram = np.einsum("ni,nj->ij", weighted, design) + ridge
        solution = np.asarray(np.linalg.solve(gram, np.einsum("ni,n->i", weighted, values)), dtype=np.float64)
        residual = np.abs(values - design @ solution)
        spread = robust_sigma(residual) + 1e-9
        weights = huber_weights(residual, spread)
    return spread, solution


def parse_corners(texts: Sequence[str]) -> Corners:
    """Return four corners (x, y), half-size px, of four texts X,Y in raw pixels."""
    if len(texts) != 4:
        raise InputError(
            f"{len(texts)} corners are given, {' '.join(texts)}; four are expected, X,Y each, in pixels of the raw file"
        )
    places: list[tuple[float, float]] = []
    for text in texts:
        try:
            x, y = (float(part) for part in text.split(","))
        except ValueError:
            x = y = math.nan
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"{text!r} is no corner; two numbers X,Y are expected, in pixels of the raw file")
        places.append(((x - 0.5) / 2, (y - 0.5) / 2))
    require_corners(np.array(places))
    return tuple(places)


def corners_text(corners_px: npt.ArrayLike) -> str:
    """Return corners (N, 2) float half-size px as a person gives them: "X,Y X,Y", whole raw pixels."""
    return " ".join(f"{2 * x + 0.5:.0f},{2 * y + 0.5:.0f}" for x, y in np.asarray(corners_px).reshape(-1, 2))


def require_corners(corners_px: _Points, shape: tuple[int, int] | None = None) -> None:
    """Require that corners can be those of a field of cells.

    `corners_px`: (4, 2) float64 half-size px, clockwise from the printed top-left. `shape`: height and width of the
    picture, half-size px, if it is known.
    """
    text = corners_text(corners_px)
    clockwise = "give four places X,Y, clockwise from the printed top-left corner of the field of cells"
    flat = corners_px.astype(np.float32)[:, None]
    if corners_px.shape != (4, 2) or not cv2.isContourConvex(flat) or cv2.contourArea(flat) < 1:
        raise InputError(f"the corners given, {text}, span no convex quadrilateral; {clockwise}")
    if cv2.contourArea(flat, oriented=True) < 0:
        raise InputError(
            f"the corners given, {text}, run counter-clockwise; {clockwise}, and take the frame without a mirror"
        )
    if shape is not None and ((corners_px < -0.5).any() or (corners_px > (shape[1] - 0.5, shape[0] - 0.5)).any()):
        raise InputError(
            f"the corners given, {text}, do not lie in the picture of {2 * shape[1]}×{2 * shape[0]} pixels; "
            "give pixels of the raw file as it is stored, not turned"
        )
    shortest = 2 * float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).min())
    if shortest < LEAST_SIDE_PX:
        raise InputError(
            f"the corners given, {text}, are too close together: {shortest:.0f} pixels, at least {LEAST_SIDE_PX} "
            "expected; give the corners of the whole field of cells"
        )


@dataclass(frozen=True, eq=False)
class PreparedPicture:
    """A picture in which the edge between cells and paper is looked for.

    - `planes`: the colours that carry light, slightly smoothed.
    - `channels`: which these are: 0, 1, 2.
    - `levels`: for each, how bright paper would be, on the small raster.
    - `bright`: for each, whether it carries enough light for its noise not to be taken for something darker than paper.
    - `shape`: height and width, half-size px.
    - `factor`: half-size pixels per element of the small raster.
    """

    planes: tuple[Plane, ...]
    channels: tuple[int, ...]
    levels: tuple[_Float, ...]
    bright: tuple[bool, ...]
    shape: tuple[int, int]
    factor: int

    @classmethod
    def of(cls, planes: Sequence[Plane]) -> PreparedPicture:
        """Return the planes of red, green and blue as the search for the edge needs them."""
        height, width = planes[0].values.shape
        factor = max(1, round(width / _SMALL_WIDTH_PX))
        size = (width // factor, height // factor)
        brightest = [paper_level(plane) for plane in planes]
        used = [k for k, level in enumerate(brightest) if level >= max(MIN_SIGNAL, _LEAST_LIGHT * max(brightest))]
        levels: list[_Float] = []
        for k in used:
            whole = planes[k].values[: size[1] * factor, : size[0] * factor]
            small = cv2.blur(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), (3, 3))
            # Somewhere near every place lies paper or a cell that is as bright in this colour.
            reach = size[0] // 5 | 1
            level = cv2.blur(cv2.dilate(small, np.ones((reach, reach), dtype=np.uint8)), (reach, reach))
            level = np.maximum(level, np.float32(0.2 * brightest[k])).astype(np.float32)
            levels.append(level)
        smooth = tuple(replace(planes[k], values=cv2.blur(planes[k].values, (3, 3)).astype(np.float32)) for k in used)
        bright = tuple(brightest[k] >= _MUCH_LIGHT * max(brightest) for k in used)
        return cls(smooth, tuple(used), tuple(levels), bright, (height, width), factor)

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


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed line through a picture: corners (4, 2) px clockwise as seen, and points on each of its four sides.

    `sides_px[k]` (N, 2) run from corner k to the next, `normals[k]` (N, 2) point outwards.
    """

    corners_px: _Points
    sides_px: tuple[_Points, ...]
    normals: tuple[_Points, ...]


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
    scale = max(robust_sigma(off - np.median(off)), 0.5)
    weights = 1 / np.maximum(np.abs(off - np.median(off)), scale)
    solution = np.zeros(order + 1)
    for _ in range(8):
        root = np.sqrt(weights)
        solution = np.linalg.lstsq(basis * root[:, None], off * root, rcond=None)[0]
        residual = np.abs(off - basis @ solution)
        scale = max(robust_sigma(residual), 0.15)
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
