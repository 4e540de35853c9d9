"""A series of exposures shows whether a sensor is linear."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.cli import main
from calibration.pipeline.build import build, check
from calibration.report.report import summary
from calibration.verdict import BuildResult
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE
from experiment.measures.sensor import deviations
from experiment.session.folder import Session
from foundation.errors import FormatError, InputError
from sim.world.world import Room
from tests.calibration.lab import Lab, figures_alone, hang

pytestmark = pytest.mark.slow

TIMES = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
_Array = npt.NDArray[np.float64]
Bend = Callable[[_Array], _Array]


def straight(share: _Array) -> _Array:
    return share


def knee(share: _Array) -> _Array:
    """Lose 4 % at saturation, nothing below a half."""
    return share * (1 - 0.04 * np.maximum(share - 0.5, 0) / 0.5)


def power(share: _Array) -> _Array:
    """Bend as a power does: ± 2.9 % over 5 to 95 %, and the ratios of patches show nothing."""
    return share**1.02


def series(bend: Bend, times: _Array, stated: _Array | None = None, frame_error: float = 0.0) -> tuple[_Array, _Array]:
    """Return what `deviations` finds of 2000 patches, with the noise of 25 samples."""
    random = np.random.default_rng(7)
    reflectance = np.exp(random.uniform(np.log(0.03), np.log(0.95), (2000, 3)))
    light = times * (1 + frame_error * random.standard_normal(len(times)))
    share = light[:, None, None] / times[-1] * reflectance
    seen = bend(share)
    seen = seen + random.standard_normal(seen.shape) * np.sqrt(seen / 20_000 + 5e-7) / 5
    return deviations(seen, times if stated is None else stated)


def test_a_straight_sensor_is_found_straight() -> None:
    level, found = series(straight, np.array(TIMES))
    assert level[0] == pytest.approx(0.05)
    assert level[-1] == pytest.approx(0.95)
    assert np.nanmax(np.abs(found)) < 0.003


@pytest.mark.parametrize(("bend", "worst"), [(knee, 0.032), (power, 0.029)])
def test_a_bend_is_measured(bend: Bend, worst: float) -> None:
    level, found = series(bend, np.array(TIMES))
    true = np.log(bend(level) / level)
    assert found == pytest.approx(np.broadcast_to(true - true.mean(), found.shape), abs=0.006)
    assert np.nanmax(np.abs(found)) == pytest.approx(worst, rel=0.2)


def test_a_flickering_lamp_tilts_the_line_and_bends_nothing() -> None:
    """2 % from frame to frame leaves a power of 0.8 %, as uncertain as the times; the patches' own tale stays."""
    level, flickering = series(straight, np.array(TIMES), frame_error=0.02)
    assert np.nanmax(np.abs(flickering)) < 0.03
    _, bent = series(knee, np.array(TIMES), frame_error=0.02)
    true = np.log(knee(level) / level)
    assert bent - flickering == pytest.approx(np.broadcast_to(true - true.mean(), bent.shape), abs=0.006)


def test_rounded_times_are_read_as_the_stops_they_stand_for() -> None:
    stops = 2.0 ** (np.arange(-8, 1) / 3)
    nominal = np.array([0.15625, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0])
    _, found = series(straight, stops, nominal)
    assert np.nanmax(np.abs(found)) < 0.003


def test_levels_without_patches_are_left_open() -> None:
    reflectance = np.full((1, 300, 3), 1.0)
    _, found = deviations(np.array([0.4, 0.5, 0.6])[:, None, None] * reflectance, np.array([0.4, 0.5, 0.6]))
    measured = np.isfinite(found[0])
    assert 2 <= measured.sum() < 6
    assert np.abs(found[:, measured]).max() < 1e-5
    assert np.isnan(deviations(0.001 * reflectance.repeat(4, axis=0), np.arange(1.0, 5))[1]).all()


