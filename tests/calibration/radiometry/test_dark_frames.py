"""Dark frames: synthetic counts with known light, and a session in a room with ambient light."""

from __future__ import annotations

import json
from collections.abc import Generator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.cli import main
from calibration.pipeline.build import TableProgress, append, build, check
from calibration.pipeline.frames import BuildOptions
from calibration.radiometry.dark_frames import (
    DarkFrameFigures,
    DarkLight,
    DarkLightEstimate,
    HotPixels,
    dark_summary,
    measure_dark_frame,
    reflectances,
    winsorised_means,
)
from calibration.report.report import summary
from calibration.table.lut import open_lut
from calibration.verdict import BuildResult
from drivers.presenter import BLACK
from experiment.measures.paper import FlatField, Paper
from experiment.session.folder import Session
from experiment.session.records import FrameRecord, SessionStep
from foundation.errors import FormatError
from foundation.records import from_plain, to_plain
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, hang, renumbered, take


def samples(count: int, level: tuple[float, float, float], seed: int) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).normal(level, 6.0, (count, 25, 3)).astype(np.float32)


def dark_frame(
    number: int, cells: npt.NDArray[np.float32], paper: npt.NDArray[np.float32], shape: npt.NDArray[np.float64]
) -> tuple[DarkFrameFigures, npt.NDArray[np.int16]]:
    at = datetime(2024, 3, 1, 9, number, tzinfo=UTC)
    record = FrameRecord("dark", None, f"{number}.dng", "00", at, 0.5, "accepted")
    return measure_dark_frame(record, np.full((2, 2), 2048.0 + number), cells, paper, shape)


def test_measures_leak_and_hot_photosites() -> None:
    shape = np.random.default_rng(1).uniform(0.8, 1.2, (400, 1)) * np.ones(3)
    hot, frames = HotPixels.start(2000, 25), list[DarkFrameFigures]()
    for number in range(3):
        cells, paper = samples(2000, (1, 2, 1), 10 + number), samples(400, (0, 0, 0), 20 + number)
        paper += (shape[:, None] * (4, 7, 5)).astype(np.float32)
        cells[17, 3, 1] += 200
        cells[99 + number, 5, 0] += 900
        figures, excess = dark_frame(number, cells, paper, shape)
        frames.append(from_plain(DarkFrameFigures, to_plain(figures), "a checkpoint", "start again"))
        hot = hot.with_frame(excess)
    dark = dark_summary(frames, hot)
    assert dark.light == pytest.approx([4, 7, 5], abs=4 * 6 / np.sqrt(400 * 25))
    assert (dark.error < 0.1).all()
    assert dark.noise == pytest.approx(6, rel=0.06)
    assert np.flatnonzero(dark.hottest).tolist() == [17]
    assert dark.hottest[17] == pytest.approx(200, abs=20)
    assert len(dark.blacks) == 3


def test_dark_light_of_two_frames_is_their_mean() -> None:
    paper = Paper(FlatField.uniform((1, 1)), np.array([4.0, 7.0, 5.0]), np.full(3, 0.1), 9, np.zeros(3))
    residual = np.random.default_rng(3).normal(0, 2, (50, 3))
    estimate = DarkLightEstimate.start(np.full((50, 3), 0.5), np.ones(50, dtype=bool), 25)
    results: list[DarkLight] = []
    for factor in (1.0, 3.0):
        means = 0.5 * paper.white + factor * residual
        estimate, light = estimate.with_frame(means, np.zeros(3), paper, np.ones((50, 3)))
        results.append(light)
    # Without noise the residual is used in full.
    np.testing.assert_allclose(results[0].patches, 0.5 * paper.white + residual, rtol=1e-5)
    np.testing.assert_allclose(results[1].patches, 0.5 * paper.white + 2 * residual, rtol=1e-5)


def test_keeps_hot_photosites_after_movement() -> None:
    """First patch 3 is on the hot photosite, then patch 4; a cosmic ray in one frame is ignored."""
    hot, noise = HotPixels.start(10, 25), np.full(3, 6.0)
    zeros = np.zeros((10, 25, 3), dtype=np.int16)
    for number in range(4):
        if number == 2:
            hot = hot.restarted(noise)
        excess = zeros.copy()
        excess[3 if number < 2 else 4, 12, 0] = 150
        excess[number, 1, 1] += 800
        hot = hot.with_frame(excess)
    assert np.flatnonzero(hot.hottest(noise)).tolist() == [3, 4]


