"""Tables with the lamp's drift taken out: one lamp, the same truth, undone to the count, refused where unknown."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibration.cli import main
from calibration.comparison.comparing import compare
from calibration.pipeline.build import BuildResult, build
from calibration.pipeline.frames import BuildOptions
from calibration.radiometry.drift import as_measured
from calibration.table.lut import Lut, open_lut
from calibration.table.verification import find_faults
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from foundation.errors import FormatError, QualityError
from tests.calibration.lab import LIGHTS, Lab, figures_alone, hang, take

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds")]

CORRECTED = BuildOptions(correct_drift=True)


@pytest.fixture(scope="module")
def lab() -> Lab:
    """Return a lab of few colours: of these the lens is not measured, which takes longer than all that matters here."""
    return hang(2, "A6")


def session_of(lab: Lab, folder: Path, lamp: Callable[[int], float], every: int = 4) -> Session:
    """Return a session under a lamp whose light at each step is given."""

    def frame(step: SessionStep) -> bytes:
        return lab.dng(step.colour, step.number, lamp=lamp(step.number))

    return take(lab, folder, LIGHTS, every=every, frame=frame)


@pytest.fixture(scope="module")
def drifting(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a session whose lamp loses 3 % from its first to its last frame."""
    folder = tmp_path_factory.mktemp("drifting") / "session"
    session_of(lab, folder, lambda number: 1 - 0.03 * number / 20).close()
    return folder


@pytest.fixture(scope="module")
def tables(drifting: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Lut, Lut, BuildResult]:
    """Return the session's table as measured, and with the drift taken out."""
    folder = tmp_path_factory.mktemp("tables")
    with Session.open(drifting) as session:
        build(session, folder / "plain")
        result = build(session, folder / "corrected", options=CORRECTED)
    return open_lut(folder / "plain"), open_lut(folder / "corrected"), result


def gains_of(lut: Lut) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    (entry,) = [each for each in lut.provenance.corrections if each["name"] == "drift"]
    assert entry["applied"] is True
    assert lut.provenance.corrections[-1] is entry
    return np.array(entry["per_light"])


def test_all_lights_are_of_one_lamp(lab: Lab, tables: tuple[Lut, Lut, BuildResult], tmp_path: Path) -> None:
    _, corrected, _ = tables
    with session_of(lab, tmp_path / "steady", lambda number: 1.0) as steady:
        build(steady, tmp_path / "lut")
    found = compare(open_lut(tmp_path / "lut"), corrected)
    # Bare paper is known to some hundredths of a per cent on this small chart.
    assert float(np.abs(found.lights.brightness).max()) < 0.002
    assert np.abs(compare(open_lut(tmp_path / "lut"), tables[0]).lights.brightness).max() > 0.02
    assert found.same_within_noise


def test_samples_and_truth_come_back_as_they_were(tables: tuple[Lut, Lut, BuildResult]) -> None:
    plain, corrected, _ = tables
    gains = gains_of(corrected)
    assert gains.max() <= 1
    assert gains.min() < 0.98
    assert not np.array_equal(corrected.samples, plain.samples)
    for light, gain in enumerate(gains):
        assert np.array_equal(as_measured(np.asarray(corrected.samples[light]), gain), plain.samples[light]), light
    assert corrected.white * gains == pytest.approx(plain.white, abs=2e-6)


def test_samples_and_truth_are_of_one_light(tables: tuple[Lut, Lut, BuildResult]) -> None:
    plain, corrected, _ = tables
    for light in range(len(LIGHTS)):
        before, after = (np.asarray(lut.samples[light]).mean(axis=1) / lut.white[light] for lut in (plain, corrected))
        level = np.asarray(plain.samples[light]).mean(axis=1)
        bright = level > 100
        # Samples that are rounded alike are off by half a count, 0.25 in the mean of the cells.
        off = np.abs((after / before - 1)[bright] * level[bright])
        assert off.max() < 0.25
        assert off.mean() < 0.06


def test_references_go_along_and_the_table_verifies(tables: tuple[Lut, Lut, BuildResult]) -> None:
    plain, corrected, _ = tables
    assert find_faults(corrected) == []
    rows = [(lut.folder / "references.csv").read_text().splitlines()[1].split(",")[2:] for lut in (plain, corrected)]
    before, after = (np.array([float(value) for value in row]) for row in rows)
    assert after[:3] == pytest.approx(corrected.white[0], abs=1e-5)
    assert after[3:] * np.tile(gains_of(corrected)[0], 1) == pytest.approx(before[3:], abs=1e-5)


def test_the_verdict_judges_what_white_frames_leave_open(tables: tuple[Lut, Lut, BuildResult]) -> None:
    rows = {row.figure.name: row for row in tables[2].verdict.rows}
    assert "white_drift" not in rows
    assert rows["drift_left"].outcome == "accept"


def test_a_jump_between_white_frames_is_refused_and_names_the_remedy(lab: Lab, tmp_path: Path) -> None:
    with session_of(lab, tmp_path / "session", lambda number: 1.0 if number < 9 else 0.97) as session:
        with pytest.raises(QualityError, match=r"Drift .*--correct-drift"):
            build(session, tmp_path / "lut", options=CORRECTED)
        assert not (tmp_path / "lut").exists()


def test_one_white_frame_is_refused_before_anything_is_read(lab: Lab, tmp_path: Path) -> None:
    def verdict(step: SessionStep) -> str:
        return "refused: x" if step.kind == "white" and step.number else "accepted"

    with (
        take(lab, tmp_path / "session", LIGHTS[:2], verdict=verdict) as session,
        pytest.raises(FormatError, match=r"1 accepted white frame.*--correct-drift"),
    ):
        build(session, tmp_path / "lut", options=CORRECTED)


def test_the_command_says_what_it_did(
    drifting: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibration.report.report.write_report", figures_alone)
    assert main([str(drifting), str(tmp_path / "lut"), "--correct-drift"]) == 0
    capsys.readouterr()
    assert main(["info", str(tmp_path / "lut")]) == 0
    said = capsys.readouterr().out
    assert "drift" in said
    assert "drift (recorded" not in said
    figures = json.loads((tmp_path / "lut" / "report.json").read_text())["figures"]
    assert figures["drift_left"] < 0.002
