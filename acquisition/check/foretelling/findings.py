"""Findings on what only a table has figures for: references, unfit cells, greys, the darkest light."""

from __future__ import annotations

from acquisition.check.findings import LIMITS, Finding, judged, not_checked, percent
from acquisition.check.foretelling.figures import ForetoldTable
from acquisition.check.light import no_light
from experiment.chart.model import Chart

_HELPS = {
    "outside": "bring all of the chart into the picture",
    "clipped": "expose less, and keep reflections off the chart",
    "stained": "clean the print or print it anew, and light it evenly",
}
"""What helps against each cause of unfit cells."""


def foretold_findings(table: ForetoldTable, chart: Chart, why_not: str = "") -> list[Finding]:
    """Return the findings on the figures of a table that no other finding judges.

    `why_not`: why the frames show nothing; "" where they do.
    """
    return [_references(table, chart, why_not), _unfit(table, why_not), _tint(table, why_not), _darkest(table, why_not)]


def _references(table: ForetoldTable, chart: Chart, why_not: str) -> Finding:
    spread, used = table.figures.get("reference_spread"), table.figures.get("references_used")
    if spread is None or used is None:
        return not_checked("references", why_not or no_light(chart))
    found = judged(
        LIMITS["references"],
        spread,
        f"white references lie {percent(spread)} RMS about the smooth light, {percent(used)} of them usable",
        "keep reflections and shadows off the print, clean or flatten it",
        {"used": used},
    )
    if found.grade == "good" and table.outcomes["references_used"] != "accept":
        return Finding(
            found.name, "remark", found.said, found.value, found.unit, found.good, found.tolerable,
            "flat field and ground truth rest on few places", "uncover the print, and bring all of it into the picture",
            found.details,
        )  # fmt: skip
    return found


def _unfit(table: ForetoldTable, why_not: str) -> Finding:
    share = table.figures.get("unfit_share")
    if share is None:
        return not_checked("unfit cells", why_not or "stains cannot be judged, and no other cause is seen")
    causes = {cause: part for cause, part in table.causes.items() if part > 0}
    told = ", ".join(f"{percent(part)} {cause}" for cause, part in causes.items())
    return judged(
        LIMITS["unfit cells"],
        share,
        f"{percent(share)} of the cells would be unfit for use{f': {told}' if told else ''}",
        "; ".join(_HELPS[cause] for cause in causes),
        dict(table.causes),
    )


def _tint(table: ForetoldTable, why_not: str) -> Finding:
    tint = table.figures.get("grey_tint_deg")
    if tint is None:
        return not_checked("grey tint", why_not or "the chart has no grey references in the field of its white ones")
    return judged(
        LIMITS["grey tint"],
        tint,
        f"printed greys are up to {tint:.1f}° off paper white",
        "generate with --rendering colorimetric, or have the chart printed through the printer's profile",
    )


def _darkest(table: ForetoldTable, why_not: str) -> Finding:
    counts = table.figures.get("darkest_counts")
    if counts is None:
        return not_checked("darkest light", why_not or "a recording's primaries are not asked for")
    return judged(
        LIMITS["darkest light"],
        counts,
        f"bare paper will have about {counts:.0f} counts under the plan's darkest light",
        "expose longer, or leave the darkest lights out",
    )