def test_has_no_hot_photosites_without_frames() -> None:
    hot = HotPixels.start(4, 25)
    assert not hot.hottest(np.full(3, np.nan)).any()
    assert not hot.restarted(np.full(3, np.nan)).hottest(np.full(3, 6.0)).any()


def test_summary_without_frames_is_nan() -> None:
    assert np.isnan(dark_summary([], HotPixels.start(2, 25)).light).all()


# Subtraction of leak and ambient light.


PATCHES = 4000
NOISE = np.array([6.0, 4.2, 6.0])
# without lens correction: 512 patches cannot separate room light from veiling glare
SUBTRACTED = BuildOptions(subtract_dark=True, lens_correction=False)
_Array = npt.NDArray[np.float64]


def estimate_after(
    light: _Array, reflectance: _Array, frames: int, seed: int, residual: _Array | float = 0.0
) -> tuple[DarkLightEstimate, DarkLight, _Array]:
    """Return estimate and dark light after dark frames with 25 samples, and the true dark light."""
    random = np.random.default_rng(seed)
    estimate = DarkLightEstimate.start(reflectance, np.ones(len(reflectance), dtype=bool), 25)
    truth = light * reflectance + residual
    dark = DarkLight(light, truth.astype(np.float32), np.zeros(3))
    for _ in range(frames):
        means = truth + random.normal(0, 1, truth.shape) * NOISE / 5
        paper = Paper(FlatField.uniform((1.0, 1.0)), light, np.full(3, 0.05), 400, np.zeros(3))
        estimate, dark = estimate.with_frame(means, NOISE, paper, np.ones_like(reflectance))
    return estimate, dark, truth


@pytest.fixture
def reflectance() -> _Array:
    return np.random.default_rng(1).uniform(0.03, 0.9, (PATCHES, 3))


@pytest.mark.slow
@pytest.mark.parametrize("frames", [1, 4])
def test_adds_no_noise_to_correct_prediction(reflectance: _Array, frames: int) -> None:
    """Residuals get a small weight by chance: the robust variance of 4000 values is accurate to 3.7 %, 5 σ."""
    _, dark, truth = estimate_after(np.array([3.0, 8.0, 5.0]), reflectance, frames, 2)
    assert (dark.share < 0.19).all()
    assert ((dark.patches - truth).std(axis=0) < 0.2 * NOISE / 5 / np.sqrt(frames)).all()


@pytest.mark.slow
def test_uses_residuals_of_wrong_prediction(reflectance: _Array) -> None:
    """With a lamp of another colour, reflectances differ by 10 %."""
    residual = 30 * reflectance * np.random.default_rng(5).normal(0, 0.1, (PATCHES, 1))
    estimate, dark, truth = estimate_after(np.array([30.0, 30.0, 30.0]), reflectance, 8, 6, residual)
    predicted = 30 * reflectance
    assert (dark.share > 0.7).all()
    assert ((dark.patches - truth).std(axis=0) < 0.5 * (predicted - truth).std(axis=0)).all()
    paper = Paper(FlatField.uniform((1, 1)), np.full(3, 30.0), NOISE, 9, NOISE)
    _, dark = estimate.restarted().with_frame(predicted, NOISE, paper, np.ones((1, 3)))
    assert dark.patches == pytest.approx(predicted, abs=0.01)


@pytest.mark.slow
def test_winsorised_mean_ignores_hot_photosite() -> None:
    samples = np.random.default_rng(3).normal(2, 6, (50, 25, 3)).astype(np.float32)
    hot = samples.copy()
    hot[7, 3] += 900
    difference = np.abs(winsorised_means(hot, np.full(3, 6.0)) - winsorised_means(samples, np.full(3, 6.0)))
    assert difference[7].max() < 7 * 6 / 25 + 0.1
    assert not np.delete(difference, 7, axis=0).any()


