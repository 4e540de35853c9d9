"""Figures: each has its parts and stands once; limits at their borders."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from calibration.figures import geometry, light, radiometry, truth
from calibration.figures.all_figures import FIGURES
from calibration.figures.figure import QUESTIONS, CheckMeasurements

ROOT = Path(__file__).parents[2]
PACKAGES = ("foundation", "drivers", "sim", "experiment", "calibration", "acquisition", "benchmarks")


def test_a_figure_has_its_parts_and_contradicts_no_other() -> None:
    names = {figure.name for figure in FIGURES}
    assert len(names) == len(FIGURES)
    for figure in FIGURES:
        assert all((figure.title, figure.why, figure.source)), figure.name
        assert figure.refuse is None or (figure.refuse > figure.accept) == (figure.sense == "at most"), figure.name
        assert figure.cause is None or names.issuperset(figure.cause.follows), figure.name
    places = [line.place for figure in FIGURES for line in figure.lines]
    assert len(set(places)) == len(places), "two lines at one place of the summary"


def test_figures_are_listed_in_the_order_of_their_definitions() -> None:
    texts = [Path(module.__file__ or "").read_text() for module in (geometry, radiometry, light, truth)]
    assert [figure.name for figure in FIGURES] == re.findall(r' = Figure\(\n    "(\w+)"', "".join(texts))
    assert {figure.group for figure in FIGURES} == QUESTIONS.keys()


@pytest.mark.slow
def test_a_name_stands_in_its_figure() -> None:
    """A figure has one home: at most two other files hold its name, as a key or a word of their own."""
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    words = {path: set(re.findall(r"(?<=[\"'])\w+(?=[\"'])", path.read_text())) for path in files}
    for figure in FIGURES:
        found = [path for path in files if figure.name in words[path]]
        assert 1 <= len(found) <= 3, (figure.name, found)


def test_some_figures_are_asked_more_than_others() -> None:
    """What a check forecasts, what names frames by itself, what a refusal speaks of first, what shares a cause."""
    assert {figure.name for figure in FIGURES if figure.forecast is not None} >= {
        "tags_found", "cell_px", "bleed", "unfit_share", "doubtful_share", "added_light", "leak_share", "additivity",
        "grey_tint_deg", "references_used", "reference_spread", "brightest_share", "darkest_counts",
    }  # fmt: skip
    first = {figure.name for figure in FIGURES if figure.foremost}
    assert first >= {"other_camera", "other_exposure", "off_codes_deg", "white_frame_deg"}
    assert {figure.name for figure in FIGURES if figure.retake is not None} >= first | {
        "softer_bleed", "unlike_scatter", "unlike_block", "off_brightness", "white_frame_brightness",
    }  # fmt: skip
    explained = {figure.name: figure.cause.follows for figure in FIGURES if figure.cause is not None}
    assert (
        explained.items()
        >= {
            "unfit_share": ("unlike_block",),
            "unlike_scatter": ("unlike_block", "disturbed_cells"),
            "disturbed_cells": ("unlike_block",),
            "off_brightness": ("off_codes_deg", "exchanged_lights"),
        }.items()
    )


def test_a_check_that_saw_nothing_forecasts_nothing() -> None:
    nothing = CheckMeasurements()
    assert [figure.name for figure in FIGURES if figure.forecast is not None and figure.forecast(nothing)] == []
