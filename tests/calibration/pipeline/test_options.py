"""Options of a build: windows of other sizes than the paper's 5×5."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.pipeline.build import build, check
from calibration.pipeline.frames import BuildOptions
from calibration.report.report import summary as report_summary
from calibration.table.lut import open_lut
from calibration.table.verification import describe, find_faults
from calibration.verdict import BuildResult, judge, judged_values, remark
from experiment.session.folder import Session
from foundation.errors import InputError

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("window", [1, 4, 11])
def test_a_window_that_has_no_middle_or_no_place_is_refused(window: int) -> None:
    with pytest.raises(InputError, match="3, 5, 7 or 9"):
        BuildOptions(window)


def test_three_by_three_are_the_inner_samples_of_five_by_five(
    session: Session, built: BuildResult, tmp_path: Path
) -> None:
    small = build(session, tmp_path / "3", options=BuildOptions(3))
    assert built.lut is not None
    five, three = open_lut(built.lut), open_lut(tmp_path / "3")
    assert three.samples.shape == (*five.samples.shape[:2], 9, 3)
    assert "9 samples each" in dict(describe(three))["Colours"]
    assert find_faults(three) == []
    inner = five.samples.reshape(*five.samples.shape[:2], 5, 5, 3)[:, :, 1:4, 1:4].reshape(three.samples.shape)
    # The same photosites; the field differs, since the references are sampled by the same window.
    off = inner.astype(np.float64) - three.samples
    assert np.abs(off).max() <= 1 + 0.02 * three.samples.max()
    assert np.abs(off / np.maximum(inner, 100)).mean() < 0.004
    assert three.ground_truth == pytest.approx(five.ground_truth, abs=0.003)
    assert judged_values(small.figures)["bleed"] < judged_values(built.figures)["bleed"]
    assert len(small.figures.cells.unfit) <= 2
    assert small.figures.sensor.transfer.noisy.sum() <= 1


@pytest.mark.usefixtures("lens_unmeasured")
def test_a_window_larger_than_the_cells_is_said(session: Session, built: BuildResult) -> None:
    result = check(session, BuildOptions(9))
    assert "bleed" in {row.figure.name for row in result.verdict.refused}
    note = next(row.note for row in report_summary(result.figures) if row.name == "Window")
    assert note.startswith("too large: ")
    plain = next(row.note for row in report_summary(built.figures) if row.name == "Window")
    assert plain.startswith("up to 5×5")


def test_dark_cells_that_the_lens_may_have_left_wrong_are_named_with_its_veil(built: BuildResult) -> None:
    figures = built.figures
    lens = replace(figures.lens, measured=True, corrected=True, residual=0.008, residual_worst=0.034, worst_level=0.045)
    # Of as many cells as show a veil: of fewer, it is in the uncertainty of each.
    many_cells = replace(figures.registration, mismatched_cells=np.zeros(4096, dtype=np.bool_))
    few = replace(
        figures, lens=replace(lens, veil=0.003, veil_error=0.0035), point_spread=None, registration=many_cells
    )
    (row,) = (row for row in judge(judged_values(few)).remarks if row.figure.name.startswith("correction"))
    text = remark(row, few)
    assert "up to 1 % is not excluded; cells of 4.5 % of paper may be off by 3.4 %" in text
    assert "hood" in text
    # Where the mean is remarked on, it is said once.
    many = replace(few, lens=replace(few.lens, residual=0.02, residual_worst=0.06))
    (row,) = (row for row in judge(judged_values(many)).remarks if row.figure.name.startswith("correction"))
    assert row.figure.name == "correction_residual"
    assert "cells of 4.5 % of paper may be off by 6 %" in remark(row, many)
