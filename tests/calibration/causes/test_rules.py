"""The table of causes, case by case, and at its borders."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from calibration.causes.findings import explained_figures
from calibration.causes.rules import (
    ANOTHER_PRINT,
    BUMP,
    CAUSES,
    CURL,
    DEFOCUS,
    FALL_OFF,
    HOT_PHOTOSITES,
    OBJECT_IN_FRAME,
    OTHER_CAMERA,
    OTHER_EXPOSURE,
    REFLECTION,
    REFLECTION_IN_FRAME,
    ROOM_LIGHT,
    RULES,
    SHADOW,
    SPREAD,
    STAIN,
    UNKNOWN,
    VEIL,
    WRONG_NAME,
    Cause,
    Condition,
    Evidence,
    Rule,
    decide,
    evidence_names,
)

PRINT = Evidence(
    frames=8, showing=0, even_showing=0, some_whites=0, in_first=0, spot=1, scatter=0.002, softer=0, share=0.03, hot=0
)
"""A place of the print that is the same in all frames."""
LIGHT = Evidence(frames=8, showing=0.125, even_showing=0, in_first=0, spot=0, scatter=0.006, softer=0, share=0.07)
"""A place that is off in one light's frame."""

CASES: list[tuple[str, Evidence, Cause]] = [
    ("unlike_block", replace(LIGHT, deviation=-0.9, tint=0, added=0, kept=0.1), OBJECT_IN_FRAME),
    ("unlike_block", replace(LIGHT, deviation=0.3, tint=0.1, added=0.3, kept=0), OBJECT_IN_FRAME),
    # Light beside what the cells have of their own, in one frame.
    ("unlike_block", replace(LIGHT, deviation=0.08, tint=0.2, added=0.02, kept=1.0), REFLECTION_IN_FRAME),
    # Between a reflection and a pale hand: both are possible.
    ("unlike_block", replace(LIGHT, deviation=0.08, tint=0.2, added=0.02, kept=0.87), UNKNOWN),
    ("disturbed_cells", replace(LIGHT, deviation=-0.3), OBJECT_IN_FRAME),
    # Few cells, all brighter: a glint, or a pale hand.
    ("disturbed_cells", replace(LIGHT, deviation=0.3), UNKNOWN),
    # Two dark cells that are brighter: a glint, or a finger.
    ("disturbed_cells", replace(LIGHT, deviation=math.nan), UNKNOWN),
    # Cells that are brighter and darker alike, in a white frame too: a hand does not do that.
    ("disturbed_cells", replace(LIGHT, even_showing=0.33, deviation=math.nan), UNKNOWN),
    ("unfit_share", replace(LIGHT, even_showing=0.33, deviation=math.nan), UNKNOWN),
    ("disturbed_cells", replace(LIGHT, even_showing=0.33, deviation=0.3), UNKNOWN),
    ("disturbed_cells", replace(LIGHT, even_showing=0.33, deviation=-0.3), OBJECT_IN_FRAME),
    ("unlike_block", replace(LIGHT, even_showing=0.33, deviation=0.3), OBJECT_IN_FRAME),
    # Half of the frames: something came and stayed, and nobody knows what.
    ("unlike_block", replace(LIGHT, showing=0.5, deviation=-0.2), UNKNOWN),
    ("unlike_block", replace(LIGHT, showing=1, in_first=1, deviation=0.2), OBJECT_IN_FRAME),
    # Of three frames the one that differs from the others may be any.
    ("unlike_block", replace(LIGHT, frames=2, showing=1, in_first=1, deviation=0.2), UNKNOWN),
    # A reflection shows a little under a light of another colour than white.
    ("unlike_block", replace(LIGHT, spot=0.9, deviation=0.02), UNKNOWN),
    ("unlike_block", replace(LIGHT, softer=0.03, scatter=0.05), DEFOCUS),
    ("unlike_block", replace(LIGHT, scatter=0.5), ANOTHER_PRINT),
    # Most of the sheet: a cloud before the window, a lamp, or nothing that is known.
    ("unlike_block", replace(LIGHT, share=0.8, deviation=-0.05), UNKNOWN),
    ("doubtful_share", replace(PRINT, deviation=-0.1, tint=0.7, added=0, kept=0.9), STAIN),
    ("doubtful_share", replace(PRINT, deviation=-0.03, tint=0.1, added=0, kept=0.97), SHADOW),
    # Cells at its rim are half under it, and most under it do not look like the chart's.
    ("doubtful_share", replace(PRINT, deviation=-0.2, tint=0.63, added=0.025, kept=0.64), STAIN),
    ("unfit_share", Evidence(white_residual=1, deviation=-0.2, tint=0.7, share=0.03, rim_frames=0, hot=0), STAIN),
    ("unfit_share", Evidence(white_residual=1, deviation=-0.2, tint=0.1, share=0.03, rim_frames=0, hot=0), UNKNOWN),
    # Between a stain and a shadow: both are possible.
    ("doubtful_share", replace(PRINT, deviation=-0.05, tint=0.3, added=0, kept=0.95), UNKNOWN),
    ("doubtful_share", replace(PRINT, deviation=0.1, tint=0.2, added=0.03, kept=0.97), REFLECTION),
    ("added_light", replace(PRINT, deviation=0.1, tint=0.2, added=0.03, kept=0.97), REFLECTION),
    # Brighter in proportion: the print is worn, the light uneven.
    ("doubtful_share", replace(PRINT, deviation=0.05, tint=0.1, added=0, kept=1.05), UNKNOWN),
    ("doubtful_share", replace(PRINT, showing=0.125, even_showing=0.33, deviation=-0.2, tint=0), OBJECT_IN_FRAME),
    # A hand in a light's frame where a stain is: the stain is in all frames.
    (
        "doubtful_share",
        replace(PRINT, showing=0.125, deviation=-0.1, tint=0.7, added=0, kept=0.9),
        STAIN,
    ),
    # References of one white frame are off there, as a hand in a corner has it that the field follows.
    ("doubtful_share", replace(PRINT, some_whites=1, deviation=-0.2, tint=0, added=0.003, kept=0.79), UNKNOWN),
    (
        "doubtful_share",
        replace(PRINT, some_whites=1, white_residual=0.25, rim_frames=0.25, deviation=-0.2, tint=0, kept=0.79),
        OBJECT_IN_FRAME,
    ),
    # From one frame nothing can be said of all.
    ("doubtful_share", Evidence(frames=0, deviation=-0.1, tint=0.7, added=0, kept=0.9, share=0.03), UNKNOWN),
    ("unfit_share", replace(LIGHT, deviation=-0.3), OBJECT_IN_FRAME),
    ("unfit_share", Evidence(misplaced=0.8, waves_px=0.8, hot=0, uneven=0, beyond_cell=0), CURL),
    # A flat print: few cells, or dark corners, and no curl.
    ("unfit_share", Evidence(misplaced=1, waves_px=0.05, hot=0, uneven=0, beyond_cell=0), UNKNOWN),
    ("unfit_share", Evidence(misplaced=0, waves_px=0.05, hot=0, uneven=0.9, beyond_cell=0.08), SPREAD),
    ("noisy_share", Evidence(hot=0, uneven=0.9, beyond_cell=0.08), SPREAD),
    # Uneven cells before a sharp lens are dirt, or a print of dots.
    ("unfit_share", Evidence(misplaced=0, waves_px=0.05, hot=0, uneven=0.9, beyond_cell=0.001), UNKNOWN),
    ("unfit_share", Evidence(hot=0.9), HOT_PHOTOSITES),
    ("unfit_share", Evidence(hot=0.2), UNKNOWN),
    ("reference_spread", Evidence(frames=4, radial=0.8, rim=-0.02, rim_frames=1, white_residual=1), FALL_OFF),
    ("reference_spread", Evidence(frames=4, radial=0.8, rim=0.02, rim_frames=0, white_residual=1), UNKNOWN),
    (
        "reference_spread",
        Evidence(frames=4, white_residual=0.25, deviation=-0.8, share=0.09, rim_frames=0),
        OBJECT_IN_FRAME,
    ),
    (
        "agreement",
        Evidence(agreement=0.93, white_residual=0.25, deviation=-0.8, share=0.09, rim_frames=0, scatter=0),
        OBJECT_IN_FRAME,
    ),
    ("agreement", Evidence(agreement=0.1), ANOTHER_PRINT),
    ("agreement", Evidence(agreement=0.9), UNKNOWN),
    ("softer_bleed", Evidence(softer=0.02, scatter=0.01), DEFOCUS),
    ("unlike_scatter", Evidence(softer=0.02, scatter=0.04), DEFOCUS),
    ("unlike_scatter", Evidence(softer=0, scatter=0.5), ANOTHER_PRINT),
    ("unlike_scatter", Evidence(softer=0, scatter=0.03), UNKNOWN),
    ("moved_anew", Evidence(anew=0.1, moved_px=2, softer=0), BUMP),
    ("other_iso", Evidence(frames=8, other_iso=2), OTHER_EXPOSURE),
    ("additivity", Evidence(exposure=0.5), OTHER_EXPOSURE),
    ("white_drift", Evidence(exposure=2.0), OTHER_EXPOSURE),
    ("additivity", Evidence(exposure=1.0, named_right=0), WRONG_NAME),
    # A projector with a white segment: exposures and names are right.
    ("additivity", Evidence(exposure=1.0, named_right=1), UNKNOWN),
    ("additivity", Evidence(), UNKNOWN),
    ("off_codes_deg", Evidence(exposure=1.0, cameras=2, named_right=0), OTHER_CAMERA),
    ("leak_share", Evidence(frames=3, room=0.01, room_change=0.0001), UNKNOWN),
    ("leak_share", Evidence(frames=3, room=0.05, room_change=0.0001), ROOM_LIGHT),
    ("dark_drift", Evidence(frames=3, room=0.01, room_change=0.004), ROOM_LIGHT),
    ("bleed", Evidence(veil=0.01), VEIL),
    ("bleed", Evidence(), UNKNOWN),
]


