"""Lens and camera: sharp all over, straight, near enough.

The blur of every tag's edges is a map; a chart without tags has one of its field's outline.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from acquisition.check.findings import LIMITS, Finding, Grade, amount, judged, not_checked, percent, worst
from acquisition.check.light import AREAS, area_name
from acquisition.check.places import ChartMap
from calibration.sampling import bleed, largest_blur_px
from experiment.chart.model import Chart
from experiment.framing.finding import Framing
from experiment.framing.homography import project
from experiment.framing.sharpness import edge_blurs
from experiment.framing.tags import MIN_MODULE_PX

USUAL_FOCAL_DIAGONALS = 1.3
"""Focal length over the frame's diagonal where the file states none: 35 mm on APS-C (chosen)."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BlurMap:
    """How soft the picture is from place to place: `points_mm` (N, 2) on the print, `sigma_px` (N,) half-size px."""

    points_mm: _Array
    sigma_px: _Array


def measure_blur(framing: Framing) -> BlurMap:
    """Return the blur of every tag (median of its edges), or of places along the outline of a field without tags."""
    places, sigma = edge_blurs(framing)
    back = np.asarray(np.linalg.inv(framing.homography), dtype=np.float64)
    return BlurMap(project(back, places), sigma)


def judge_sharpness(blur: BlurMap, chart: Chart, module_px: float, cell_px: float) -> Finding:
    """Return the finding on sharpness: the worst area of the chart counts, for a fault the median of all places.

    `module_px`: of the tags, half-size px; too small ones are not looked at. `cell_px`: shorter side of the smallest
    cell, half-size px.
    """
    if module_px < MIN_MODULE_PX:
        return not_checked(
            "sharpness", f"a tag module is {module_px:.1f} px wide, {MIN_MODULE_PX:g} needed to see its edges",
            "bring the camera nearer",
        )  # fmt: skip
    if not len(blur.sigma_px):
        return not_checked("sharpness", "no printed edge lies whole in the picture", "bring the chart into the picture")
    rows, columns = AREAS
    at = np.clip(blur.points_mm / chart.page_mm, 0, 1 - 1e-9)
    area = (at[:, 1] * rows).astype(int) * columns + (at[:, 0] * columns).astype(int)
    found = {int(number): float(np.median(blur.sigma_px[area == number])) for number in np.unique(area)}
    softest, sharpest = max(found, key=lambda each: found[each]), min(found, key=lambda each: found[each])
    names = {number: area_name(number // columns, number % columns) for number in found}
    middle = float(np.median(blur.sigma_px))
    worst_bleed, usual_bleed = (bleed(cell_px, sigma) for sigma in (found[softest], middle))
    aside = found[softest] - found[sharpest] > 0.25
    remedy = (
        f"turn the camera so that the sensor is parallel to the print ({names[softest]} is farther out of focus), stop "
        "down to f/8"
        if aside
        else "focus the lens by hand on a magnified live view, stop down to f/8, and see that nothing shakes the camera"
    )
    limit = LIMITS["sharpness"]
    judgement = judged(
        limit,
        worst_bleed,
        f"blur σ {found[softest]:.2f} px at {names[softest]}, {found[sharpest]:.2f} px at {names[sharpest]}, "
        f"{middle:.2f} px on the whole, so that the worst sample of a cell of {cell_px:.1f} px has "
        f"{percent(worst_bleed)} of its neighbours' light there and {percent(usual_bleed)} on the whole",
        remedy,
        {"areas_px": {names[number]: sigma for number, sigma in found.items()}, "median_px": middle,
         "cell_px": cell_px, "median_bleed": usual_bleed},
    )  # fmt: skip
    # A table is judged by the median; one soft corner is worth a remark.
    refused = limit.grade(usual_bleed) == "fault" or middle > largest_blur_px(cell_px)
    grade: Grade = "fault" if refused else "remark" if judgement.grade == "fault" else judgement.grade
    if refused and judgement.grade == "good":
        most = largest_blur_px(cell_px)
        why = f"at most σ {most:.2f} px wanted: build-lut does not find cells so soft to parts of a pixel"
        return replace(judgement, grade=grade, reason=why, remedy=remedy)
    return replace(judgement, grade=grade)


def judge_turn(framing: Framing) -> Finding:
    """Return the finding on how the chart is turned in the picture; quarter turns are named and do no harm."""
    turned = (framing.rotation_deg + 180) % 360 - 180
    quarters = round(turned / 90)
    off = turned - 90 * quarters
    name = {0: "upright", 1: "turned by 90° clockwise", -1: "turned by 90° counter-clockwise"}.get(
        quarters, "upside down, turned by 180°"
    )
    found = judged(
        LIMITS["turn"],
        off,
        f"the chart is {name}, its rows {off:+.1f}° to the picture's",
        "turn the camera until they are level",
        {"turned_deg": turned, "quarter_turns": quarters},
    )
    if quarters == 0:
        return found
    reason = "the table is the same either way; a landscape chart fills an upright picture badly"
    return Finding(
        found.name, worst((found.grade, "remark")), found.said, found.value, found.unit, found.good, found.tolerable,
        found.reason or reason, found.remedy or "see that it hangs as it was meant to", found.details,
    )  # fmt: skip


def judge_tilt(framing: Framing, chart: Chart, focal_px: float | None) -> Finding:
    """Return the finding on keystone: by the sides' lengths, which need no focal length, and in degrees.

    `focal_px`: focal length, half-size px; None where it is not known: degrees then hold for a usual lens.
    """
    width, height = chart.page_mm
    corners = project(framing.homography, [(0, 0), (width, 0), (width, height), (0, height)])
    top, right, bottom, left = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    across, down = max(left / right, right / left) - 1, max(top / bottom, bottom / top) - 1
    rows, columns = framing.plane.values.shape
    focal = focal_px if focal_px is not None else USUAL_FOCAL_DIAGONALS * float(np.hypot(rows, columns))
    pan, tilt = tilt_deg(framing.homography, focal, ((columns - 1) / 2, (rows - 1) / 2))
    nearer = " and ".join(
        [
            *(["left" if left > right else "right"] if across > 0.01 else []),
            *(["top" if top > bottom else "bottom"] if down > 0.01 else []),
        ]
    )
    known = "" if focal_px is not None else f", if the lens has {USUAL_FOCAL_DIAGONALS:g} diagonals of focal length"
    return judged(
        LIMITS["tilt"],
        float(max(across, down)),
        f"keystone {percent(float(across))} across, {percent(float(down))} down"
        f"{f', {nearer} nearer' if nearer else ''}: the print is turned by {pan:+.1f}° about the upright and "
        f"{tilt:+.1f}° about the level axis{known}",
        "set the camera square to the middle of the print: the same distance to all four corners",
        {"across": float(across), "down": float(down), "pan_deg": pan, "tilt_deg": tilt, "focal_px": focal_px},
    )


def tilt_deg(homography: _Array, focal_px: float, centre_px: tuple[float, float]) -> tuple[float, float]:
    """Return how a plane is turned against the sensor about the upright and about the level axis, degrees.

    From the homography (3, 3) float64 of a pinhole, mm to px, K [r₁ r₂ t]: the columns of the rotation give the plane's
    normal (R. Hartley and A. Zisserman, "Multiple View Geometry", 2nd ed., section 8.1.1). Positive where the right,
    and the lower, side is nearer.
    """
    x, y = centre_px
    camera = np.array([[focal_px, 0, x], [0, focal_px, y], [0, 0, 1.0]])
    turned = np.linalg.solve(camera, homography)
    first, second = (turned[:, k] / np.linalg.norm(turned[:, k]) for k in (0, 1))
    if turned[2, 2] < 0:
        first, second = -first, -second
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    return float(np.degrees(np.arctan2(normal[0], normal[2]))), float(np.degrees(np.arctan2(normal[1], normal[2])))


def judge_size(framing: Framing, chart: Chart, place: ChartMap) -> Finding:
    """Return the finding on how large cells and tags are, and whether the sheet lies in the picture."""
    width, height = chart.page_mm
    scale = place.scale([(0, 0), (width, 0), (width, height), (0, height), (width / 2, height / 2)])
    cell = float((scale * chart.cell_mm).min())
    module = "" if framing.field is not None else f", a tag module {framing.module_px:.1f} px"
    found = judged(
        LIMITS["size"],
        cell,
        f"the chart fills {percent(framing.fill)} of the picture, its smallest cell has {amount(cell, 'px')}{module} "
        "(half-size pixels)",
        "bring the camera nearer or take a longer lens",
        {"fill": framing.fill, "cell_px": cell, "module_px": framing.module_px},
    )
    wrong: list[tuple[str, str]] = []
    if not framing.inside:
        wrong.append(("the sheet does not lie in the picture with all four corners", "move the camera back or turn it"))
    if framing.module_px < MIN_MODULE_PX:
        wrong.append((f"tags need {MIN_MODULE_PX:g} px a module", "bring the camera nearer"))
    if not wrong:
        return found
    reasons, remedies = ("; ".join(part) for part in zip(*wrong, strict=True))
    # What is cut off, or not found for it, is judged by the cells and tags that are lacking.
    return replace(
        found,
        grade=worst((found.grade, "remark")),
        reason="; ".join(filter(None, (found.reason, reasons))),
        remedy="; ".join(filter(None, (found.remedy, remedies))),
    )


def judge_chart(framing: Framing, chart: Chart) -> Finding:
    """Return the finding on whether all of the chart was found."""
    total = len(chart.tags)
    if framing.field is not None:
        return Finding("chart", "good", "no tags, the field of cells was found")
    said = f"{len(framing.tags)} of {total} tags found"
    if framing.complete:
        return Finding("chart", "good", said)
    return Finding(
        "chart", "remark", f"{said}; missing: {', '.join(str(number) for number in framing.missing[:8])}",
        reason="where a tag is missing, the place of the cells around it rests on the cells alone",
        remedy="bring all of the chart into the picture, uncover it, and light all of it",
    )  # fmt: skip
