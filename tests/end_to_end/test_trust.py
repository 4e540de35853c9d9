"""A wrong LUT is never accepted: faults are refused, remarked on or harmless.

Each LUT is compared with the room patch by patch, with the noise of its 25 samples subtracted. A grid shifted by one
patch, a chart with another colour order or a hand in the light would be found.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.accuracy import TableErrors, beyond_noise, repeated_variance, table_errors
from benchmarks.rooms import random_case
from calibration.pipeline.build import build
from calibration.table.lut import open_lut
from calibration.verdict import BuildResult
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE, Colour
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from foundation.colorimetry import angles_deg
from foundation.errors import QualityError
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, hang, renumbered, take

pytestmark = pytest.mark.slow

FEW = renumbered([LIGHTS[4], LIGHTS[5], LIGHTS[0]])
# RMS relative error without noise that counts as wrong; colours of neighbours give at least 50 %.
WRONG = 0.02


@pytest.fixture(scope="module")
def lab() -> Lab:
    return hang()


def compared_with_truth(lab: Lab, session: Session, folder: Path) -> tuple[BuildResult, TableErrors]:
    """Build the LUT of a session, and compare it with the room."""
    result = build(session, folder / "lut")
    table = open_lut(folder / "lut")
    cells = lab.chart.centres_mm[lab.chart.cell_of_colour]
    frames = {frame.record.illumination: frame for frame in result.figures.frames if frame.record.kind == "light"}
    fields = [frames[number].paper.field.at(cells) for number in range(len(table.illuminations))]
    return result, table_errors(table, lab.world, lab.chart, fields, SETTINGS)


def worst_rms(errors: TableErrors) -> float:
    """Return the RMS relative error of fit patches from 100 counts on without noise, for the worst illuminant."""
    is_used = errors.where(100, np.inf)
    indices = range(len(errors.error))
    return max(beyond_noise(errors.error[[n]], errors.noise[[n]], is_used[[n]])[2] for n in indices if is_used[n].any())


def session_of(lab: Lab, folder: Path, frame: Callable[[SessionStep], bytes]) -> Session:
    return take(lab, folder / "session", FEW, every=2, frame=frame)


def is_first_light(step: SessionStep) -> bool:
    """Return whether a step is the first illuminant, between two white frames that do not show the fault."""
    return step.illumination == 0


def swapped(lab: Lab, second_lab: Lab) -> Callable[[SessionStep], bytes]:
    """Return frames of one room; the first illuminant is from another room."""
    return lambda step: (second_lab if is_first_light(step) else lab).dng(step.colour, step.number)


def exposed(lab: Lab, settings: Callable[[SessionStep], ExposureSettings]) -> Callable[[SessionStep], bytes]:
    """Return frames with different exposures."""
    return lambda step: lab.dng(step.colour, step.number, settings(step))


def shaded(lab: Lab, share: float) -> Callable[[SessionStep], bytes]:
    """Return frames; the first illuminant has only `share` of its light on part of the print."""
    visible = lab.world.body.visible
    area = np.s_[visible.top + 180 : visible.top + 300, visible.left + 300 : visible.left + 420]

    def frame(step: SessionStep) -> bytes:
        def shade(counts: npt.NDArray[np.uint16]) -> None:
            if is_first_light(step):
                light = counts[area].astype(np.float64) - lab.world.body.black
                counts[area] = (lab.world.body.black + share * light).astype(np.uint16)

        return lab.dng(step.colour, step.number, paint=shade)

    return frame


def test_patches_have_only_noise_errors(lab: Lab, tmp_path: Path) -> None:
    """3 700 means above 300 counts; 0.3 % for field, response and bleed, plus 0.1 % by chance in 10⁴ runs."""
    with take(lab, tmp_path / "session", LIGHTS, every=6) as session:
        _, errors = compared_with_truth(lab, session, tmp_path)
        table = open_lut(tmp_path / "lut")
    total_rms, noise_rms, systematic, _ = beyond_noise(errors.error, errors.noise, errors.where(300, np.inf))
    assert systematic < 0.004, f"{total_rms:.4f} in total, {noise_rms:.4f} from noise"
    truth = np.array([lab.world.white(light.colour, SETTINGS) for light in LIGHTS])
    degrees = angles_deg(truth, table.white)
    assert np.median(degrees) < 0.1
    assert degrees.max() < 0.25
    for low, high in ((100, 300), (300, 1000), (1000, 3000)):
        # A thousand variances of 25 values: their mean has a standard error of 1 %; five of them are allowed.
        scatter = errors.scatter[errors.where(low, high)]
        assert len(scatter) > 1000
        assert scatter.mean() == pytest.approx(1, abs=0.05)


def test_repeated_frames_differ_by_photons_and_read_noise(lab: Lab, tmp_path: Path) -> None:
    """The mean of 600 variances of 25 values has a standard error of 1.2 %; it fails by chance once in 10⁴ runs."""
    with take(lab, tmp_path / "session", renumbered([LIGHTS[5], LIGHTS[5]])) as session:
        _, errors = compared_with_truth(lab, session, tmp_path)
        result = open_lut(tmp_path / "lut")
        field = errors.level[0] * 0 + 1
    ratio = repeated_variance(
        result.samples[0], result.samples[1], errors.level[0], field, lab.world.body, SETTINGS.iso
    )
    for low, high in ((100, 1000), (1000, 10000)):
        is_used = (errors.level[0] >= low) & (errors.level[0] < high)
        assert is_used.sum() > 300
        assert ratio[is_used].mean() == pytest.approx(1, abs=0.08)


def test_random_room_is_refused_or_right(tmp_path: Path) -> None:
    """A small chart in a room of `benchmarks.rooms`, so near that its patches have the pixels of a full chart."""
    seed = 101
    room = replace(random_case(seed).room, ambient=0.0)
    lab_of_room = hang(room=room, seed=seed)
    with take(lab_of_room, tmp_path / "session", FEW, every=2) as session:
        try:
            result, errors = compared_with_truth(lab_of_room, session, tmp_path)
        except QualityError:
            return
    offset = result.figures.registration.to_pixels(lab_of_room.chart.centres_mm) - lab_of_room.world.project(
        lab_of_room.chart.centres_mm
    )
    assert np.linalg.norm(offset, axis=1).max() < 0.7
    assert worst_rms(errors) < WRONG


def test_refuses_exchange_of_chart(lab: Lab, tmp_path: Path) -> None:
    """The tags of both charts are at the same positions, so nothing seems to have moved."""
    frame = swapped(lab, hang(seed=7))
    with session_of(lab, tmp_path, frame) as session, pytest.raises(QualityError) as error:
        build(session, tmp_path / "lut")
    assert not (tmp_path / "lut").exists()
    assert re.search("print|poster|chart", str(error.value))


def test_remarks_on_faint_shadow(lab: Lab, tmp_path: Path) -> None:
    """6 % less light on a small area causes a remark, but no refusal."""
    with session_of(lab, tmp_path, shaded(lab, 0.94)) as session:
        result = build(session, tmp_path / "lut")
    assert "block_deviation" in {row.figure.name for row in result.verdict.remarks}


def test_flickering_lamp_harms_no_colour(lab: Lab, tmp_path: Path) -> None:
    """Every frame has another brightness; each ground truth comes from its own frame."""
    bright = {step: ExposureSettings(100, 8.0, 0.5 * (0.94 if step % 2 else 1.0)) for step in range(20)}
    frame = exposed(lab, lambda step: bright[step.number])
    with take(lab, tmp_path / "session", FEW, every=1, frame=frame) as session:
        result, errors = compared_with_truth(lab, session, tmp_path)
    assert worst_rms(errors) < WRONG
    assert result.verdict.outcome != "refuse"


def test_refuses_loss_of_focus(lab: Lab, tmp_path: Path) -> None:
    """A blur of 1.15 px changes dark patches by 4 %."""
    soft = hang(room=replace(lab.world.room, blur_px=1.15))
    with session_of(lab, tmp_path, swapped(lab, soft)) as session, pytest.raises(QualityError):
        build(session, tmp_path / "lut")


def test_lists_patches_of_clipped_frames(lab: Lab, tmp_path: Path) -> None:
    """White saturates the sensor, although its file records the usual exposure: no clipped sample counts as fit."""
    lights = renumbered([replace(LIGHTS[5], colour=WHITE), replace(LIGHTS[5], colour=Colour(90, 90, 90))])
    long = ExposureSettings(100, 8.0, 0.78)

    def frame(step: SessionStep) -> bytes:
        def brighten(counts: npt.NDArray[np.uint16]) -> None:
            if step.colour == WHITE:
                counts[:] = lab.world.expose(step.colour, long, key=(step.number,))

        return lab.dng(step.colour, step.number, paint=brighten)

    with take(lab, tmp_path / "session", lights, frame=frame) as session:
        try:
            result, errors = compared_with_truth(lab, session, tmp_path)
        except QualityError as error:
            assert "saturation" in str(error)  # noqa: PT017
            return
    table = open_lut(tmp_path / "lut")
    fit = table.samples[:, errors.clean]
    assert fit.max() < 1.2 * result.figures.sensor.white_level
    assert worst_rms(errors) < WRONG