def test_frames_that_do_not_follow_their_times_are_far_off() -> None:
    """As with a flash, or a camera that exposes by itself."""
    reflectance = np.exp(np.random.default_rng(1).uniform(-3, 0, (1, 500, 3)))
    assert np.nanmax(np.abs(deviations(0.7 * reflectance.repeat(5, axis=0), np.arange(1.0, 6))[1])) > 0.5


# In the simulated lab: frames of the chart in its place, as many seconds as their files say.


def write_series(lab: Lab, folder: Path, bend: Bend = straight, times: tuple[float, ...] = TIMES) -> Path:
    black, top = lab.world.body.black, lab.world.body.saturation

    def paint(counts: npt.NDArray[np.uint16]) -> None:
        share = np.maximum(counts.astype(np.float64) - black, 0) / (top - black)
        bent = black + bend(share) * (top - black) + np.minimum(counts.astype(np.float64) - black, 0)
        counts[:] = np.rint(bent).astype(np.uint16)

    folder.mkdir()
    for number, seconds in enumerate(times):
        data = lab.dng(WHITE, 100 + number, ExposureSettings(100, 8.0, seconds), paint)
        (folder / f"{number}.dng").write_bytes(data)
    return folder


def shown(result: BuildResult) -> tuple[str, str]:
    return next((row.value, row.note) for row in summary(result.figures) if row.name == "Linearity")


def test_the_table_says_how_linear_its_camera_is(
    session: Session, built: BuildResult, lab: Lab, tmp_path: Path
) -> None:
    folder = write_series(lab, tmp_path / "series")
    result = build(session, tmp_path / "lut", report=figures_alone, linearity=folder)
    written = json.loads((tmp_path / "lut" / "report.json").read_text())
    assert written["figures"]["linearity"] < 0.005
    assert len(written["channels"]["linearity"]) == 10
    assert shown(result)[0].endswith("from a straight line at most")
    assert "8 exposures" in shown(result)[1]
    # The series says nothing of the samples, so it changes none of the table's bytes.
    assert built.lut is not None
    # Without it the primaries say so.
    assert shown(built)[0].endswith("from proportion")
    assert built.figures.sensor.superposition.measured
    for name in ("samples.npy", "illuminations.csv", "lut.json"):
        assert (tmp_path / "lut" / name).read_bytes() == (built.lut / name).read_bytes()


@pytest.mark.usefixtures("lens_unmeasured")
def test_a_sensor_that_bends_is_remarked_on(session: Session, lab: Lab, tmp_path: Path) -> None:
    result = check(session, linearity=write_series(lab, tmp_path / "series", knee))
    row = next(row for row in result.verdict.rows if row.figure.name == "linearity")
    assert row.outcome == "accept with remarks"
    assert 0.01 < row.value < 0.05


@pytest.mark.usefixtures("lens_unmeasured")
def test_what_is_no_series_is_refused(
    session: Session, lab: Lab, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="No such file"):
        check(session, linearity=tmp_path / "nowhere")
    few = write_series(lab, tmp_path / "few", times=TIMES[:3])
    with pytest.raises(InputError, match="3 files, at least 4"):
        check(session, linearity=few)
    one = write_series(lab, tmp_path / "one", times=(0.5,) * 4)
    with pytest.raises(InputError, match="1 different"):
        check(session, linearity=one)
    (one / "3.dng").write_bytes(lab.dng(WHITE, 9, ExposureSettings(200, 8.0, 0.2)))
    with pytest.raises(FormatError, match=r"3\.dng .*ISO 200"):
        check(session, linearity=one)
    (one / "0.dng").write_text("notes")
    assert main(["check", "--linearity", str(one), str(session.folder)]) == 2
    assert "0.dng cannot be read as a raw file" in capsys.readouterr().err


@pytest.mark.usefixtures("lens_unmeasured")
def test_a_chart_that_stands_elsewhere_is_refused(session: Session, tmp_path: Path) -> None:
    moved = hang(room=Room(waviness_mm=0.5, roll_deg=0.7, fill=0.935))
    with pytest.raises(FormatError, match=r"0\.dng: the chart"):
        check(session, linearity=write_series(moved, tmp_path / "series"))
