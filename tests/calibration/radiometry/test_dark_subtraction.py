"""Leak and ambient light are taken out: by made-up counts whose truth is known, and in a room that is not dark."""

from __future__ import annotations

import json
from collections.abc import Generator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.cli import main
from calibration.pipeline.build import TableProgress, append, build, check
from calibration.pipeline.frames import BuildOptions
from calibration.radiometry.dark_frames import DarkLight, DarkLightEstimate, reflectances, winsorised_means
from calibration.report.report import summary
from calibration.table.lut import open_lut
from calibration.verdict import BuildResult
from drivers.presenter import BLACK
from experiment.measures.paper import FlatField, Paper
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from foundation.errors import FormatError
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, hang, renumbered, take

pytestmark = pytest.mark.slow

PATCHES = 4000
NOISE = np.array([6.0, 4.2, 6.0])
# Without the lens: a chart of 512 cells cannot tell room light from a veil.
SUBTRACTED = BuildOptions(subtract_dark=True, lens_correction=False)
_Array = npt.NDArray[np.float64]


def learnt(
    light: _Array, reflectance: _Array, frames: int, seed: int, beyond: _Array | float = 0.0
) -> tuple[DarkLightEstimate, DarkLight, _Array]:
    """Return estimate and dark light after dark frames of 25 samples, and the true dark light of the patches."""
    random = np.random.default_rng(seed)
    estimate = DarkLightEstimate.none(reflectance, np.ones(len(reflectance), dtype=bool), 25)
    truth = light * reflectance + beyond
    dark = DarkLight(light, truth.astype(np.float32), np.zeros(3))
    for _ in range(frames):
        means = truth + random.normal(0, 1, truth.shape) * NOISE / 5
        paper = Paper(FlatField.uniform((1.0, 1.0)), light, np.full(3, 0.05), 400, np.zeros(3))
        estimate, dark = estimate.with_frame(means, NOISE, paper, np.ones_like(reflectance))
    return estimate, dark, truth


@pytest.fixture
def reflectance() -> _Array:
    return np.random.default_rng(1).uniform(0.03, 0.9, (PATCHES, 3))


@pytest.mark.parametrize("frames", [1, 4])
def test_where_the_prediction_is_right_no_noise_is_added(reflectance: _Array, frames: int) -> None:
    """The share that is believed by chance: the robust variance of 4000 values is good to 3.7 %, 5 σ."""
    _, dark, truth = learnt(np.array([3.0, 8.0, 5.0]), reflectance, frames, 2)
    assert (dark.share < 0.19).all()
    assert ((dark.patches - truth).std(axis=0) < 0.2 * NOISE / 5 / np.sqrt(frames)).all()


def test_where_it_is_wrong_what_cells_show_is_believed(reflectance: _Array) -> None:
    """A lamp of another colour in the room: patches reflect it otherwise than the projector's light, by 10 %."""
    beyond = 30 * reflectance * np.random.default_rng(5).normal(0, 0.1, (PATCHES, 1))
    estimate, dark, truth = learnt(np.array([30.0, 30.0, 30.0]), reflectance, 8, 6, beyond)
    predicted = 30 * reflectance
    assert (dark.share > 0.7).all()
    assert ((dark.patches - truth).std(axis=0) < 0.5 * (predicted - truth).std(axis=0)).all()
    paper = Paper(FlatField.uniform((1, 1)), np.full(3, 30.0), NOISE, 9, NOISE)
    _, dark = estimate.restarted().with_frame(predicted, NOISE, paper, np.ones((1, 3)))
    assert dark.patches == pytest.approx(predicted, abs=0.01)


def test_a_hot_photosite_is_no_light() -> None:
    samples = np.random.default_rng(3).normal(2, 6, (50, 25, 3)).astype(np.float32)
    hot = samples.copy()
    hot[7, 3] += 900
    difference = np.abs(winsorised_means(hot, np.full(3, 6.0)) - winsorised_means(samples, np.full(3, 6.0)))
    assert difference[7].max() < 7 * 6 / 25 + 0.1
    assert not np.delete(difference, 7, axis=0).any()


