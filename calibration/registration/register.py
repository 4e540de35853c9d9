"""Where every point of the print lies in a frame: tags or the field's outline first, then the cells themselves.

Tags give a homography and Brown's distortion and nothing finer: 35 of them cannot sample a wavy sheet. A chart without
tags has the outline of its field for that, and is then followed from coarse to fine: a map that has slipped by a cell
is looked for. A registration that cannot be trusted is a `RegistrationError`, never a value.

Places are half-size pixels, pixel centres at integers; millimetres on the print.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from calibration.registration.colours import ColourModel, agreement, mismatched
from calibration.registration.geometry import Displacement, LateralColour, Lens, fit_lens
from calibration.registration.matching import Anchors, Blocks, Matcher, PlaceErrors, not_this_chart
from calibration.sampling import SAMPLE_REACH_PX, largest_blur_px
from drivers.raw.rawfile import CHANNELS, Channel, Mosaic, Plane, frame_black, plane_of
from experiment.chart.model import Chart
from experiment.framing.field import SIDE_POINTS, DetectedField, field_mm, refine_edges
from experiment.framing.finding import MIN_CELL_PX, ChartPose, find_chart
from experiment.framing.homography import rms
from experiment.framing.sharpness import blur_px
from foundation.errors import RegistrationError
from foundation.robust import robust_sigma

# What the place of a cell of 10 px may be off by, at most (`Registration.expanded_px`): at 0.5 px the outermost of
# its 25 pixels, rounding included, has 0.1 % of its light from the next cell at a blur of 0.7 px
# (`calibration.sampling`).
MAX_PLACE_ERROR_PX = 0.5

CLEARANCE_PX = 1.75  # From there to the edge of a cell of 10 px, for which the limits of places were found

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

# RMS of the tags against homography and distortion; 2.3 is a sheet that waves by 6 mm and curls by 10.
MAX_TAG_RESIDUAL_PX = 8.0

# Least correlation of the cells' colours with those predicted; another order of cells gives about 0.
MIN_AGREEMENT = 0.8

# The same for a chart without tags, whose smooth order a model of colours can follow into a cover; 0.99 is usual.
MIN_PLAIN_AGREEMENT = 0.95

MIN_GOOD_BLOCKS = 0.75  # Least share of the blocks of cells that look as the chart has them (judgement)

# RMS displacement that blocks may still need, for cells of 10 px: twice what the samples' reach allows for, and more
# than ten times what a sheet that waves by 3 mm leaves in simulated frames.
MAX_BLOCK_RESIDUAL_PX = 0.5

# Steps at most; each is the cost of a comparison of all cells. A flat print takes two or three, curled ones five.
_GAUSS_NEWTON_STEPS = 8

# Movements of a step below which there is none to follow: RMS, and of the cell that moves most. Half of either is
# left at most: the map's own error. A curled rim comes last, when the RMS shows nothing of it.
_SETTLED_PX, _SETTLED_CELL_PX = 0.015, 0.15

_TAG_SIGMA_PX = 0.15  # Standard error of a tag's corner: 0.085 px measured in white light, .20 in a weak one

_LEAST_TAG_SIGMA_PX = 0.03  # The same at best: what the detector leaves in the sharpest frames

_OUTLINE_SIGMA_PX = 0.1  # Standard error of a point of the outline, across it (judgement)

# Points of an outline further from its run than five of their standard deviations, and a pixel, are not of it.
_APART, _APART_PX = 5.0, 1.0

# Blur in cells of the steps that follow a chart without tags, before its cells are looked at.
_FOLLOWED_SOFTLY = (1.0, 1.0, 0.6)

# Number and share of a field's parts from which on it is refused: none looks slipped in any simulated room that is
# registered well.
_FEW_SLIPPED, _SLIPPED_SHARE = 2, 0.015


@dataclass(frozen=True, eq=False)
class Registration:
    """The chart's place in a frame.

    - `lens`, `displacement`: the two parts of the map of green.
    - `lateral`: where red and blue lie against it.
    - `marks_residual_px`: (N, 2) float64, the tags' corners against the final map; of a chart without tags the field's
      outline, across.
    - `lens_residual_px`: RMS of the same against the lens alone: what the paper's waviness leaves.
    - `mismatched_cells`: (N,) bool, cells in the chart's order whose colour is not nearly the model's: covered,
      damaged, misprinted.
    - `agreement`: correlation of the cells' colours with the model's, the mean of the channels that carry light.
    - `blur_px`: σ of the tags' edges, or of the field's.
    - `cell_px`: half-size pixels per cell, the shorter side of the smallest.
    - `shift_px`: movement since the frame that was registered, (dx, dy).
    """

    framing: ChartPose
    lens: Lens
    displacement: Displacement
    lateral: LateralColour
    marks_residual_px: _Array
    lens_residual_px: float
    blocks: Blocks
    place_errors: PlaceErrors
    colours: ColourModel
    mismatched_cells: _Mask
    agreement: float
    blur_px: float
    cell_px: float
    shift_px: tuple[float, float] = (0.0, 0.0)

    def to_pixels(self, points_mm: npt.ArrayLike, channel: Channel = "G") -> _Array:
        """Return the half-size pixels (N, 2) float64, x then y, where a channel sees points (N, 2) on the print.

        The lens shifts red and blue against green. Samples are taken where green is.
        """
        places = self.lens.to_pixels(points_mm) + self.displacement.at(points_mm) + self.shift_px
        return places + self.lateral.shift_px(places, channel)

    def uncertainty_px(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the standard error (N,) float64 px of the places of points (N, 2) on the print, in green."""
        return self.place_errors.at(points_mm)

    def expanded_px(self, points_mm: npt.ArrayLike) -> _Array:
        """Return what places (N, 2) may be off by, (N,) float64 px, as it matters to cells of 10 px.

        Two standard errors; three of a chart without tags, whose short waves its outline alone shows.
        """
        errors = 2 if self.framing.field is None else 3
        return errors * self.uncertainty_px(points_mm) / self.clearance

    @property
    def places_known_px(self) -> tuple[float, float]:
        """Standard error of places, px: the median over the field, and the largest of the outermost cells but 1 %."""
        error = self.place_errors.error_px
        rim = np.concatenate([error[1], error[-2], error[:, 1], error[:, -2]])
        return float(np.median(error)), float(np.percentile(rim, 99))

    def shifted(self, dx: float, dy: float) -> Registration:
        """Return this registration for a frame in which the chart lies (dx, dy) px further."""
        return replace(self, shift_px=(self.shift_px[0] + dx, self.shift_px[1] + dy))

    @property
    def marks_rms_px(self) -> float:
        """RMS distance of the tags' corners, or the field's outline, from the final map."""
        return rms(self.marks_residual_px)

    @property
    def block_rms_px(self) -> float:
        """RMS displacement that the good blocks would still need: the registration's own estimate of its error."""
        return rms(self.blocks.residual_px[self.blocks.good])

    @property
    def clearance(self) -> float:
        """How much further samples are from their cells' edges than in cells of 10 px, ≥ 1: places matter less by it.

        Cells of a hundred pixels are found to a pixel, which is nothing to them.
        """
        return max(1.0, (self.cell_px / 2 - SAMPLE_REACH_PX) / CLEARANCE_PX)


