"""A chart without tags in a picture: the field of its cells is found by its outline, and recognised by its colours.

Rules that hold inside:

- Candidates for the field come from the outlines in the picture (the field against its white margin, the sheet
  against what is behind), or from corners given by hand; each is drawn onto the edge between cells and paper, and the
  one whose cells have the chart's colours is the field. A rectangle of other colours is not.
- The orientation of the chart is decided by its colours: each candidate is tried in all four turns, and mirrored. Where
  the light does not distinguish turns (a single colour, on a chart whose order is the same both ways), it is an error.
- Faults of the picture are a `RegistrationError` that says what was looked for, what was found, and what helps.

Places are half-size pixels. Knows the chart and planes of counts; nothing of lenses, which bend the outline: an outline
is followed as it is, and `homography` is the straight one nearest to it.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from experiment.chart.model import Chart
from experiment.framing.corners import corners_text, require_corners
from experiment.framing.homography import fit_homography, project
from experiment.framing.outline import SAME_PX, Outline, PreparedPicture, robust_curve, same_corners, trace_outline
from experiment.framing.planes import MIN_SIGNAL, Plane, paper_level
from foundation.errors import InputError, RegistrationError
from foundation.robust import huber_weights, sigma_of

MIN_EXPLAINED = 0.5
"""Share of the cells' variation that the chart's colours must explain; another order of cells explains none."""

MIN_ADVANTAGE = 1.3
"""How many times better than the second best the best orientation must fit, in standard deviations of the residual."""

MIRRORED = 4
"""Of the eight orientations of a rectangle the first that is mirrored."""

_RUN_ORDER = 8
"""Of the run of a side beside a map: corners that curl by 6 px are followed to .1 px, marks in the margin along a
twelfth of a side are not."""

_TRIED_CELLS = 1500
"""Cells whose colours are compared, chosen at random: a hundred for each parameter of the fit, at little cost."""

_Float = npt.NDArray[np.float32]
_Points = npt.NDArray[np.float64]


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
    field's corners in another frame of the session, in the same order: they give the orientation, and the field may lie
    elsewhere.
    """
    white = max(paper_level(plane) for plane in planes)
    if white < MIN_SIGNAL:
        raise RegistrationError(
            f"{what} is dark: its brightest parts are {max(white, 0.0):.0f} counts above black, at least "
            f"{MIN_SIGNAL:.0f} expected; switch the projector on, open its shutter, expose longer"
        )
    picture = PreparedPicture.of(planes)
    looked_for = f"the field of {chart.colour_count} cells, a rectangle of colours on white paper,"
    if corners_px is not None:
        return _given_field(picture, chart, np.asarray(corners_px, dtype=np.float64), what)
    tries: list[tuple[float, float, int, _Placed]] = []
    outlines: list[Outline] = []
    for quad in picture.quads():
        for start in _starts(quad, chart):
            if any(same_corners(start, known.corners_px, SAME_PX) for known in outlines):
                continue
            outline = trace_outline(picture, start)
            if outline is None or any(
                same_corners(outline.corners_px, known.corners_px, SAME_PX) for known in outlines
            ):
                continue
            outlines.append(outline)
            for turn, placed in _orientations(outline, chart, near_px):
                tries.append((*_misfit(picture, placed, chart), turn, placed))
    if not tries:
        raise RegistrationError(
            f"{what}: {looked_for} was looked for, and no large rectangle was found; point the camera at the chart, "
            "light all of it, or give its corners by hand (--corners)"
        )
    tries.sort(key=lambda tried: tried[0])
    misfit, unexplained, turn, placed = tries[0]
    if 1 - unexplained < MIN_EXPLAINED:
        raise RegistrationError(
            f"{what}: {looked_for} was looked for, and the most similar rectangle has its corners at "
            f"{corners_text(placed.corners_px)}, but the chart's colours explain {max(1 - unexplained, 0):.0%} of "
            f"the brightness seen there, at least {MIN_EXPLAINED:.0%} expected; name the chart.json of this print, "
            "uncover it, or give its corners by hand (--corners)"
        )
    near = 0.05 * float(np.ptp(placed.corners_px, axis=0).max())
    rivals = [
        other[0]
        for other in tries
        if other[2] != turn and np.abs(other[3].corners_px.mean(axis=0) - placed.corners_px.mean(axis=0)).max() < near
    ]
    if min(rivals, default=1.0) < MIN_ADVANTAGE * misfit:
        raise RegistrationError(
            f"{what}: a field of cells has its corners at {corners_text(placed.corners_px)}, but under this light "
            "it is not certain which way up it hangs; take a white frame, or give its corners by hand (--corners), "
            "clockwise from the printed top-left"
        )
    if turn >= MIRRORED:
        raise RegistrationError(
            f"{what} is mirrored: the chart's colours fit only in a mirror; "
            "take the frame without a mirror, or print the chart unmirrored"
        )
    return placed.field(1 - unexplained)


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


def _orientations(outline: Outline, chart: Chart, near_px: npt.ArrayLike | None) -> list[tuple[int, _Placed]]:
    """Return the chart laid into an outline in all eight orientations, or in the one nearest to the corners (4, 2)."""
    placings = [(turn, _Placed.of(outline, chart, turn)) for turn in range(8)]
    if near_px is None:
        return placings
    near = np.asarray(near_px, dtype=np.float64)
    return [min(placings[:MIRRORED], key=lambda placing: float(np.abs(placing[1].corners_px - near).sum()))]


def _starts(quad: _Points, chart: Chart) -> Generator[_Points]:
    """Yield where the field's corners would be if a quadrilateral were the field, or the sheet lying either way."""
    yield quad
    width, height = chart.page_mm
    for turned in (0, 1):
        homography = fit_homography(
            np.array([(0, 0), (width, 0), (width, height), (0, height)], dtype=np.float64),
            np.roll(quad, turned, axis=0),
        )
        if homography is not None:
            yield np.roll(project(homography, field_mm(chart)), -turned, axis=0)


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
        spread = sigma_of(residual) + 1e-9
        weights = huber_weights(residual, spread)
    return spread, solution