def test_a_channel_without_light_borrows_its_reflectances() -> None:
    seen = np.array([[100.0, 4000.0, 1.0], [50.0, 400.0, -1.0]])
    found = reflectances(seen, np.ones((2, 3)), np.array([200.0, 8000.0, 0.5]))
    assert found.tolist() == [[0.5, 0.5, 0.5], [0.25, 0.05, 0.05]]


# A whole session: one hundredth of full white is there at all times, and a contrast of 1 : 200.


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


def test_table_and_ground_truth_are_those_of_a_dark_room(room: Lab, subtracted: BuildResult) -> None:
    assert subtracted.lut is not None
    table = open_lut(subtracted.lut)
    codes = room.chart.rgb[room.chart.cell_of_colour]
    black, body = room.world.white(BLACK, SETTINGS), room.world.body
    assert (black > 50).all()
    for light in LIGHTS:
        white = room.world.white(light.colour, SETTINGS) - black
        shown = white > 300
        seen = table.white[light.index]
        assert seen[shown] / seen[shown].max() == pytest.approx(white[shown] / white[shown].max(), rel=0.01)
        # A channel that the light lacks is left with nothing, to the noise of its references.
        assert (seen[~shown] < white[~shown] + 4 * subtracted.figures.lights.white_error[light.index][~shown]).all()
        true = room.world.reflected(codes, light.colour, SETTINGS) - room.world.reflected(codes, BLACK, SETTINGS)
        scale = (seen[shown] / white[shown]).mean()
        mean, true = table.samples[light.index].mean(axis=1)[:, shown], true[:, shown] * scale
        noise = np.sqrt((true + 100) / body.electrons_per_dn + body.read_noise_dn**2) / 5
        # 5 σ of 19 968 means (one false alarm in 90 runs), 1 % of the field, and the cut at 0 of the darkest cells.
        assert (np.abs(mean - true) < 5 * noise + 0.012 * true + 0.4 * 5 * noise).all()
        assert np.abs((mean - true).mean(axis=0)).max() < 0.003 * true.max()


def test_light_adds_when_the_dark_is_out(room: Lab, subtracted: BuildResult) -> None:
    assert subtracted.figures.lights.additivity is not None
    assert np.abs(subtracted.figures.lights.additivity.off).max() < 0.006
    assert "leak_share" not in {row.figure.name for row in subtracted.verdict.rows}
    note = next(row.note for row in summary(subtracted.figures) if row.name.startswith("Light while"))
    assert note.endswith("; subtracted from samples and ground truth")


def test_what_is_left_of_the_dark_light_is_as_large_a_share_of_any_cell(subtracted: BuildResult) -> None:
    """It is what a cell reflects of it; above paper it is no more than paper's."""
    figures = subtracted.figures
    (darkness,) = (one for one in figures.budget.components if one.name == "darkness")
    darker = (figures.cells.levels < 0.9).all(axis=1)
    assert darker.sum() > 30
    assert (np.ptp(darkness.cells[darker], axis=0) < 1e-9 * darkness.cells[darker].max(axis=0)).all()
    assert darkness.cells[darker].min() > 0


def test_samples_keep_their_noise(room: Lab, subtracted: BuildResult) -> None:
    assert subtracted.lut is not None
    light = next(light for light in LIGHTS if light.colour.red == light.colour.green == light.colour.blue == 255)
    samples = open_lut(subtracted.lut).samples[light.index].astype(np.float64)
    body, signal = room.world.body, samples.mean(axis=1) + room.world.white(BLACK, SETTINGS)
    for channel, photosites in ((0, 1), (1, 2), (2, 1)):
        response = (room.world.room.response_spread * signal[:, channel]) ** 2
        expected = (signal[:, channel] / body.electrons_per_dn + body.read_noise_dn**2 + response) / photosites
        spread = samples[..., channel].var(axis=1, ddof=1)
        # The median of 64 variances of 25 values is 0.97, good to 1.25 · √(2/24/64) = 4.5 %.
        assert np.median(spread / expected) == pytest.approx(0.97, abs=0.14)


