"""Sessions of eight lights in which something is wrong that each frame alone does not show: each has its own cause."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.pipeline.build import build
from calibration.report.report import summary
from calibration.verdict import BuildResult
from drivers.presenter import WHITE, Colour
from experiment.lights import Illumination
from experiment.session.records import SessionStep
from experiment.session.repair import lights_text
from foundation.errors import QualityError
from sim.world.sensors import BODIES
from sim.world.world import Room, World
from tests.calibration.lab import SETTINGS, Lab, figures_alone, hang, renumbered, take

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds")]

CODES = (
    Colour(255, 255, 255),
    Colour(255, 0, 0),
    Colour(0, 255, 0),
    Colour(0, 0, 255),
    Colour(255, 190, 100),
    Colour(170, 200, 255),
    Colour(255, 255, 0),
    Colour(110, 110, 110),
)
WHITE_LIGHT, RED, BLUE, WARM, COOL = 0, 1, 3, 4, 5
EIGHT = tuple(Illumination(index, "uniform", None, colour) for index, colour in enumerate(CODES))
ABOUT_NAMES = {
    "off_codes_deg", "off_brightness", "exchanged_lights", "exchange_deg", "cross_checked_share", "white_frame_deg",
    "white_frame_brightness", "white_deficit", "additivity", "other_camera", "other_lens", "other_exposure",
    "primaries_lacking",
}  # fmt: skip
HALF = replace(SETTINGS, shutter_s=SETTINGS.shutter_s / 2)

Frame = Callable[[SessionStep], bytes]


@pytest.fixture(scope="module")
def lab() -> Lab:
    """Return a lab of few colours: of these the lens is not measured, which takes longer than all that matters here."""
    return hang(2, "A6")


def built(
    lab: Lab, tmp_path: Path, frame: Frame | None = None, lights: tuple[Illumination, ...] = EIGHT
) -> BuildResult:
    with take(lab, tmp_path / "session", lights, frame=frame) as session:
        return build(session, tmp_path / "lut", report=figures_alone)


def refused(lab: Lab, tmp_path: Path, frame: Frame) -> tuple[str, dict[str, object]]:
    """Return why a session makes no table, and what its report says for programs."""
    with take(lab, tmp_path / "session", EIGHT, frame=frame) as session, pytest.raises(QualityError) as error:
        build(session, tmp_path / "lut", report=figures_alone)
    return str(error.value), json.loads((tmp_path / "lut.refused" / "report.json").read_text())


def remarks(result: BuildResult) -> set[str]:
    return {row.figure.name for row in result.verdict.remarks} & ABOUT_NAMES


def showing(lab: Lab, colours: Mapping[int, Colour]) -> Frame:
    """Return frames of a session in which some lights show other colours than their names say."""

    def frame(step: SessionStep) -> bytes:
        colour = step.colour if step.illumination is None else colours.get(step.illumination, step.colour)
        return lab.dng(colour, step.number)

    return frame


def test_a_session_with_nothing_wrong_has_no_remark(lab: Lab, tmp_path: Path) -> None:
    result = built(lab, tmp_path)
    assert remarks(result) == set()
    codes = result.figures.lights.codes
    assert codes is not None
    assert codes.held.all()
    assert codes.exchange_deg < 1
    assert codes.off_deg.max() == 0


def test_exchanged_lights_are_refused_and_both_named(lab: Lab, tmp_path: Path) -> None:
    """Any two are found by `tests/calibration/checks/test_light_codes.py`."""
    said, report = refused(lab, tmp_path, showing(lab, {WARM: CODES[COOL], COOL: CODES[WARM]}))
    assert f"exchanged names: light {WARM} and light {COOL}" in said
    assert "brilliant colour" not in said
    assert report["retake"] == lights_text([WARM, COOL])


def test_a_white_frame_that_is_red_is_refused_as_such(lab: Lab, tmp_path: Path) -> None:
    def frame(step: SessionStep) -> bytes:
        shown = CODES[RED] if step.kind == "white" and step.number == 0 else step.colour
        return lab.dng(WHITE if step.illumination == RED else shown, step.number)

    said, _ = refused(lab, tmp_path, frame)
    assert "White frame against what the lights predict" in said or "exchanged names: light 1 and white frame 0" in said
    assert "warm up" not in said


def test_two_lights_of_another_camera_are_refused(lab: Lab, tmp_path: Path) -> None:
    body = replace(BODIES["Test"], model="Other", sensitivities="Canon_EOS_200D")
    other = Lab(lab.chart, World(lab.world.sheet, body, lab.world.room))

    def frame(step: SessionStep) -> bytes:
        return (other if step.illumination in (WARM, COOL) else lab).dng(step.colour, step.number)

    said, report = refused(lab, tmp_path, frame)
    assert "Frames of another camera: 2" in said
    assert "Other" in said
    assert report["retake"] == "4-5"


def test_another_body_of_the_same_model_is_refused(lab: Lab, tmp_path: Path) -> None:
    def frame(step: SessionStep) -> bytes:
        if step.illumination != COOL:
            return lab.dng(step.colour, step.number)
        return lab.dng(step.colour, serial="42")

    said, _ = refused(lab, tmp_path, frame)
    # The body is told apart; its number is not told, unless the lab asks for it.
    assert "no. 42" not in said
    assert re.search(r"no\. [0-9a-f]{32}\b", said)


def test_lights_whose_files_state_another_exposure_are_refused(lab: Lab, tmp_path: Path) -> None:
    """Another ISO speed; another shutter time stands in the white frames of the test below."""

    def frame(step: SessionStep) -> bytes:
        off = step.illumination in (WARM, COOL)
        return lab.dng(step.colour, step.number, stated=replace(SETTINGS, iso=200) if off else SETTINGS)

    said, report = refused(lab, tmp_path, frame)
    assert "Exposure of a frame" in said
    assert "instead of 0.5 s, ISO 100, f/8" in said
    assert report["retake"] == "4-5"


def test_white_frames_at_half_exposure_are_no_brilliant_colour(lab: Lab, tmp_path: Path) -> None:
    said, report = refused(
        lab,
        tmp_path,
        lambda step: lab.dng(step.colour, step.number, HALF if step.kind == "white" else SETTINGS),
    )
    assert "Exposure of a frame" in said
    assert "additivity" not in report["figures"]  # pyrefly: ignore[not-iterable]


def test_a_white_frame_at_half_exposure_that_does_not_say_so(lab: Lab, tmp_path: Path) -> None:
    def frame(step: SessionStep) -> bytes:
        exposed = HALF if step.kind == "white" else SETTINGS
        return lab.dng(step.colour, step.number, exposed, stated=SETTINGS)

    said, report = refused(lab, tmp_path, frame)
    assert "white" in said
    rows = {limit["name"] for limit in report["limits"] if limit["outcome"] != "accept"}  # pyrefly: ignore[not-iterable]
    assert "additivity" not in rows
    assert rows & {"white_frame_brightness", "white_deficit"}


def test_a_light_at_half_exposure_that_does_not_say_so(lab: Lab, tmp_path: Path) -> None:
    def frame(step: SessionStep) -> bytes:
        exposed = HALF if step.illumination == WHITE_LIGHT else SETTINGS
        return lab.dng(step.colour, step.number, exposed, stated=SETTINGS)

    said, report = refused(lab, tmp_path, frame)
    assert "light 0 by -50 %" in said
    assert report["retake"] == "0"


def test_a_session_without_red_says_what_was_not_measured(lab: Lab, tmp_path: Path) -> None:
    result = built(lab, tmp_path, lights=renumbered([light for light in EIGHT if light.index != RED]))
    assert remarks(result) == {"primaries_lacking"}
    assert ("Fields of the primaries", "not measured") in [(row.name, row.value) for row in summary(result.figures)]


def test_brilliant_colour_is_called_that(lab: Lab, tmp_path: Path) -> None:
    """A white segment adds three tenths of the least primary: frames of a projector that shows white brighter."""
    dim = hang(2, "A6", room=Room(waviness_mm=0.5, white_level_share=0.5))
    world = dim.world

    def frame(step: SessionStep) -> bytes:
        least = min(step.colour.red, step.colour.green, step.colour.blue)

        def add_white(counts: npt.NDArray[np.uint16]) -> None:
            if least:
                grey = world.expose(Colour(least, least, least), SETTINGS, key=(step.number, 1)).astype("float64")
                counts[:] = (counts + 0.3 * (grey - world.body.black)).clip(0, world.body.saturation).round()

        return dim.dng(step.colour, step.number, paint=add_white)

    assert remarks(built(dim, tmp_path, frame)) == {"additivity"}


def test_two_lights_are_held_against_each_other(lab: Lab, tmp_path: Path) -> None:
    pair = renumbered([EIGHT[WARM], EIGHT[COOL]])
    assert remarks(built(lab, tmp_path / "right", lights=pair)) <= {"cross_checked_share"}

    def frame(step: SessionStep) -> bytes:
        shown = {0: CODES[COOL], 1: CODES[WARM]}.get(step.illumination if step.illumination is not None else -1)
        return lab.dng(shown or step.colour, step.number)

    (tmp_path / "wrong").mkdir()
    with (
        take(lab, tmp_path / "wrong" / "session", pair, frame=frame) as session,
        pytest.raises(QualityError, match="light 0 and light 1"),
    ):
        build(session, tmp_path / "wrong" / "lut")
