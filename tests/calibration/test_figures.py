"""Figures: each has its parts and stands once; limits at their borders."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.figures import all_figures, geometry, light, radiometry, truth
from calibration.figures.all_figures import FIGURES
from calibration.figures.figure import QUESTIONS
from calibration.figures.single_frames import FRAME_LIMITS, RIG_LIMITS
from calibration.figures.truth import DARKEST_COUNTS

ROOT = Path(__file__).parents[2]
PACKAGES = ("foundation", "drivers", "sim", "experiment", "calibration", "acquisition", "benchmarks")


@pytest.mark.parametrize(
    "wrong",
    [
        {"why": ""},
        {"title": ""},
        {"source": ""},
        {"refuse": 301.0},
        {"name": "bleed"},
        {"lines": light.ADDITIVITY.lines},
        {"cause": replace(light.ADDITIVITY.cause, follows=("nothing",)) if light.ADDITIVITY.cause else None},
    ],
)
def test_figures_that_contradict_themselves_do_not_import(
    wrong: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(light, "WRONG", replace(DARKEST_COUNTS, **{"name": "wrong", **wrong}), raising=False)  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match=r"wrong|one of the names"):
        all_figures.collected()


def test_a_limit_of_single_frames_has_a_name_of_its_own_and_a_reason() -> None:
    limits = (*RIG_LIMITS, *FRAME_LIMITS)
    names = [one.name for one in (*FIGURES, *limits)]
    assert len(set(names)) == len(names)
    for one in limits:
        assert all((one.title, one.why, one.source, one.remedy))
        assert one.outcome(one.accept) == "accept"
        assert one.refuse is None or one.outcome(one.refuse) != "refuse"


def test_figures_are_listed_in_the_order_of_their_definitions() -> None:
    assert all_figures.collected() == FIGURES
    texts = [Path(module.__file__ or "").read_text() for module in (geometry, radiometry, light, truth)]
    assert [figure.name for figure in FIGURES] == re.findall(r' = Figure\(\n    "(\w+)"', "".join(texts))
    assert {figure.group for figure in FIGURES} == QUESTIONS.keys()


def test_some_figures_are_asked_more_than_others() -> None:
    """What trial frames show, what names frames by itself, what a refusal speaks of first, what shares a cause."""
    assert {figure.name for figure in FIGURES if not figure.before_session} >= {
        "correction_residual", "truth_median_deg", "truth_worst_deg", "white_frames", "primaries_lacking",
    }  # fmt: skip
    first = {figure.name for figure in FIGURES if figure.foremost}
    assert first >= {"other_camera", "other_exposure", "off_codes_deg", "white_frame_deg"}
    assert {figure.name for figure in FIGURES if figure.retake is not None} >= first | {
        "frame_blur", "frame_scatter", "block_deviation", "off_brightness", "white_frame_brightness",
    }  # fmt: skip
    explained = {figure.name: figure.cause.follows for figure in FIGURES if figure.cause is not None}
    assert (
        explained.items()
        >= {
            "unfit_share": ("block_deviation",),
            "frame_scatter": ("block_deviation", "disturbed_cells"),
            "disturbed_cells": ("block_deviation",),
            "off_brightness": ("off_codes_deg", "exchanged_lights"),
        }.items()
    )


@pytest.mark.parametrize(
    ("cells", "measured", "left_in", "told"),
    [(4096, True, False, True), (4095, True, False, False), (512, True, True, True), (4096, False, True, False)],
)
def test_what_a_lens_leaves_is_a_figure_where_cells_are_enough_to_tell_it(
    cells: int, measured: bool, left_in: bool, told: bool
) -> None:
    table: Any = SimpleNamespace(
        is_of_one_frame=False,
        registration=SimpleNamespace(mismatched_cells=np.zeros(cells)),
        lens=SimpleNamespace(measured=measured, is_left_in=left_in, left=0.003, left_worst=0.02),
    )
    assert geometry.CORRECTION_RESIDUAL.measure(table) == (0.003 if told else None)