def test_what_was_subtracted_is_recorded(room: Lab, session: Session, subtracted: BuildResult) -> None:
    assert subtracted.lut is not None
    done = json.loads((subtracted.lut / "lut.json").read_text())["corrections"]
    names = [correction["name"] for correction in done]
    assert names.index("black") < names.index("dark") < names.index("field")
    dark = np.array(done[names.index("dark")]["per_light"])
    black = room.world.white(BLACK, SETTINGS) * np.mean(room.world.field(room.chart.centres_mm))
    assert dark == pytest.approx(np.broadcast_to(black, dark.shape), rel=0.1)
    at_zero = done[names.index("rounding")]["share_at_zero"]
    assert len(at_zero) == len(LIGHTS)
    assert max(at_zero) > 0.01
    assert min(at_zero) < 0.001


def interrupted(session: Session, out: Path, options: BuildOptions) -> None:
    """Build until the seventeenth frame."""

    def progress(done: int, total: int, what: str) -> None:
        if done == 17:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(session, out, progress, options=options)


def test_a_growing_table_ends_in_the_same_bytes(session: Session, subtracted: BuildResult, tmp_path: Path) -> None:
    """Interrupted between two checkpoints, and with another choice in between, which begins anew."""
    assert subtracted.lut is not None

    interrupted(session, tmp_path / "lut", SUBTRACTED)
    done: list[int] = []
    grown = append(session, tmp_path / "lut", lambda number, total, what: done.append(number), options=SUBTRACTED)
    assert not isinstance(grown, TableProgress)
    assert done[1] == 17
    for path in subtracted.lut.iterdir():
        assert path.read_bytes() == (tmp_path / "lut" / path.name).read_bytes()


def test_a_checkpoint_of_another_choice_is_not_gone_on_from(session: Session, tmp_path: Path) -> None:
    interrupted(session, tmp_path / "lut", SUBTRACTED)
    interrupted(session, tmp_path / "lut", BuildOptions())
    done: list[int] = []
    build(session, tmp_path / "lut", lambda number, total, what: done.append(number), options=SUBTRACTED)
    assert done[:2] == [0, 1]


def test_without_dark_frames_it_is_refused(lab: Lab, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse_darks(step: SessionStep) -> str:
        return "refused" if step.kind == "dark" else "accepted"

    with take(lab, tmp_path / "session", LIGHTS[:2], verdict=refuse_darks) as session:
        for make in (build, append):
            with pytest.raises(FormatError, match=r"dark frame.*--subtract-dark"):
                make(session, tmp_path / "lut", options=SUBTRACTED)
        with pytest.raises(FormatError, match="no accepted dark frame"):
            check(session, SUBTRACTED)
    assert main(["--subtract-dark", str(tmp_path / "session"), str(tmp_path / "lut")]) == 2
    assert "take the session with acquire run" in capsys.readouterr().err
    assert not (tmp_path / "lut").exists()


def test_lights_before_the_first_dark_frame_take_the_first(room: Lab, tmp_path: Path) -> None:
    """A session put together from files may have its dark frames at the end."""

    def refuse_first(step: SessionStep) -> str:
        return "refused" if step.kind == "dark" and step.number < 3 else "accepted"

    with take(room, tmp_path / "session", renumbered(LIGHTS[5:8]), verdict=refuse_first) as session:
        result = build(session, tmp_path / "lut", options=SUBTRACTED)
    assert result.figures.lights.subtracted is not None
    assert (result.figures.lights.subtracted == result.figures.lights.subtracted[0]).all()
    assert (result.figures.lights.subtracted > 40).all()