def register(
    mosaic: Mosaic,
    chart: Chart,
    what: str = "the frame",
    corners: npt.ArrayLike | None = None,
    near: Registration | None = None,
) -> Registration:
    """Return where the chart lies in a frame.

    About 5 s of one processor for the 32 768 cells on an 18-megapixel frame, three times that without tags.

    `corners`: for a chart without tags: (4, 2) float half-size px, the corners of the field of cells, clockwise from
    the printed top-left, to some 20 px. `near`: another frame of the session; a chart without tags lies near its place
    there, and needs no corners then.
    """
    black = frame_black(mosaic)
    framing = find_chart(mosaic, chart, what, corners, None if near is None else near.framing)
    blur = blur_px(framing)
    planes = [plane_of(mosaic, channel, black) for channel in CHANNELS]
    height, width = planes[0].values.shape
    lateral = LateralColour.unmeasured((width, height))
    if framing.field is None:
        marks = _tag_corners(framing, chart)
        lens, residual = fit_lens(marks.points_mm, marks.places_px.sum(axis=0), (width, height))
    else:
        field, _, lateral = _clear_edges(framing.field, planes, blur, lateral)
        # About places that are a pixel off an edge seems softer than it is, and a softer one is found further out.
        found_blur = blur_px(replace(framing, field=field))
        field, _, lens, _ = _field_through_lens(field, (width, height))
        field, marks, lateral = _clear_edges(_completed(field, lens, chart), planes, found_blur, lateral)
        field, fits, lens, residual = _field_through_lens(field, (width, height))
        framing, marks = replace(framing, field=field), marks.of(fits)
    lens_rms = rms(residual)
    if lens_rms > MAX_TAG_RESIDUAL_PX:
        raise RegistrationError(
            f"{what}: the {'tags' if chart.tags else 'edges of the field'} lie {lens_rms:.1f} px RMS off a plane seen "
            f"through a lens, {MAX_TAG_RESIDUAL_PX:g} allowed; hang the print flat, and see that it is this chart's"
        )
    if chart.tags:
        # Corners that the lens alone places better than usual are known as well as that; waves of a sheet hide it.
        marks = marks.known_to(float(np.clip(2 * lens_rms, _LEAST_TAG_SIGMA_PX, _TAG_SIGMA_PX)) / _TAG_SIGMA_PX)
    cell_px = _cell_px(lens, chart)
    _require_size_and_focus(cell_px, blur, what)
    matcher = Matcher(chart, planes, lens, marks, lateral, blur, cell_px)
    if chart.tags:
        matcher.match_coarsely(what)
    else:
        for softness in _FOLLOWED_SOFTLY:
            matcher.follow(softness)
            matcher.refit_lens()
    for _ in range(_GAUSS_NEWTON_STEPS):
        moved, furthest = matcher.step()
        if moved < _SETTLED_PX and furthest < _SETTLED_CELL_PX:
            break
    registration = _registered(chart, framing, matcher, marks, lens_rms)
    _judge(registration, MIN_AGREEMENT if chart.tags else MIN_PLAIN_AGREEMENT, what)
    if not chart.tags:
        _require_own_cells(matcher, registration.mismatched_cells, what)
    return registration