@pytest.mark.slow
def test_dark_channel_gets_reflectance_of_brightest() -> None:
    measured = np.array([[100.0, 4000.0, 1.0], [50.0, 400.0, -1.0]])
    result = reflectances(measured, np.ones((2, 3)), np.array([200.0, 8000.0, 0.5]))
    assert result.tolist() == [[0.5, 0.5, 0.5], [0.25, 0.05, 0.05]]


# A session with ambient light of 1 % of full white, and a contrast of 200 : 1.


@pytest.fixture(scope="module")
def room() -> Lab:
    return hang(2, "A6", room=Room(waviness_mm=0.5, ambient=0.01, black_leak=1 / 200))


@pytest.fixture(scope="module")
def session(room: Lab, tmp_path_factory: pytest.TempPathFactory) -> Generator[Session]:
    with take(room, tmp_path_factory.mktemp("ambient") / "session", LIGHTS, every=4) as taken:
        yield taken


@pytest.fixture(scope="module")
def subtracted(session: Session, tmp_path_factory: pytest.TempPathFactory) -> BuildResult:
    return build(session, tmp_path_factory.mktemp("table") / "lut", options=SUBTRACTED)


@pytest.mark.slow
def test_lut_matches_dark_room(room: Lab, subtracted: BuildResult) -> None:
    assert subtracted.lut is not None
    table = open_lut(subtracted.lut)
    codes = room.chart.rgb[room.chart.cell_of_colour]
    black, body = room.world.white(BLACK, SETTINGS), room.world.body
    assert (black > 50).all()
    for light in LIGHTS:
        white = room.world.white(light.colour, SETTINGS) - black
        lit = white > 300
        rgb = table.white[light.index]
        assert rgb[lit] / rgb[lit].max() == pytest.approx(white[lit] / white[lit].max(), rel=0.01)
        # Channels without light are zero within the noise of the references.
        assert (rgb[~lit] < white[~lit] + 4 * subtracted.figures.lights.white_error[light.index][~lit]).all()
        true = room.world.reflected(codes, light.colour, SETTINGS) - room.world.reflected(codes, BLACK, SETTINGS)
        scale = (rgb[lit] / white[lit]).mean()
        mean, true = table.samples[light.index].mean(axis=1)[:, lit], true[:, lit] * scale
        noise = np.sqrt((true + 100) / body.electrons_per_dn + body.read_noise_dn**2) / 5
        # 5 σ of 19 968 means (one false alarm in 90 runs), 1 % of the field, and the clipping at 0 of dark patches
        assert (np.abs(mean - true) < 5 * noise + 0.012 * true + 0.4 * 5 * noise).all()
        assert np.abs((mean - true).mean(axis=0)).max() < 0.003 * true.max()


@pytest.mark.slow
def test_light_adds_after_subtraction(room: Lab, subtracted: BuildResult) -> None:
    assert subtracted.figures.lights.additivity is not None
    assert np.abs(subtracted.figures.lights.additivity.off).max() < 0.006
    assert "leak_share" not in {row.figure.name for row in subtracted.verdict.rows}
    note = next(row.note for row in summary(subtracted.figures) if row.name.startswith("Light while"))
    assert note.endswith("; subtracted from samples and ground truth")


@pytest.mark.slow
def test_remaining_dark_light_is_proportional(subtracted: BuildResult) -> None:
    """A patch reflects the remaining dark light as any light; brighter patches have no more than paper."""
    figures = subtracted.figures
    (darkness,) = (component for component in figures.budget.components if component.name == "darkness")
    darker = (figures.cells.levels < 0.9).all(axis=1)
    assert darker.sum() > 30
    assert (np.ptp(darkness.cells[darker], axis=0) < 1e-9 * darkness.cells[darker].max(axis=0)).all()
    assert darkness.cells[darker].min() > 0


@pytest.mark.slow
def test_keeps_noise_of_samples(room: Lab, subtracted: BuildResult) -> None:
    assert subtracted.lut is not None
    light = next(light for light in LIGHTS if light.colour.red == light.colour.green == light.colour.blue == 255)
    samples = open_lut(subtracted.lut).samples[light.index].astype(np.float64)
    body, signal = room.world.body, samples.mean(axis=1) + room.world.white(BLACK, SETTINGS)
    for channel, photosites in ((0, 1), (1, 2), (2, 1)):
        response = (room.world.room.response_spread * signal[:, channel]) ** 2
        expected = (signal[:, channel] / body.electrons_per_dn + body.read_noise_dn**2 + response) / photosites
        spread = samples[..., channel].var(axis=1, ddof=1)
        # The median of 64 variances of 25 values is 0.97, accurate to 1.25 · √(2/24/64) = 4.5 %.
        assert np.median(spread / expected) == pytest.approx(0.97, abs=0.14)