@pytest.mark.parametrize(("figure", "evidence", "cause"), CASES)
def test_evidence_decides(figure: str, evidence: Evidence, cause: Cause) -> None:
    assert decide(figure, evidence).cause is cause


def example(rule: Rule) -> Evidence:
    """Return evidence that a rule holds for, as near to its borders as it goes."""
    return Evidence(**{one.name: one.low if math.isfinite(one.low) else one.high for one in rule.conditions})


BORDERS = [(rule, condition) for rule in RULES for condition in rule.conditions]


@pytest.mark.parametrize(("rule", "condition"), BORDERS)
def test_each_condition_counts_at_its_border(rule: Rule, condition: Condition) -> None:
    held, figure = example(rule), min(rule.figures)
    assert rule.holds(figure, held)
    assert not rule.holds(figure, replace(held, **{condition.name: math.nan}))
    assert not rule.holds("another figure", held)
    for border, away in ((condition.low, -math.inf), (condition.high, math.inf)):
        if math.isfinite(border):
            assert rule.holds(figure, replace(held, **{condition.name: border}))
            assert not rule.holds(figure, replace(held, **{condition.name: math.nextafter(border, away)}))


def test_what_is_not_known_decides_nothing() -> None:
    assert not Evidence().known()
    for figure in explained_figures():
        assert decide(figure, Evidence()).cause is UNKNOWN


def test_the_table_names_what_there_is() -> None:
    assert {condition.name for _, condition in BORDERS} <= set(evidence_names())
    assert {rule.cause for rule in RULES} | {UNKNOWN} == set(CAUSES)
    assert len({cause.name for cause in CAUSES}) == len(CAUSES)
    for cause in CAUSES[:-1]:
        assert cause.says
        assert cause.remedy
    for rule in RULES:
        assert rule.why


def test_each_cause_is_tried() -> None:
    assert {cause for *_, cause in CASES} == set(CAUSES)