def _tag_corners(framing: ChartPose, chart: Chart) -> Anchors:
    tags = {tag.id: tag for tag in chart.tags}
    corners_mm = np.concatenate([tags[tag.id].corners_mm for tag in framing.tags])
    corners_px = np.concatenate([tag.corners_px for tag in framing.tags])
    own = (np.array(CHANNELS) == framing.plane.channel).astype(np.float64)
    known = np.broadcast_to(np.eye(2) / _TAG_SIGMA_PX**2, (len(corners_mm), 2, 2))
    return Anchors(corners_mm, own[:, None, None] * corners_px, own[:, None, None, None] * known)


def _clear_edges(
    field: DetectedField, planes: list[Plane], blur: float, lateral: LateralColour
) -> tuple[DetectedField, Anchors, LateralColour]:
    """Return the field with its outline where green sees it, as it is seen channel by channel, and what lies between.

    Points that are clear in no channel are left out.
    """
    places, heights = refine_edges(planes, field.outline_px, field.normals, blur)
    clear = np.asarray(heights.any(axis=0))
    places, heights, normals = places[:, clear], heights[:, clear], field.normals[clear]
    # A step half as high is found half as well. All channels together are no surer than one: it is the same edge.
    share = heights**2 / (heights**2).sum(axis=0)
    across = np.einsum("ni,nj->nij", normals, normals) / _OUTLINE_SIGMA_PX**2
    marks = Anchors(field.outline_mm[clear], places, share[..., None, None] * across)
    rough = field.outline_px[clear]
    lateral = lateral.remeasured(rough, marks.information, marks.pull(lateral.seen_px(rough)))
    green = rough + marks.residual_px(lateral.seen_px(rough))
    return replace(field, outline_mm=marks.points_mm, outline_px=green, normals=normals), marks, lateral


def _completed(field: DetectedField, lens: Lens, chart: Chart) -> DetectedField:
    """Return the field with points of its outline also where none was found, at the places that the lens gives them.

    Beside pale cells the outline is traced one cell inwards, or not at all; one colour may show it.
    """
    corners = field_mm(chart)
    share = (np.arange(SIDE_POINTS) + 0.5)[:, None] / SIDE_POINTS
    sides: list[tuple[_Array, _Array, _Array]] = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        points, along = start + share * (end - start), (end - start) / SIDE_POINTS
        far = cKDTree(field.outline_mm).query(points)[0] > 2 * np.linalg.norm(along)
        points = points[far]
        inwards = lens.to_pixels(points + (corners.mean(axis=0) - points) / SIDE_POINTS) - lens.to_pixels(points)
        tangents = lens.to_pixels(points + along) - lens.to_pixels(points - along)
        normals = np.stack([tangents[:, 1], -tangents[:, 0]], axis=-1) / np.linalg.norm(tangents, axis=1, keepdims=True)
        normals *= -np.sign((normals * inwards).sum(axis=1, keepdims=True))
        sides.append((points, lens.to_pixels(points), normals))
    points, places, normals = (
        np.concatenate([known, *parts])
        for known, parts in zip(
            (field.outline_mm, field.outline_px, field.normals), zip(*sides, strict=True), strict=True
        )
    )
    return replace(field, outline_mm=points, outline_px=places, normals=normals)