@pytest.mark.slow
def test_records_subtracted_light(room: Lab, session: Session, subtracted: BuildResult) -> None:
    assert subtracted.lut is not None
    corrections = json.loads((subtracted.lut / "lut.json").read_text())["corrections"]
    names = [correction["name"] for correction in corrections]
    assert names.index("black") < names.index("dark") < names.index("field")
    dark = np.array(corrections[names.index("dark")]["per_light"])
    black = room.world.white(BLACK, SETTINGS) * np.mean(room.world.field(room.chart.centres_mm))
    assert dark == pytest.approx(np.broadcast_to(black, dark.shape), rel=0.1)
    at_zero = corrections[names.index("rounding")]["share_at_zero"]
    assert len(at_zero) == len(LIGHTS)
    assert max(at_zero) > 0.01
    assert min(at_zero) < 0.001


def build_until_interrupted(session: Session, out: Path, options: BuildOptions) -> None:
    """Build up to the seventeenth frame."""

    def progress(number: int, total: int, task: str) -> None:
        if number == 17:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(session, out, progress, options=options)


@pytest.mark.slow
def test_resumed_build_gives_identical_files(session: Session, subtracted: BuildResult, tmp_path: Path) -> None:
    """The build is interrupted between two checkpoints."""
    assert subtracted.lut is not None

    build_until_interrupted(session, tmp_path / "lut", SUBTRACTED)
    numbers: list[int] = []
    appended = append(session, tmp_path / "lut", lambda number, total, task: numbers.append(number), options=SUBTRACTED)
    assert not isinstance(appended, TableProgress)
    assert numbers[1] == 17
    for path in subtracted.lut.iterdir():
        assert path.read_bytes() == (tmp_path / "lut" / path.name).read_bytes()


@pytest.mark.slow
def test_ignores_checkpoint_with_other_options(session: Session, tmp_path: Path) -> None:
    build_until_interrupted(session, tmp_path / "lut", SUBTRACTED)
    build_until_interrupted(session, tmp_path / "lut", BuildOptions())
    numbers: list[int] = []
    build(session, tmp_path / "lut", lambda number, total, task: numbers.append(number), options=SUBTRACTED)
    assert numbers[:2] == [0, 1]


@pytest.mark.slow
def test_refuses_subtraction_without_dark_frames(lab: Lab, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse_darks(step: SessionStep) -> str:
        return "refused" if step.kind == "dark" else "accepted"

    with take(lab, tmp_path / "session", LIGHTS[:2], verdict=refuse_darks) as session:
        for build_lut in (build, append):
            with pytest.raises(FormatError, match=r"dark frame.*--subtract-dark"):
                build_lut(session, tmp_path / "lut", options=SUBTRACTED)
        with pytest.raises(FormatError):
            check(session, SUBTRACTED)
    assert main(["--subtract-dark", str(tmp_path / "session"), str(tmp_path / "lut")]) == 2
    assert "take the session with acquire run" in capsys.readouterr().err
    assert not (tmp_path / "lut").exists()


@pytest.mark.slow
def test_uses_first_dark_frame_for_earlier_illuminants(room: Lab, tmp_path: Path) -> None:
    """An imported session may have its dark frames at the end."""

    def refuse_first(step: SessionStep) -> str:
        return "refused" if step.kind == "dark" and step.number < 3 else "accepted"

    with take(room, tmp_path / "session", renumbered(LIGHTS[5:8]), verdict=refuse_first) as session:
        result = build(session, tmp_path / "lut", options=SUBTRACTED)
    assert result.figures.lights.subtracted is not None
    assert (result.figures.lights.subtracted == result.figures.lights.subtracted[0]).all()
    assert (result.figures.lights.subtracted > 40).all()
