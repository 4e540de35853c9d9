"""Register the chart in a frame: calculate the position of every point of the print.

First, a homography and Brown's lens distortion are fitted to the tags, or to the outline of the patch area. Then a
smooth displacement is fitted to all patches, because 35 tags cannot describe a wavy sheet. `register` returns a
`Registration`, or raises `RegistrationError` if the quality is too low.

Positions are half-size pixels with pixel centres at integers; points on the print are millimetres.
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

# Largest allowed expanded uncertainty of a position, in px, for patches of 10 px (`Registration.expanded_px`). With
# this error and usual blur, the outermost sample receives 0.1 % of its light from the next patch.
MAX_PLACE_ERROR_PX = 0.5

# Distance between the outermost sample and the edge of a patch 10 px wide, in px. Position limits apply to this size.
CLEARANCE_PX = 1.75

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

# Largest RMS residual of the tags or the outline after the lens fit. A sheet with waves of 6 mm and a curl of 10 mm
# gives 2.3 px.
MAX_TAG_RESIDUAL_PX = 8.0

# Minimum correlation of measured and predicted patch colours. A chart with another order of patches gives about 0.
MIN_AGREEMENT = 0.8

# Minimum correlation for a chart without tags; 0.99 is usual. Neighbouring patches of such a chart have similar
# colours, so the colour model can partly fit even an object in front of the chart.
MIN_PLAIN_AGREEMENT = 0.95

MIN_GOOD_BLOCKS = 0.75  # Minimum share of blocks of patches that match the chart; chosen by judgement

# Largest RMS residual of the blocks, for patches of 10 px. Waves of 3 mm give less than a tenth of it in simulation.
MAX_BLOCK_RESIDUAL_PX = 0.5

# Maximum number of Gauss-Newton steps. A flat print needs two or three steps, a curled print five.
_GAUSS_NEWTON_STEPS = 8

# The iteration ends if the RMS and the largest movement of a step are both below these limits. The second limit is for
# a curled rim, which converges last and hardly changes the RMS.
_CONVERGED_RMS_PX, _CONVERGED_MAX_PX = 0.015, 0.15

# Standard uncertainty of a tag corner. Measured: 0.085 px under white, 0.20 px under a dim illuminant.
_TAG_SIGMA_PX = 0.15

_MIN_TAG_SIGMA_PX = 0.03  # Standard uncertainty of a tag corner in the sharpest frames

_OUTLINE_SIGMA_PX = 0.1  # Standard uncertainty of an outline point, across the outline; chosen by judgement

# An outline point is an outlier if it is further from the curve of its side than both limits.
_OUTLIER_SIGMAS, _OUTLIER_PX = 5.0, 1.0

# Blur of the first steps for a chart without tags, in patch widths, from coarse to fine.
_COARSE_BLURS = (1.0, 1.0, 0.6)

# The frame is refused if at least this number and at least this share of the tested areas appear to be displaced by
# one patch.
_MIN_DISPLACED_AREAS, _MIN_DISPLACED_SHARE = 2, 0.015


@dataclass(frozen=True, eq=False)
class Registration:
    """Position of the chart in one frame."""

    framing: ChartPose  # chart pose from tags or outline
    lens: Lens  # homography and lens distortion of the green channel
    displacement: Displacement  # smooth correction of `lens` for a sheet that is not flat
    lateral: LateralColour  # shifts of red and blue against green
    # (N, 2) distance of the tag corners from the final map; without tags, distance of the outline points
    marks_residual_px: _Array
    lens_residual_px: float  # RMS distance of the tag corners or outline points from `lens` alone
    blocks: Blocks  # match and residual of each block of patches
    place_errors: PlaceErrors  # standard uncertainty of positions
    colours: ColourModel  # camera RGB of the printed codes in this frame
    # (N,) patches with a colour far from `colours`, in chart order: covered, damaged or misprinted
    mismatched_cells: _Mask
    agreement: float  # correlation of patch colours with `colours`, −1 … 1; mean of the channels that receive light
    blur_px: float  # standard deviation of the blur at the edges of the tags or of the patch area
    cell_px: float  # shorter side of the smallest patch, half-size px
    shift_px: tuple[float, float] = (0.0, 0.0)  # movement (dx, dy) of the chart since the registered frame

    def to_pixels(self, points_mm: npt.ArrayLike, channel: Channel = "G") -> _Array:
        """Map points on the print to the frame.

        Parameters
        ----------
        points_mm : (N, 2) float
        channel : {"R", "G", "B"}
            Lateral colour of the lens shifts red and blue against green. Samples are taken at the positions of green.

        Returns
        -------
        (N, 2) float64
            x and y in half-size px.
        """
        positions_px = self.lens.to_pixels(points_mm) + self.displacement.at(points_mm) + self.shift_px
        return positions_px + self.lateral.shift_px(positions_px, channel)

    def uncertainty_px(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the standard uncertainty (N,) float64, px, of the green positions of points (N, 2) mm."""
        return self.place_errors.at(points_mm)

    def expanded_px(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the expanded uncertainty (N,) float64, px, of points (N, 2) mm, scaled to patches of 10 px.

        The coverage factor is 2 with tags. It is 3 without tags, because only the outline shows short waves of the
        sheet.
        """
        coverage_factor = 2 if self.framing.field is None else 3
        return coverage_factor * self.uncertainty_px(points_mm) / self.clearance

    @property
    def position_uncertainty_px(self) -> tuple[float, float]:
        """Standard uncertainty of positions, px: median of all, 99th percentile of the outermost patches."""
        error = self.place_errors.error_px
        rim = np.concatenate([error[1], error[-2], error[:, 1], error[:, -2]])
        return float(np.median(error)), float(np.percentile(rim, 99))

    def shifted(self, dx: float, dy: float) -> Registration:
        """Return this registration for a frame in which the chart has moved by (dx, dy) px."""
        return replace(self, shift_px=(self.shift_px[0] + dx, self.shift_px[1] + dy))

    @property
    def marks_rms_px(self) -> float:
        """RMS distance, px, of the tag corners or outline points from the final map."""
        return rms(self.marks_residual_px)

    @property
    def block_rms_px(self) -> float:
        """RMS residual, px, of the blocks that match the chart: an estimate of the registration error."""
        return rms(self.blocks.residual_px[self.blocks.good])

    @property
    def clearance(self) -> float:
        """Distance of the samples from the patch edges, divided by this distance in a patch of 10 px; at least 1.

        Limits for positions are multiplied by it, because large patches tolerate larger position errors.
        """
        return max(1.0, (self.cell_px / 2 - SAMPLE_REACH_PX) / CLEARANCE_PX)


def register(
    mosaic: Mosaic,
    chart: Chart,
    frame_name: str = "the frame",
    corners: npt.ArrayLike | None = None,
    neighbour: Registration | None = None,
) -> Registration:
    """Register the chart in a frame.

    Parameters
    ----------
    mosaic : Mosaic
        Raw frame.
    chart : Chart
    frame_name : str
        Name of the frame in error messages.
    corners : (4, 2) float, optional
        For a chart without tags: corners of the patch area in half-size px, clockwise from the printed top left,
        accurate to 20 px.
    neighbour : Registration, optional
        Registration of another frame of the session. A chart without tags is searched near its position in that
        frame; corners are then not needed.

    Raises
    ------
    RegistrationError
        If the chart is not detected, blurred, too small, not flat, or another chart.
    """
    black = frame_black(mosaic)
    framing = find_chart(mosaic, chart, frame_name, corners, None if neighbour is None else neighbour.framing)
    blur = blur_px(framing)
    planes = [plane_of(mosaic, channel, black) for channel in CHANNELS]
    height, width = planes[0].values.shape
    lateral = LateralColour.unmeasured((width, height))
    if framing.field is None:
        marks = _tag_corners(framing, chart)
        lens, residual = fit_lens(marks.points_mm, marks.positions_px.sum(axis=0), (width, height))
    else:
        field, _, lateral = _refine_outline(framing.field, planes, blur, lateral)
        # The blur is measured again at the refined edges. A blur measured one pixel beside an edge is too large, and
        # would shift the edges outwards.
        refined_blur = blur_px(replace(framing, field=field))
        field, _, lens, _ = _fit_outline(field, (width, height))
        field, marks, lateral = _refine_outline(_add_missing_outline(field, lens, chart), planes, refined_blur, lateral)
        field, is_inlier, lens, residual = _fit_outline(field, (width, height))
        framing, marks = replace(framing, field=field), marks.select(is_inlier)
    lens_rms = rms(residual)
    if lens_rms > MAX_TAG_RESIDUAL_PX:
        raise RegistrationError(
            f"{frame_name}: the {'tags' if chart.tags else 'edges of the patch area'} deviate by {lens_rms:.1f} px RMS "
            f"from a plane, expected at most {MAX_TAG_RESIDUAL_PX:g} px; hang the print flat, and check that "
            "chart.json matches it"
        )
    if chart.tags:
        # A small residual shows that the tag corners are more precise than usual.
        marks = marks.with_errors_scaled(float(np.clip(2 * lens_rms, _MIN_TAG_SIGMA_PX, _TAG_SIGMA_PX)) / _TAG_SIGMA_PX)
    cell_px = _shortest_cell_side_px(lens, chart)
    _require_size_and_focus(cell_px, blur, frame_name)
    matcher = Matcher(chart, planes, lens, marks, lateral, blur, cell_px)
    if chart.tags:
        matcher.match_coarsely(frame_name)
    else:
        for blur_cells in _COARSE_BLURS:
            matcher.step_blurred(blur_cells)
            matcher.refit_lens()
    for _ in range(_GAUSS_NEWTON_STEPS):
        rms_step_px, largest_step_px = matcher.step()
        if rms_step_px < _CONVERGED_RMS_PX and largest_step_px < _CONVERGED_MAX_PX:
            break
    registration = _registration(chart, framing, matcher, marks, lens_rms)
    _require_match(registration, MIN_AGREEMENT if chart.tags else MIN_PLAIN_AGREEMENT, frame_name)
    if not chart.tags:
        _refuse_displaced_areas(matcher, registration.mismatched_cells, frame_name)
    return registration


def _tag_corners(framing: ChartPose, chart: Chart) -> Anchors:
    tags = {tag.id: tag for tag in chart.tags}
    corners_mm = np.concatenate([tags[tag.id].corners_mm for tag in framing.tags])
    corners_px = np.concatenate([tag.corners_px for tag in framing.tags])
    in_channel = (np.array(CHANNELS) == framing.plane.channel).astype(np.float64)
    information = np.broadcast_to(np.eye(2) / _TAG_SIGMA_PX**2, (len(corners_mm), 2, 2))
    return Anchors(corners_mm, in_channel[:, None, None] * corners_px, in_channel[:, None, None, None] * information)


def _refine_outline(
    field: DetectedField, planes: list[Plane], blur: float, lateral: LateralColour
) -> tuple[DetectedField, Anchors, LateralColour]:
    """Return the patch area with a refined outline, the outline points in each channel, and the lateral colour."""
    edges_px, heights = refine_edges(planes, field.outline_px, field.normals, blur)
    # Points without a clear edge in any channel are dropped.
    is_clear = np.asarray(heights.any(axis=0))
    edges_px, heights, normals = edges_px[:, is_clear], heights[:, is_clear], field.normals[is_clear]
    # The error of an edge is inversely proportional to its step height. The weights add up to 1, because the channels
    # show the same edge and are not independent.
    weight = heights**2 / (heights**2).sum(axis=0)
    information_across = np.einsum("ni,nj->nij", normals, normals) / _OUTLINE_SIGMA_PX**2
    marks = Anchors(field.outline_mm[is_clear], edges_px, weight[..., None, None] * information_across)
    initial_px = field.outline_px[is_clear]
    lateral = lateral.remeasured(initial_px, marks.information, marks.pull(lateral.channels_px(initial_px)))
    green = initial_px + marks.residual_px(lateral.channels_px(initial_px))
    return replace(field, outline_mm=marks.points_mm, outline_px=green, normals=normals), marks, lateral


def _add_missing_outline(field: DetectedField, lens: Lens, chart: Chart) -> DetectedField:
    """Add the missing points of the outline, at the positions that the lens predicts."""
    # Next to pale patches, the outline is not detected or is one patch too far inside. The refinement may still find
    # the edge there in one channel.
    corners = field_mm(chart)
    share = (np.arange(SIDE_POINTS) + 0.5)[:, None] / SIDE_POINTS
    sides: list[tuple[_Array, _Array, _Array]] = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        points, step = start + share * (end - start), (end - start) / SIDE_POINTS
        is_missing = cKDTree(field.outline_mm).query(points)[0] > 2 * np.linalg.norm(step)
        points = points[is_missing]
        inwards = lens.to_pixels(points + (corners.mean(axis=0) - points) / SIDE_POINTS) - lens.to_pixels(points)
        tangents = lens.to_pixels(points + step) - lens.to_pixels(points - step)
        normals = np.stack([tangents[:, 1], -tangents[:, 0]], axis=-1) / np.linalg.norm(tangents, axis=1, keepdims=True)
        normals *= -np.sign((normals * inwards).sum(axis=1, keepdims=True))
        sides.append((points, lens.to_pixels(points), normals))
    points, places, normals = (
        np.concatenate([traced, *added])
        for traced, added in zip(
            (field.outline_mm, field.outline_px, field.normals), zip(*sides, strict=True), strict=True
        )
    )
    return replace(field, outline_mm=points, outline_px=places, normals=normals)


def _fit_outline(field: DetectedField, frame_size: tuple[int, int]) -> tuple[DetectedField, _Mask, Lens, _Array]:
    # Outliers are pins, text or lines in the margin of the sheet.
    is_kept = np.ones(len(field.outline_mm), dtype=np.bool_)
    lens, residual = fit_lens(field.outline_mm, field.outline_px, frame_size, field.normals)
    for _ in range(2):
        # Curled corners deviate from the lens by several px, so points are compared with the curve of their side.
        distance_px = field.curve_residual_px(residual)
        is_inlier = distance_px <= max(_OUTLIER_SIGMAS * robust_sigma(distance_px), _OUTLIER_PX)
        is_kept[is_kept] = is_inlier
        field = replace(
            field,
            outline_mm=field.outline_mm[is_inlier],
            outline_px=field.outline_px[is_inlier],
            normals=field.normals[is_inlier],
        )
        lens, residual = fit_lens(field.outline_mm, field.outline_px, frame_size, field.normals)
    return field, is_kept, lens, residual


def _refuse_displaced_areas(matcher: Matcher, mismatched_cells: _Mask, frame_name: str) -> None:
    displaced_mm, area_count = matcher.find_displaced_areas(mismatched_cells)
    if len(displaced_mm) >= max(_MIN_DISPLACED_AREAS, _MIN_DISPLACED_SHARE * area_count):
        x, y = displaced_mm[0]
        raise RegistrationError(
            f"{frame_name}: {len(displaced_mm)} of {area_count} areas of the chart have the colours of the "
            f"neighbouring patches, the first near ({x:.0f}, {y:.0f}) mm from the top-left corner of the sheet; "
            "uncover the print, hang it flatter, and check that chart.json describes the printed positions"
        )


def _shortest_cell_side_px(lens: Lens, chart: Chart) -> float:
    half = np.array(chart.cell_mm) / 2
    across = [lens.to_pixels(chart.centres_mm + half * sign) for sign in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    sides = [np.linalg.norm(across[1] - across[0], axis=1), np.linalg.norm(across[3] - across[2], axis=1)]
    return float(min(side.min() for side in sides))


def _require_size_and_focus(cell_px: float, blur: float, frame_name: str) -> None:
    if cell_px < MIN_CELL_PX:
        raise RegistrationError(
            f"{frame_name}: a patch is {cell_px:.1f} px wide, expected at least {MIN_CELL_PX:g} px for its 25 samples; "
            "move the camera closer"
        )
    limit = largest_blur_px(cell_px)
    if not blur <= limit:
        raise RegistrationError(
            f"{frame_name} is out of focus: the blur of edges is σ = {blur:.2f} px, expected at most {limit:.2f} px "
            "for patches "
            f"of {cell_px:.1f} px; focus on the print, use a smaller aperture, and avoid movement of the camera"
        )


def _registration(chart: Chart, framing: ChartPose, matcher: Matcher, marks: Anchors, lens_rms: float) -> Registration:
    measured, expected, paper = matcher.patches()
    is_inside = np.asarray(np.isfinite(measured).all(axis=1))
    residual = marks.residual_px(matcher.in_channels(marks.points_mm))
    mismatched_cells = mismatched(measured, expected, paper, chart)
    blocks = matcher.blocks()
    if not chart.tags:
        is_inside[: chart.colour_count] &= ~mismatched_cells
        blocks = _reduce_scores_of_mismatched(blocks, mismatched_cells, chart)
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
        agreement=agreement(measured[is_inside], expected[is_inside]),
        blur_px=matcher.blur_px,
        cell_px=matcher.cell_px,
    )


def _reduce_scores_of_mismatched(blocks: Blocks, mismatched_cells: _Mask, chart: Chart) -> Blocks:
    # On a chart without tags, neighbouring patches have similar colours. The score of a wide window therefore stays
    # high if patches are covered.
    block_of_cell = np.asarray(cKDTree(blocks.centres_mm).query(chart.centres_mm)[1])
    cell_count = np.maximum(np.bincount(block_of_cell, minlength=len(blocks.score)), 1)
    mismatched_share = np.bincount(block_of_cell, mismatched_cells, minlength=len(blocks.score)) / cell_count
    return replace(blocks, score=blocks.score * (1 - mismatched_share))


def _require_match(registration: Registration, minimum_agreement: float, frame_name: str) -> None:
    blocks = registration.blocks
    if registration.agreement < minimum_agreement:
        raise not_this_chart(
            frame_name, f"their correlation is {registration.agreement:.2f}, expected at least {minimum_agreement:g}"
        )
    good_share = float(blocks.good.mean())
    if good_share < MIN_GOOD_BLOCKS:
        raise not_this_chart(
            frame_name,
            f"{good_share:.0%} of the blocks of patches match the chart, expected at least {MIN_GOOD_BLOCKS:.0%}",
        )
    limit = MAX_BLOCK_RESIDUAL_PX * registration.clearance
    if registration.block_rms_px > limit:
        raise RegistrationError(
            f"{frame_name}: the residual of the blocks of patches is {registration.block_rms_px:.2f} px RMS, expected "
            f"at most {limit:.2g} px; hang the print flatter"
        )
