"""Sessions of the simulated lab compared, from raw frames on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calibration.cli import main
from calibration.comparison.comparing import compare, table_of
from calibration.pipeline.build import build
from experiment.session.folder import Session
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, Lab, hang, take

pytestmark = pytest.mark.slow

FEW = LIGHTS[:7]


@pytest.fixture(scope="module")
def small() -> Lab:
    """Return a lab of few colours, whose lens is not measured: it has an error of its own, which is no noise."""
    return hang(2, "A6")


@pytest.fixture(scope="module")
def folders(small: Lab, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a session in the room of `small`, and one of another day: another sheet, other noise, a dimmer lamp."""
    place = tmp_path_factory.mktemp("compared")
    again = hang(2, "A6", room=Room(seed=7, waviness_mm=0.5, roll_deg=0.6, white_level_share=0.69))
    for name, room in (("monday", small), ("friday", again)):
        take(room, place / name, FEW, every=4).close()
    return place / "monday", place / "friday"


def test_two_days_differ_in_brightness_alone(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "report"
    assert main(["compare", *map(str, folders), "--json", "--out", str(out)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [each["same_within_noise"] for each in document["answers"]] == [True, False, True]
    assert document["brightness"]["median"] == pytest.approx(0.69 / 0.7 - 1, abs=2.5e-3)
    assert {path.name for path in out.iterdir()} == {"report.html", "comparison.json", "cells.csv", "lights.csv"}
    page = (out / "report.html").read_text()
    assert "The cells on the print." in page, "a session has its chart"
    # Nothing stays beside the sessions.
    assert {path.name for path in folders[0].parent.iterdir()} == {"monday", "friday"}


def test_one_room_and_other_noise_are_the_same(folders: tuple[Path, Path], small: Lab, tmp_path: Path) -> None:
    with take(small, tmp_path / "again", FEW, every=4, frame=lambda step: small.dng(step.colour, 900 + step.number)):
        pass
    with table_of(folders[0]) as one, table_of(tmp_path / "again") as other:
        found = compare(one, other)
    assert found.same_within_noise
    assert float(found.lights.angle_deg.max()) < 0.05


def test_a_table_is_compared_with_a_session(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Session.open(folders[0]) as session:
        build(session, tmp_path / "lut")
    assert main(["compare", str(tmp_path / "lut"), str(folders[0])]) == 0
    assert "warning: both tables" in capsys.readouterr().out
