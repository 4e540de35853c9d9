"""One bad frame does not cost the session: its light is taken again, and then there is a table."""

from __future__ import annotations

import hashlib
import json
import re
from datetime import timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.pipeline.build import build
from calibration.report.report import write_report
from drivers.camera import CapturedFrame
from experiment.session.folder import Session
from experiment.session.journal import ReceivedFile
from experiment.session.records import Judgement, SessionStep, plan_steps
from foundation.errors import FormatError, InputError, QualityError
from tests.calibration.lab import LIGHTS, SETTINGS, TAKEN_AT, Lab, Paint, figures_alone, take

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn", "lens_unmeasured")]

SHORT = LIGHTS[:3]
COMMAND = "acquire run LAB.toml SESSION --retake bad"


def shadow(counts: npt.NDArray[np.uint16]) -> None:
    """Lay a shadow on the middle of the print."""
    height, width = counts.shape
    part = counts[2 * height // 5 : 3 * height // 5, 2 * width // 5 : 3 * width // 5]
    part[...] = (part * 0.6).astype(np.uint16)


def nothing(counts: npt.NDArray[np.uint16]) -> None:
    """Let no light in."""
    counts[...] = counts.min()


def doctored(lab: Lab, folder: Path, kind: str, number: int | None, paint: Paint) -> Session:
    """Return a session in which one light's frame, or every white frame but the first, is painted."""

    def frame(step: SessionStep) -> bytes:
        chosen = step.kind == kind and step.illumination == number and step.number > 0
        return lab.dng(step.colour, step.number, paint=paint if chosen else None)

    return take(lab, folder, SHORT, frame=frame)


def take_again(lab: Lab, folder: Path) -> list[str]:
    """Take what `--retake bad` says; return the names of the steps."""
    with Session.open_for_run(folder) as session:
        session.retake("bad")
        steps = [step for step in plan_steps(SHORT, 25) if step.number not in session.done_steps()]
        for step in steps:
            at = TAKEN_AT + timedelta(hours=1, seconds=step.number)
            path = session.frames_folder / f"{step.stem}_try2.dng"
            attempt = session.journal.begin(step, f"frames/{path.stem}", at)
            data = lab.dng(step.colour, 100 + step.number)
            path.write_bytes(data)
            captured = CapturedFrame(path.name, len(data), at)
            received = ReceivedFile(path, len(data), hashlib.sha256(data).hexdigest(), captured)
            session.journal.commit(attempt, received, Judgement(()), exposure_s=SETTINGS.shutter_s, ended_at=at)
    return [step.stem for step in steps]


@pytest.mark.parametrize(
    ("kind", "number", "stem", "lights"),
    [
        ("light", 1, "0003_light_001", "1"),
        # Cells that are dark in the mean of the white frames are listed as stained, and known to be that frame's.
        ("white", None, "0005_white", ""),
    ],
)
def test_a_shadow_on_one_frame_costs_that_frame(
    lab: Lab, tmp_path: Path, kind: str, number: int | None, stem: str, lights: str
) -> None:
    folder, out = tmp_path / "session", tmp_path / "lut"
    with (
        doctored(lab, folder, kind, number, shadow) as session,
        pytest.raises(QualityError, match=rf"1 frame again: {COMMAND}.*report"),
    ):
        build(session, out, report=write_report if kind == "light" else figures_alone)
    says = json.loads((tmp_path / "lut.refused" / "report.json").read_text())
    assert (says["retake"], len(says["retake_sha256"])) == (lights, 1)
    if kind == "light":
        page = re.sub("</?span[^>]*>", "", (tmp_path / "lut.refused" / "report.html").read_text())
        assert f"To be taken again (1 frame): frames/{stem}.dng; <code>{COMMAND}</code>." in page
    assert take_again(lab, folder) == [stem]
    with Session.open(folder) as session:
        build(session, out, report=figures_alone)
    says = json.loads((out / "report.json").read_text())
    assert (says["retake"], says["retake_sha256"]) == ("", [])
    with pytest.raises(InputError, match="names no frame"):
        take_again(lab, folder)


def test_a_frame_that_ends_the_build_is_named_too(lab: Lab, tmp_path: Path) -> None:
    folder, out = tmp_path / "session", tmp_path / "lut"
    with (
        doctored(lab, folder, "light", 2, nothing) as session,
        pytest.raises(QualityError, match=rf"frames/0004_light_002\.dng again: {COMMAND}"),
    ):
        build(session, out)
    assert take_again(lab, folder) == ["0004_light_002"]
    with Session.open(folder) as session:
        build(session, out)


def test_what_the_next_run_finds_by_itself_needs_no_option(lab: Lab, tmp_path: Path) -> None:
    with take(lab, tmp_path / "session", SHORT) as session:
        victim = session.frames_folder / "0003_light_001.dng"
        data = bytearray(victim.read_bytes())
        data[-1] ^= 1
        victim.write_bytes(data)
        with pytest.raises(FormatError, match="by itself"):
            build(session, tmp_path / "lut")
    with Session.open_for_run(tmp_path / "session") as session:
        (reason,) = session.verify()
        assert reason.startswith("frames/0003_light_001.dng has changed")
