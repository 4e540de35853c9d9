"""What a table would be like, as far as frames of a check show it: by the figures of its verdict, and their limits.

Measured as `build-lut` measures: the field by the white references, stains on the cells in that field, bleed by the
median blur of printed edges. So what is refused here is what would be refused there. What a single light, or a moment,
does not show is not known before the session (`not_known`), and the verdict can still turn out worse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from acquisition.check.findings import LIMITS, Finding, judged, not_checked, percent
from acquisition.check.frames import PlacedChart, Shot, chart_levels, mean_levels
from acquisition.check.light_and_print import no_light
from acquisition.check.places import Levels
from calibration.figures.all_figures import BY_NAME, FIGURES
from calibration.figures.figure import CheckMeasurements, Figure, Outcome, worst_outcome
from calibration.figures.light import GREY_TINT_DEG
from calibration.figures.radiometry import UNFIT_SHARE
from calibration.figures.truth import DARKEST_COUNTS, REFERENCE_SPREAD, REFERENCES_USED
from experiment.chart.model import Chart
from experiment.framing.planes import frame_black
from experiment.framing.sharpness import blur_px
from experiment.lights.illuminations import Illumination
from experiment.measures.paper import Paper, PaperReader
from experiment.measures.stains import Stains, find_stains
from foundation.angles import angles_deg
from foundation.errors import QualityError
from foundation.srgb import decode_srgb

_HELPS = {
    "outside": "bring all of the chart into the picture",
    "clipped": "expose less, and keep reflections off the chart",
    "stained": "clean the print or print it anew, and light it evenly",
}
"""What helps against each cause of unfit cells."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Forecast:
    """What can be said of a table before its session.

    - `figures`: values by the names of figures, as in `report.json`.
    - `unfit`: share of the cells that would be unfit, by cause.
    """

    figures: Mapping[str, float] = field(default_factory=dict[str, float])
    unfit: Mapping[str, float] = field(default_factory=dict[str, float])

    @staticmethod
    def of(check: CheckMeasurements) -> Forecast:
        """Return what the measurements of a check say."""
        values = ((one.name, one.forecast(check)) for one in FIGURES if one.forecast is not None)
        return Forecast({name: value for name, value in values if value is not None}, check.unfit)

    @property
    def outcomes(self) -> dict[str, Outcome]:
        """What each figure does to the table."""
        return {name: BY_NAME[name].outcome(value) for name, value in self.figures.items()}

    @property
    def outcome(self) -> Outcome:
        """The worst of them: the verdict as far as it is known."""
        return worst_outcome(self.outcomes.values())

    @property
    def not_known(self) -> tuple[str, ...]:
        """The names of the figures that are known only when there are frames of a session."""
        return tuple(figure.name for figure in FIGURES if figure.name not in self.figures)

    def value(self, figure: Figure) -> float | None:
        """Return a figure's value, where it is known."""
        return self.figures.get(figure.name)


def measure_table(
    chart: Chart, placed: PlacedChart, whites: tuple[Shot, ...], dark: Shot | None, saturation: float
) -> CheckMeasurements:
    """Return what white frames, and a dark one, show of a table.

    `whites`, `dark`: frames of one exposure; None where there is no dark one. `saturation`: raw count at which the
    sensor saturates.
    """
    framing = placed.framing
    cells, references = chart_levels(whites, placed, chart, saturation)
    white = np.array([reference.is_white for reference in chart.references], dtype=np.bool_)
    seen = np.where(references.clipped[:, None], np.nan, references.mean)
    paper = _paper(chart, seen[white])
    stains = None if paper is None else _stains(chart, cells, paper)
    unfit = _unfit_cells(cells, stains, chart)
    usable = int(np.isfinite(seen[white]).all(axis=1).sum())
    tint, leak, brightest = None, None, None
    if paper is not None:
        places = _places(chart)
        brightest = float(paper.white.max()) / (saturation - float(frame_black(whites[0].mosaic).mean()))
        tint = _tint_deg(chart, seen[~white] / paper.field.at(places[~white]), paper.white, white)
        if dark is not None:
            black = mean_levels((dark,), placed, places[white], saturation).mean / paper.field.at(places[white])
            leak = np.nanmedian(np.where(np.isfinite(black), black, np.nan), axis=0) / paper.white
    found = len(framing.tags)
    return CheckMeasurements(
        tags_found=None if framing.field is not None else found / max(found + len(framing.missing), 1),
        cell_px=smallest_cell_px(chart, placed),
        blur_px=blur_px(framing),
        unfit={cause: float(mask.mean()) for cause, mask in unfit.items()},
        unfit_share=float(np.any(list(unfit.values()), axis=0).mean()),
        stains=stains,
        references_used=usable / max(int(white.sum()), 1),
        paper=paper,
        tint_deg=tint,
        leak=leak,
        brightest_share=brightest,
    )


def darkest_counts(
    lights: Sequence[Illumination], primaries: Mapping[str, _Array], exposure_ratio: float = 1.0
) -> float | None:
    """Return the counts of paper under a plan's darkest light, as its primaries and sRGB's curve give it.

    `primaries`: (3,) counts above black of paper under "red", "green", "blue" and "black", at one exposure.
    """
    if not lights:
        return None
    shares = decode_srgb(np.array([light.codes for light in lights]) / 255)
    black = primaries["black"]
    alone = np.stack([primaries[name] - black for name in ("red", "green", "blue")])
    return float(((shares @ alone + black) * exposure_ratio).max(axis=1).min())


