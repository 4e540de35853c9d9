"""The figures of a table that frames of a check show already, by the verdict's names and limits.

Measured as `build-lut` measures them: the field by the white references, stains on the cells in that field, bleed by
the median blur of printed edges. So what is refused here is what would be refused there. What a single light, or a
moment, does not show is not known before the session (`not_known`), and the verdict can still turn out worse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from acquisition.check.looking import PlacedChart, mean_levels, points_of
from acquisition.check.places import Levels
from acquisition.check.taking import Shot
from calibration.sampling import bleed
from experiment.chart.model import Chart
from experiment.framing.planes import frame_black
from experiment.framing.sharpness import blur_px
from experiment.lights.illuminations import Illumination
from experiment.limits.table import ONLY_OF_A_SESSION, TABLE_LIMITS, TableOutcome
from experiment.measures.paper import Paper, PaperReader
from experiment.measures.reflections import added_light
from experiment.measures.stains import Stains, find_stains
from foundation.angles import angles_deg
from foundation.errors import QualityError
from foundation.srgb import decode_srgb

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

OUTCOMES: tuple[TableOutcome, ...] = ("accept", "accept with remarks", "refuse")
"""From the best to the worst."""


@dataclass(frozen=True)
class ForetoldTable:
    """What can be said of a table before its session.

    - `figures`: by their names in `report.json`, in the units of `experiment.limits.table`.
    - `causes`: share of the cells that would be unfit, by cause: ``outside``, ``clipped``, ``stained``.
    """

    figures: Mapping[str, float] = field(default_factory=dict[str, float])
    causes: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def outcomes(self) -> dict[str, TableOutcome]:
        """What each figure does to the table."""
        return {name: TABLE_LIMITS[name].outcome(value) for name, value in self.figures.items()}

    @property
    def outcome(self) -> TableOutcome:
        """The worst of them: the verdict as far as it is known."""
        return OUTCOMES[max((OUTCOMES.index(each) for each in self.outcomes.values()), default=0)]

    @property
    def not_known(self) -> tuple[str, ...]:
        """The names of the figures that are known only when there are frames of a session."""
        return *(name for name in TABLE_LIMITS if name not in self.figures), *ONLY_OF_A_SESSION


def foretell(
    chart: Chart, placed: PlacedChart, whites: tuple[Shot, ...], dark: Shot | None, saturation: float
) -> ForetoldTable:
    """Return the figures that white frames, and a dark one, show of a table.

    `whites`, `dark`: frames of one exposure; None where there is no dark one. `saturation`: raw count at which the
    sensor saturates.
    """
    framing = placed.framing
    levels = mean_levels(whites, placed, points_of(chart), saturation)
    count = len(chart.centres_mm)
    figures: dict[str, float] = {}
    if framing.field is None:
        figures["tags_found"] = len(framing.tags) / max(len(framing.tags) + len(framing.missing), 1)
    cell = smallest_cell_px(chart, placed)
    figures |= {"cell_px": cell, "bleed": bleed(cell, blur_px(framing))}
    white = np.array([reference.is_white for reference in chart.references], dtype=np.bool_)
    references = Levels(levels.mean[count:], levels.clipped[count:])
    seen = np.where(references.clipped[:, None], np.nan, references.mean)
    paper = _paper(chart, seen[white])
    cells = Levels(levels.mean[:count], levels.clipped[:count])
    stains = None if paper is None else _stains(chart, cells, paper)
    unfit = _unfit(cells, stains, chart)
    share = float(np.any(list(unfit.values()), axis=0).mean())
    if paper is not None or TABLE_LIMITS["unfit_share"].outcome(share) != "accept":
        # Without the light on the chart stains are not known, and what is known is the least.
        figures["unfit_share"] = share
    if stains is not None and stains.known:
        figures["doubtful_share"] = float(stains.doubtful.mean())
        figures["added_light"] = added_light(stains)
    usable = int(np.isfinite(seen[white]).all(axis=1).sum())
    figures["references_used"] = usable / max(int(white.sum()), 1)
    if paper is not None:
        places = _places(chart)
        top = saturation - float(frame_black(whites[0].mosaic).mean())
        figures["reference_spread"] = float(paper.spread[int(np.argmax(paper.white))])
        figures["brightest_share"] = float(paper.white.max()) / top
        if (tint := _tint_deg(chart, seen[~white] / paper.field.at(places[~white]), paper.white, white)) is not None:
            figures["grey_tint_deg"] = tint
        if dark is not None:
            black = mean_levels((dark,), placed, places[white], saturation).mean / paper.field.at(places[white])
            light = np.nanmedian(np.where(np.isfinite(black), black, np.nan), axis=0)
            figures["leak_share"] = float(np.abs(light / paper.white).max())
    return ForetoldTable(figures, {cause: float(mask.mean()) for cause, mask in unfit.items()})


def foretell_lights(
    lights: Sequence[Illumination], primaries: Mapping[str, _Array], exposure_ratio: float = 1.0
) -> dict[str, float]:
    """Return the darkest light of a plan, as its primaries and sRGB's curve foretell it.

    `primaries`: (3,) counts above black of paper under "red", "green", "blue" and "black", at one exposure.
    """
    if not lights:
        return {}
    shares = decode_srgb(np.array([light.codes for light in lights]) / 255)
    black = primaries["black"]
    alone = np.stack([primaries[name] - black for name in ("red", "green", "blue")])
    return {"darkest_counts": float(((shares @ alone + black) * exposure_ratio).max(axis=1).min())}


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


def _unfit(cells: Levels, stains: Stains | None, chart: Chart) -> dict[str, _Mask]:
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