def _field_through_lens(field: DetectedField, frame_size: tuple[int, int]) -> tuple[DetectedField, _Mask, Lens, _Array]:
    """Return the field without outlying points of its outline, which are marks in the margin.

    A sheet's curled corners lie pixels off a plane seen through a lens, and have neighbours that do: points are held
    against the run of their side.

    Returns the field; which of its points are left, (N,) bool; its lens; residuals of the points left, (M, 2) float64
    px.
    """
    kept = np.ones(len(field.outline_mm), dtype=np.bool_)
    lens, residual = fit_lens(field.outline_mm, field.outline_px, frame_size, field.normals)
    for _ in range(2):
        size = field.curve_residual_px(residual)
        fits = size <= max(_APART * robust_sigma(size), _APART_PX)
        kept[kept] = fits
        field = replace(
            field,
            outline_mm=field.outline_mm[fits],
            outline_px=field.outline_px[fits],
            normals=field.normals[fits],
        )
        lens, residual = fit_lens(field.outline_mm, field.outline_px, frame_size, field.normals)
    return field, kept, lens, residual


def _require_own_cells(matcher: Matcher, mismatched_cells: _Mask, what: str) -> None:
    places, parts = matcher.slipped(mismatched_cells)
    if len(places) >= max(_FEW_SLIPPED, _SLIPPED_SHARE * parts):
        x, y = places[0]
        raise RegistrationError(
            f"{what}: {len(places)} of {parts} parts of the field have the colours of the cells beside them, the "
            f"first at about {x:.0f}, {y:.0f} mm from the sheet's top-left corner; uncover the print, hang it flatter, "
            "and see that chart.json has its cells where they are printed"
        )


def _cell_px(lens: Lens, chart: Chart) -> float:
    half = np.array(chart.cell_mm) / 2
    across = [lens.to_pixels(chart.centres_mm + half * sign) for sign in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    sides = [np.linalg.norm(across[1] - across[0], axis=1), np.linalg.norm(across[3] - across[2], axis=1)]
    return float(min(side.min() for side in sides))


def _require_size_and_focus(cell_px: float, blur: float, what: str) -> None:
    if cell_px < MIN_CELL_PX:
        raise RegistrationError(
            f"{what}: a cell is {cell_px:.1f} px wide, at least {MIN_CELL_PX:g} expected for 25 pixels inside it; "
            "bring the camera nearer"
        )
    allowed = largest_blur_px(cell_px)
    if not blur <= allowed:
        raise RegistrationError(
            f"{what} is out of focus: edges are blurred by σ = {blur:.2f} px, at most {allowed:.2f} allowed for cells "
            f"of {cell_px:.1f} px; focus on the print, stop down, and keep the camera still"
        )


def _registered(chart: Chart, framing: ChartPose, matcher: Matcher, marks: Anchors, lens_rms: float) -> Registration:
    seen, expected, paper = matcher.patches()
    there = np.asarray(np.isfinite(seen).all(axis=1))
    residual = marks.residual_px(matcher.in_channels(marks.points_mm))
    mismatched_cells = mismatched(seen, expected, paper, chart)
    blocks = matcher.blocks()
    if not chart.tags:
        there[: chart.colour_count] &= ~mismatched_cells
        blocks = _without_mismatched_cells(blocks, mismatched_cells, chart)
    return Registration(
        framing=framing,
        lens=matcher.lens,
        displacement=matcher.displacement,
        lateral=matcher.lateral,
        marks_residual_px=residual,
        lens_residual_px=lens_rms,
        blocks=blocks,
        place_errors=matcher.place_errors(),
        colours=matcher.colours,
        mismatched_cells=mismatched_cells,
        agreement=agreement(seen[there], expected[there]),
        blur_px=matcher.blur_px,
        cell_px=matcher.cell_px,
    )


def _without_mismatched_cells(blocks: Blocks, mismatched_cells: _Mask, chart: Chart) -> Blocks:
    """Return blocks whose score sinks with their share of mismatched cells.

    In a smooth order of colours neighbouring cells look alike through a wide window, covered or not.
    """
    block = np.asarray(cKDTree(blocks.centres_mm).query(chart.centres_mm)[1])
    cells = np.maximum(np.bincount(block, minlength=len(blocks.score)), 1)
    share = np.bincount(block, mismatched_cells, minlength=len(blocks.score)) / cells
    return replace(blocks, score=blocks.score * (1 - share))


def _judge(registration: Registration, least_agreement: float, what: str) -> None:
    blocks = registration.blocks
    if registration.agreement < least_agreement:
        raise not_this_chart(
            what, f"they correlate by {registration.agreement:.2f} with those expected, {least_agreement:g} needed"
        )
    share = float(blocks.good.mean())
    if share < MIN_GOOD_BLOCKS:
        raise not_this_chart(
            what,
            f"{share:.0%} of the blocks of cells look as the chart has them, at least {MIN_GOOD_BLOCKS:.0%} needed",
        )
    allowed = MAX_BLOCK_RESIDUAL_PX * registration.clearance
    if registration.block_rms_px > allowed:
        raise RegistrationError(
            f"{what}: the residual of the blocks of cells is {registration.block_rms_px:.2f} px RMS, at most "
            f"{allowed:.2g} allowed; hang the print flatter"
        )