def smallest_cell_px(chart: Chart, placed: PlacedChart) -> float:
    """Return the shorter side of the chart's smallest cell, half-size px."""
    width, height = chart.page_mm
    corners = [(0, 0), (width, 0), (width, height), (0, height), (width / 2, height / 2)]
    return float((placed.place.scale(corners) * chart.cell_mm).min())


def _places(chart: Chart) -> _Array:
    return np.array([reference.centre_mm for reference in chart.references], dtype=np.float64).reshape(-1, 2)


def _paper(chart: Chart, seen: _Array) -> Paper | None:
    """Return what the white references show, (W, 3) counts; None where a table takes them from the cells, or cannot."""
    if not chart.tags:
        return None
    places = np.array([each.centre_mm for each in chart.white_references], dtype=np.float64).reshape(-1, 2)
    try:
        base = PaperReader(places, chart.centres_mm, chart.page_mm).read(seen)[0].field
        return PaperReader(places, chart.centres_mm, chart.page_mm, base).read(seen)[0]
    except QualityError:
        return None


def _stains(chart: Chart, cells: Levels, paper: Paper) -> Stains:
    """Return where cells are not of their codes' colours, in the order of colour indices."""
    order = chart.cell_of_colour
    points = chart.centres_mm[order]
    level = np.nan_to_num(cells.mean[order]) / paper.field.at(points)
    return find_stains(level, points, chart.bits, np.asarray(np.isfinite(cells.mean[order]).all(axis=1)))


def _unfit_cells(cells: Levels, stains: Stains | None, chart: Chart) -> dict[str, _Mask]:
    """Return the cells (C,) that a table would list as unfit, by the causes that one light shows."""
    outside: _Mask = np.asarray(~np.isfinite(cells.mean).all(axis=1))
    stained = np.zeros(len(outside), dtype=np.bool_)
    if stains is not None:
        stained[chart.cell_of_colour] = stains.stained
    return {"outside": outside, "clipped": cells.clipped & ~outside, "stained": stained & ~outside & ~cells.clipped}


def _tint_deg(chart: Chart, flat: _Array, white: _Array, is_white: _Mask) -> float | None:
    """Return the largest angle between a printed level of grey, (N, 3) field divided out, and paper white (3,)."""
    codes = np.array([each.rgb for each, paper in zip(chart.references, is_white, strict=True) if not paper])
    if not len(codes):
        return None
    found = [
        np.nanmedian(flat[(codes == code).all(axis=1)], axis=0)
        for code in np.unique(codes, axis=0)
        if np.isfinite(flat[(codes == code).all(axis=1)]).any()
    ]
    return float(angles_deg(np.array(found), white).max()) if found else None


def forecast_findings(table: Forecast, chart: Chart, why_not: str = "") -> list[Finding]:
    """Return the findings on the figures of a table that no other finding judges.

    `why_not`: why the frames show nothing; "" where they do.
    """
    return [_references(table, chart, why_not), _unfit(table, why_not), _tint(table, why_not), _darkest(table, why_not)]


def _references(table: Forecast, chart: Chart, why_not: str) -> Finding:
    spread, used = table.value(REFERENCE_SPREAD), table.value(REFERENCES_USED)
    if spread is None or used is None:
        return not_checked("references", why_not or no_light(chart))
    found = judged(
        LIMITS["references"],
        spread,
        f"white references lie {percent(spread)} RMS about the smooth light, {percent(used)} of them usable",
        "keep reflections and shadows off the print, clean or flatten it",
        {"used": used},
    )
    if found.grade == "good" and REFERENCES_USED.outcome(used) != "accept":
        remedy = "uncover the print, and bring all of it into the picture"
        return replace(found, grade="remark", reason=REFERENCES_USED.why, remedy=remedy)
    return found


def _unfit(table: Forecast, why_not: str) -> Finding:
    share = table.value(UNFIT_SHARE)
    if share is None:
        return not_checked("unfit cells", why_not or "stains cannot be judged, and no other cause is seen")
    causes = {cause: part for cause, part in table.unfit.items() if part > 0}
    described = ", ".join(f"{percent(part)} {cause}" for cause, part in causes.items())
    return judged(
        LIMITS["unfit cells"],
        share,
        f"{percent(share)} of the cells would be unfit for use{f': {described}' if described else ''}",
        "; ".join(_HELPS[cause] for cause in causes),
        dict(table.unfit),
    )


def _tint(table: Forecast, why_not: str) -> Finding:
    tint = table.value(GREY_TINT_DEG)
    if tint is None:
        return not_checked("grey tint", why_not or "the chart has no grey references in the field of its white ones")
    return judged(
        LIMITS["grey tint"],
        tint,
        f"printed greys are up to {tint:.1f}° off paper white",
        "generate with --rendering colorimetric, or have the chart printed through the printer's profile",
    )


def _darkest(table: Forecast, why_not: str) -> Finding:
    counts = table.value(DARKEST_COUNTS)
    if counts is None:
        return not_checked("darkest light", why_not or "a recording's primaries are not asked for")
    return judged(
        LIMITS["darkest light"],
        counts,
        f"bare paper will have about {counts:.0f} counts under the plan's darkest light",
        "expose longer, or leave the darkest lights out",
    )
