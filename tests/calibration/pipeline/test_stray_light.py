"""Room light that came and went between dark frames, and rooms in which it is there all the time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.cases import chart_of
from benchmarks.sessions import AS_PLANNED, FrameChange, light_named, short_plan, short_session, world_of
from benchmarks.troubles import TroubledWorld, Troubles, random_room, tried
from calibration.figures.all_figures import FIGURES
from calibration.figures.light import TOO_DARK
from calibration.pipeline.build import build
from calibration.pipeline.frames import BuildOptions
from calibration.report.report import summary
from calibration.verdict import BuildResult, judge, judged_values, remark
from drivers.presenter import Colour
from experiment.session.records import SessionStep
from sim.world.sensors import BODIES
from sim.world.world import Room, Situation
from tests.calibration.lab import SOFTWARE

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds")]

LIGHTS = {
    "red": Colour(255, 0, 0), "green": Colour(0, 255, 0), "blue": Colour(0, 0, 255), "white": Colour(255, 255, 255),
    "yellow": Colour(255, 180, 0), "warm": Colour(255, 164, 73),
}  # fmt: skip
REMARKING = [replace(limit, refuse=None) for limit in FIGURES]
"""Limits that refuse nothing, so that there are figures to look at."""
DAYLIGHT = Situation(ambient=(0.008, 0.01, 0.012))


def built(folder: Path, room: Room, leaking: frozenset[str] = frozenset(), subtract_dark: bool = False) -> BuildResult:
    chart, lights = replace(chart_of(small=True), software=SOFTWARE), short_plan(LIGHTS)
    leak = FrameChange(situation=DAYLIGHT)

    def changes(step: SessionStep) -> FrameChange:
        return leak if light_named(lights, step) in leaking else AS_PLANNED

    world = world_of(chart, BODIES["Test"], room)
    with short_session(folder / "session", chart, world, changes, lights) as session:
        return build(session, folder / "lut", options=BuildOptions(subtract_dark=subtract_dark), judged_by=REMARKING)


@pytest.mark.usefixtures("lens_unmeasured")
@pytest.mark.parametrize("leaking", [{"yellow"}, {"red", "blue", "warm"}], ids=["light", "primaries"])
def test_light_that_no_dark_frame_shows_is_the_rooms(tmp_path: Path, leaking: set[str]) -> None:
    result = built(tmp_path, Room(seed=3), frozenset(leaking))
    rows = {row.figure.name: row for row in result.verdict.remarks}
    assert "stray_share" in rows
    # One per cent of white in a deep light is degrees: no table is made of it.
    assert "stray_share" in {row.figure.name for row in judge(judged_values(result.figures)).refused}
    said = remark(rows["stray_share"], result.figures)
    assert "light of the room" in said
    stray = result.figures.lights.stray
    assert stray is not None
    assert ("yellow" in leaking) == (stray.lights_beyond(0.004) == [4])


@pytest.mark.usefixtures("lens_unmeasured")
@pytest.mark.parametrize(("seed", "ambient", "subtract"), [(6, 0.01, False), (7, 0.01, True)])
def test_light_that_is_always_there_is_not_remarked_on_here(
    tmp_path: Path, seed: int, ambient: float, subtract: bool
) -> None:
    result = built(tmp_path, Room(seed=seed, ambient=ambient, veil=0.003), subtract_dark=subtract)
    assert "stray_share" not in {row.figure.name for row in result.verdict.remarks}
    stray = result.figures.lights.stray
    assert stray is not None
    assert stray.share < 0.002
    (row,) = [row for row in summary(result.figures) if row.name == "Light that no dark frame shows"]
    assert "1 of 6 lights" in row.note


def test_a_sensor_that_compresses_white_does_not_hide_what_was_subtracted_too_much() -> None:
    _, says, table = tried(3, Troubles(compression=0.037, in_darks=(0.0017, 0.0058, 0.0036)), small=True)
    assert table is None
    assert says[0].startswith(f"{TOO_DARK.title}: 0.4")


def test_counts_lost_near_black_do_not_hide_a_veil(tmp_path: Path) -> None:
    chart, veil = chart_of(small=True), 0.012
    troubles = Troubles(lost=4.5, veil=(veil, veil, veil))
    world = TroubledWorld(world_of(chart, BODIES["Test"], random_room(1)), troubles)
    with short_session(tmp_path / "session", chart, world, every=3) as session:
        lens = build(session, tmp_path / "lut").figures.lens
    assert lens.veil_error < 0.0025
    assert lens.veil == pytest.approx(veil, abs=2 * lens.veil_error)
