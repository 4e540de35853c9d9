"""Windows of other sizes than the paper's 5×5."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from acquisition.session.folder import Session
from calibration.cli import main
from calibration.pipeline.build import build, check
from calibration.pipeline.options import WINDOWS, Choices
from calibration.report.report import summary as report_summary
from calibration.report.report import write_report
from calibration.table.lut import damage, open_lut, summary
from calibration.verdict.verdict import bleed, figures_of, largest_window
from foundation.errors import InputError


@pytest.mark.parametrize("window", [1, 2, 4, 11, -5])
def test_a_window_that_has_no_middle_or_no_place_is_refused(window: int) -> None:
    with pytest.raises(InputError, match="3, 5, 7 or 9 expected"):
        Choices(window)


def test_the_largest_windows_are_those_of_the_table_of_arrangements() -> None:
    """Found by rendering: 5×5 on the EOS 550D and 7×7 on the 6D Mark II below 0.2 % at a blur of 0.7 px."""
    assert largest_window(10.2, 0.7) == 5
    assert largest_window(12.4, 0.7) == 7
    assert largest_window(4.0, 0.7) == 0
    assert [bleed(10.2, 0.7, window) for window in WINDOWS] == sorted(bleed(10.2, 0.7, window) for window in WINDOWS)


def test_three_by_three_are_the_inner_samples_of_five_by_five(session: Session, tmp_path: Path) -> None:
    large = build(session, tmp_path / "5")
    small = build(session, tmp_path / "3", report=write_report, choices=Choices(3))
    five, three = open_lut(tmp_path / "5"), open_lut(tmp_path / "3")
    assert three.samples.shape == (*five.samples.shape[:2], 9, 3)
    assert "9 samples each" in dict(summary(three))["Colours"]
    assert damage(three) == []
    inner = five.samples.reshape(*five.samples.shape[:2], 5, 5, 3)[:, :, 1:4, 1:4].reshape(three.samples.shape)
    # The same photosites; the field differs, since the references are sampled by the same window.
    off = inner.astype(np.float64) - three.samples
    assert np.abs(off).max() <= 1 + 0.02 * three.samples.max()
    assert np.abs(off / np.maximum(inner, 100)).mean() < 0.004
    assert three.ground_truth == pytest.approx(five.ground_truth, abs=0.003)
    assert figures_of(small)["bleed"] < figures_of(large)["bleed"]
    assert len(small.unfit) <= 2
    assert small.transfer is not None
    assert small.transfer.noisy.sum() <= 1


def test_a_window_larger_than_the_cells_is_said(session: Session, tmp_path: Path) -> None:
    result = check(session, Choices(9))
    assert "bleed" in {row.threshold.name for row in result.verdict.refused}
    note = next(note for name, _, note in report_summary(result) if name == "Window")
    assert note.startswith("larger than these cells allow: ")
    plain = next(note for name, _, note in report_summary(check(session)) if name == "Window")
    assert plain.startswith("up to 5×5")


def test_the_command_takes_a_window(
    session: Session, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["build-lut", *map(str, arguments)])
        return main(), capsys.readouterr().err

    code, said = run("--window", 4, session.folder, tmp_path / "lut")
    assert code == 2
    assert "a window of 4 pixels was asked for" in said
    code, said = run("--window", 3, "--info", tmp_path / "lut")
    assert code == 2
    assert "--window tells how a table is made, and --info reads one" in said
    code, said = run("--window", 9, session.folder, tmp_path / "lut")
    assert code == 4
    assert "a smaller window (build-lut --window)" in said
    assert json.loads((tmp_path / "lut.refused" / "report.json").read_text())["channels"]["window"] == 9
