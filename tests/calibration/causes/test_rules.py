"""The rules of causes, case by case."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import pytest

from calibration.causes.rules import (
    ANOTHER_PRINT,
    BUMP,
    CAUSES,
    COLOUR_WHEEL,
    CURL,
    DEFOCUS,
    FALL_OFF,
    HOT_PHOTOSITES,
    MIXED,
    OBJECT_IN_FRAME,
    OTHER_BRIGHTNESS,
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
    WRONG_NAME,
    Cause,
    Evidence,
    Subject,
    decide,
    evidence_names,
)

# A position on the print that is the same in all frames.
PRINT = Evidence(
    frames=8, showing=0, even_showing=0, some_whites=0, in_first=0, spot=1, scatter=0.002, softer=0, share=0.03, hot=0
)
# A position that deviates in the frame of one light.
LIGHT = Evidence(frames=8, showing=0.125, even_showing=0, in_first=0, spot=0, scatter=0.006, softer=0, share=0.07)

CASES: list[tuple[Subject, Evidence, Cause]] = [
    ("block", replace(LIGHT, deviation=-0.9, tint=0, added=0, kept=0.1), OBJECT_IN_FRAME),
    ("block", replace(LIGHT, deviation=0.3, tint=0.1, added=0.3, kept=0), OBJECT_IN_FRAME),
    # Light beside what the cells have of their own, in one frame.
    ("block", replace(LIGHT, deviation=0.08, tint=0.2, added=0.02, kept=1.0), REFLECTION_IN_FRAME),
    # Between a reflection and a pale hand: both are possible.
    ("block", replace(LIGHT, deviation=0.08, tint=0.2, added=0.02, kept=0.87), UNKNOWN),
    ("few cells", replace(LIGHT, deviation=-0.3), OBJECT_IN_FRAME),
    # Few cells, all brighter: a glint, or a pale hand.
    ("few cells", replace(LIGHT, deviation=0.3), UNKNOWN),
    # Cells that are brighter and darker alike, in a white frame too: a hand does not do that.
    ("few cells", replace(LIGHT, even_showing=0.33, deviation=math.nan), UNKNOWN),
    # Half of the frames: something came and stayed, and nobody knows what.
    ("block", replace(LIGHT, showing=0.5, deviation=-0.2), UNKNOWN),
    ("block", replace(LIGHT, showing=1, in_first=1, deviation=0.2), OBJECT_IN_FRAME),
    # Of three frames the one that differs from the others may be any.
    ("block", replace(LIGHT, frames=2, showing=1, in_first=1, deviation=0.2), UNKNOWN),
    # Where many photosites are hot a block of cells is brighter in dim lights; a hand is darker there, too.
    ("block", replace(LIGHT, deviation=0.08, tint=0.8, added=0.0, kept=1.0, hot=0.47), HOT_PHOTOSITES),
    ("block", replace(LIGHT, softer=0.03, scatter=0.05), DEFOCUS),
    ("block", replace(LIGHT, scatter=0.5), ANOTHER_PRINT),
    # Most of the sheet: a cloud before the window, a lamp, or nothing that is known.
    ("block", replace(LIGHT, share=0.8, deviation=-0.05), UNKNOWN),
    ("spot", replace(PRINT, deviation=-0.1, tint=0.7, added=0, kept=0.9), STAIN),
    ("spot", replace(PRINT, deviation=-0.03, tint=0.1, added=0, kept=0.97), SHADOW),
    ("unfit cells", Evidence(white_residual=1, deviation=-0.2, tint=0.7, share=0.03, rim_frames=0, hot=0), STAIN),
    # Between a stain and a shadow: both are possible.
    ("spot", replace(PRINT, deviation=-0.05, tint=0.3, added=0, kept=0.95), UNKNOWN),
    ("spot", replace(PRINT, deviation=0.1, tint=0.2, added=0.03, kept=0.97), REFLECTION),
    # Brighter in proportion: the print is worn, the light uneven.
    ("spot", replace(PRINT, deviation=0.05, tint=0.1, added=0, kept=1.05), UNKNOWN),
    ("spot", replace(PRINT, showing=0.125, even_showing=0.33, deviation=-0.2, tint=0), OBJECT_IN_FRAME),
    # A hand in a light's frame where a stain is: the stain is in all frames.
    (
        "spot",
        replace(PRINT, showing=0.125, deviation=-0.1, tint=0.7, added=0, kept=0.9),
        STAIN,
    ),
    # References of one white frame are off there, as a hand in a corner has it that the field follows.
    ("spot", replace(PRINT, some_whites=1, deviation=-0.2, tint=0, added=0.003, kept=0.79), UNKNOWN),
    (
        "spot",
        replace(PRINT, some_whites=1, white_residual=0.25, rim_frames=0.25, deviation=-0.2, tint=0, kept=0.79),
        OBJECT_IN_FRAME,
    ),
    # From one frame nothing can be said of all.
    ("spot", Evidence(frames=0, deviation=-0.1, tint=0.7, added=0, kept=0.9, share=0.03), UNKNOWN),
    ("unfit cells", Evidence(misplaced=0.8, waves_px=0.8, hot=0, uneven=0, beyond_cell=0), CURL),
    # A flat print: few cells, or dark corners, and no curl.
    ("unfit cells", Evidence(misplaced=1, waves_px=0.05, hot=0, uneven=0, beyond_cell=0), UNKNOWN),
    ("unfit cells", Evidence(misplaced=0, waves_px=0.05, hot=0, uneven=0.9, beyond_cell=0.08), SPREAD),
    # Uneven cells before a sharp lens are dirt, or a print of dots.
    ("unfit cells", Evidence(misplaced=0, waves_px=0.05, hot=0, uneven=0.9, beyond_cell=0.001), UNKNOWN),
    ("unfit cells", Evidence(hot=0.9), HOT_PHOTOSITES),
    ("sum", Evidence(frames=11, exposure=1, lone_primary=0.05), OTHER_BRIGHTNESS),
    # All primaries differ, or none by itself: the projector brightens white.
    ("sum", Evidence(frames=11, exposure=1, lone_primary=0.005), UNKNOWN),
    # One primary more and another as much less: the one's frame holds the other's light.
    ("sum", Evidence(frames=11, exposure=1, mixed=0.05), MIXED),
    ("stray", Evidence(frames=11, stray=0.05, mixed=0.05), MIXED),
    ("sum", Evidence(frames=11, exposure=1, colour_scatter=0.01), COLOUR_WHEEL),
    # A frame of another light among the white ones.
    ("drift", Evidence(frames=11, exposure=1, colour_scatter=0.5), UNKNOWN),
    ("unfit cells", Evidence(hot=0, lit=0.8), REFLECTION),
    ("references", Evidence(frames=4, radial=0.8, rim=-0.02, rim_frames=1, white_residual=1), FALL_OFF),
    (
        "references",
        Evidence(frames=4, white_residual=0.25, deviation=-0.8, share=0.09, rim_frames=0),
        OBJECT_IN_FRAME,
    ),
    ("chart", Evidence(agreement=0.1), ANOTHER_PRINT),
    ("frame", Evidence(softer=0.02, scatter=0.01), DEFOCUS),
    ("frame", Evidence(softer=0, scatter=0.5), ANOTHER_PRINT),
    ("movement", Evidence(anew=0.1, moved_px=2, softer=0), BUMP),
    ("iso", Evidence(frames=8, other_iso=2), OTHER_EXPOSURE),
    ("sum", Evidence(exposure=0.5), OTHER_EXPOSURE),
    ("sum", Evidence(exposure=1.0, named_right=0), WRONG_NAME),
    # A projector with a white segment: exposures and names are right.
    ("sum", Evidence(exposure=1.0, named_right=1), UNKNOWN),
    ("names", Evidence(exposure=1.0, cameras=2, named_right=0), OTHER_CAMERA),
    ("dark", Evidence(frames=3, room=0.01, room_change=0.0001), UNKNOWN),
    ("dark", Evidence(frames=3, room=0.05, room_change=0.0001), ROOM_LIGHT),
]


@pytest.mark.parametrize(("subject", "evidence", "cause"), CASES)
def test_decides_by_evidence(subject: Subject, evidence: Evidence, cause: Cause) -> None:
    assert decide(subject, evidence).cause is cause


def test_unknown_evidence_decides_nothing() -> None:
    assert not Evidence().measured_values()
    for subject in get_args(Subject):
        assert decide(subject, Evidence()).cause is UNKNOWN


def test_rules_refer_to_existing_names() -> None:
    assert {condition.name for rule in RULES for condition in rule.conditions} <= set(evidence_names())
    assert {rule.cause for rule in RULES} | {UNKNOWN} == set(CAUSES)
    assert len({cause.name for cause in CAUSES}) == len(CAUSES)
    for cause in CAUSES[:-1]:
        assert cause.description
        assert cause.remedy
    for rule in RULES:
        assert rule.why


def test_every_cause_has_a_case() -> None:
    assert {cause for *_, cause in CASES} == set(CAUSES)
