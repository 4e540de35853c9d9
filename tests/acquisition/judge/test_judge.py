"""Each disturbance is refused at its frame and named; what is no disturbance is accepted.

In a room; then, without one, what is said at limits and just beyond them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.judge import judge, limits
from acquisition.judge.judge import (
    CAUSES,
    MOST_RESTARTS,
    LiveJudge,
    crept,
    judge_dark,
    judge_first_frames,
    judge_first_primary,
    judge_white,
    lamp_check,
)
from acquisition.judge.measure import Frame
from acquisition.judge.state import (
    Basis,
    Examined,
    FrameLight,
    JudgeState,
    LampSeen,
    Leaning,
    ProjectorModel,
    Residuals,
    Seen,
)
from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, WHITE, Colour
from experiment.config import JudgeSettings, parse_lab
from experiment.framing.pictures import Shift
from experiment.measures.frame import SEGMENTS, TILE_COLUMNS, TILE_ROWS, Measured, Noise
from experiment.session.records import TOP, Check, Judgement, SessionStep, link_steps
from sim.world.disturbances import (
    AmbientStep,
    Bump,
    DeadPrimary,
    Defocus,
    HalfChanged,
    LampStep,
    Person,
    PopUp,
    ScrambledRows,
    ScreenSaver,
    ZeroedStrip,
)
from sim.world.sensors import BODIES
from sim.world.world import Room, Situation
from tests.acquisition.judge.conftest import EXPOSURE, FRAMES, LAB, Bench, bench
from tests.acquisition.judge.made_up import DARK, LIT, NOISE, PRIMARIES, TILES, begun, known, measured, picture
from tests.acquisition.judge.test_state import at

ORANGE, SKY, DEEP_BLUE = (255, 197, 126), (113, 188, 255), (0, 0, 255)
WHITE_STEP = SessionStep(901, "white", None, WHITE)
DARK_STEP = SessionStep(902, "dark", None, BLACK)


@pytest.fixture
def few(taught: Bench, tmp_path: Path) -> Bench:
    """Return a lab of a plan of six lights that has taken nothing yet, in the room that the others know."""
    lab = bench(tmp_path, Room(seed=3, wheel_hz=60, transfer=2.2), count=6, every=6)
    lab.world = taught.world
    return lab


@pytest.fixture(scope="module")
def earlier(taught: Bench, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[SessionStep, bytes]]:
    """Return what was measured of the frames of such a plan, but for its last pair, by a run that is over."""
    lab = bench(tmp_path_factory.mktemp("earlier"), Room(seed=3, wheel_hz=60, transfer=2.2), count=6, every=6)
    lab.world = taught.world
    kept: list[tuple[SessionStep, bytes]] = []
    for step in lab.steps[:-2]:
        judgement = lab.take(step)
        assert judgement.accepted
        kept.append((step, judgement.measurement))
    return kept


def resume(lab: Bench, earlier: list[tuple[SessionStep, bytes]]) -> Bench:
    """Return the lab of another run that has taken up what an earlier one took."""
    resumed = replace(lab, judge=LiveJudge(lab.settings, lab.chart, lab.lights))
    for step, measurement in earlier:
        resumed.judge.recall(step, measurement, True)
    return resumed


def cause(judgement: Judgement) -> str:
    return next((check.name for check in judgement.checks if check.reason), "")


def check(judgement: Judgement, name: str) -> Check:
    return next(found for found in judgement.checks if found.name == name)


@pytest.mark.slow
@pytest.mark.parametrize("codes", [SKY, DEEP_BLUE, (48, 255, 188)])
def test_a_light_that_was_ordered_is_accepted(taught: Bench, codes: tuple[int, int, int]) -> None:
    lab = taught.fork()
    said = [lab.take(lab.light(*codes)) for _ in range(2)]
    assert [judgement.reason for judgement in said] == ["", ""]
    assert said[0].seen is not None
    assert said[0].preview[:2] == b"\xff\xd8"


@pytest.mark.slow
@pytest.mark.parametrize(("shown", "ordered"), [(ORANGE, SKY), (SKY, ORANGE), ((255, 249, 255), (255, 245, 246))])
def test_the_light_of_the_frame_before_is_told(
    taught: Bench, shown: tuple[int, int, int], ordered: tuple[int, int, int]
) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*shown)).accepted
    stale = lab.take(lab.light(*shown))
    assert stale.accepted  # the same light ordered again is no fault
    frozen = lab.show(lab.counts(lab.light(*shown)), lab.light(*ordered))
    assert cause(frozen) == "off_codes_deg"
    assert "of the frame before" in frozen.reason
    assert str(shown) in frozen.reason


@pytest.mark.slow
def test_a_frozen_screen_lasts_at_the_third_frame(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*ORANGE)).accepted
    said = [lab.show(lab.counts(lab.light(*ORANGE)), lab.light(*SKY)) for _ in range(3)]
    assert [judgement.lasting for judgement in said] == [False, False, True]


@pytest.mark.slow
def test_another_light_of_the_plan_is_named(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*DEEP_BLUE)).accepted
    other = lab.lights[300].colour
    seen = lab.show(lab.counts(lab.light(*other)), lab.light(*ORANGE))
    assert cause(seen) == "off_codes_deg"
    assert str(tuple(other)) in seen.reason


@pytest.mark.slow
@pytest.mark.parametrize(("codes", "pixels"), [(ORANGE, 0.3), (DEEP_BLUE, 3.0), (ORANGE, 8.0)])
def test_a_bump_is_movement(taught: Bench, codes: tuple[int, int, int], pixels: float) -> None:
    lab = taught.fork()
    judgement = lab.take(lab.light(*codes), Bump(px=pixels))
    assert cause(judgement) == "movement"
    assert check(judgement, "movement").value == pytest.approx(pixels, rel=0.25)


@pytest.mark.slow
def test_a_small_bump_that_stays_is_followed_and_a_large_one_lasts(taught: Bench) -> None:
    lab = taught.fork()
    small = Bump(px=0.45)
    assert cause(lab.take(lab.light(*ORANGE), small)) == "movement"
    followed = lab.take(lab.light(*ORANGE), small)
    assert followed.accepted, followed.reason
    assert lab.take(lab.light(*SKY), small).accepted
    large = Bump(px=2)
    assert [lab.take(lab.light(*ORANGE), large).lasting for _ in range(3)] == [False, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("percent", [-3.0, -50.0])
def test_a_step_of_the_lamp_is_told_from_another_light(taught: Bench, percent: float) -> None:
    lab = taught.fork()
    judgement = lab.take(lab.light(*SKY), LampStep(percent=percent))
    assert cause(judgement) == "off_brightness"
    assert check(judgement, "off_brightness").value == pytest.approx(percent, abs=1.0)
    again = lab.take(lab.light(*SKY), LampStep(percent=percent))
    assert again.accepted == (percent == -3)
    if percent == -3:
        assert lab.take(lab.light(*ORANGE), LampStep(percent=percent)).accepted


@pytest.mark.slow
def test_light_in_the_room_is_told(taught: Bench) -> None:
    lit = AmbientStep(percent=1.0)
    lab = taught.fork()
    blue = lab.take(lab.light(*DEEP_BLUE), lit)
    assert cause(blue) == "stray_share", blue.reason
    assert check(blue, "stray_share").value == pytest.approx(1.0, rel=0.2)
    lab = taught.fork()
    dark = lab.take(DARK_STEP, lit)
    assert cause(dark) == "dark_drift"
    assert dark.voids
    lab = taught.fork()
    neutral = [lab.take(lab.light(*codes), lit) for codes in ((255, 245, 246), SKY)]
    assert not all(judgement.accepted for judgement in neutral)


@pytest.mark.slow
def test_a_covered_part_is_told_and_where(taught: Bench) -> None:
    lab = taught.fork()
    person = lab.take(lab.light(*ORANGE), Person(place=(-0.1, -0.1, 0.55, 0.55)))
    assert cause(person) == "uniformity"
    assert "top left" in person.reason
    lab = taught.fork()
    hand = lab.take(lab.light(*DEEP_BLUE), Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3))
    assert cause(hand) == "uniformity"
    assert "bottom right" in hand.reason


@pytest.mark.slow
def test_who_walks_past_is_no_chart_that_moved(taught: Bench) -> None:
    passing = taught.fork().take(WHITE_STEP, Person(place=(0.2, -0.2, 0.55, 1.2), left=0.9))
    assert cause(passing) == "uniformity"
    assert "walk past" in passing.reason
    # Nor does a chart that moved, or lost its focus, become somebody who passes.
    assert cause(taught.fork().take(WHITE_STEP, Bump(px=0.4))) == "movement"
    assert cause(taught.fork().take(WHITE_STEP, Defocus(px=0.5))) == "blur"


@pytest.mark.slow
@pytest.mark.parametrize(("codes", "share"), [(ORANGE, 1.0), (DEEP_BLUE, 0.3)])
def test_a_screen_saver_is_named(taught: Bench, codes: tuple[int, int, int], share: float) -> None:
    lab = taught.fork()
    drawn = lab.take(lab.light(*codes), ScreenSaver(share=share))
    assert cause(drawn) == "uniformity"
    assert "screen saver" in drawn.reason
    assert "cable" not in drawn.reason


@pytest.mark.slow
@pytest.mark.parametrize("codes", [ORANGE, (40, 180, 220)])
def test_a_primary_without_light_is_named(taught: Bench, codes: tuple[int, int, int]) -> None:
    lab = taught.fork()
    judgement = lab.take(lab.light(*codes), DeadPrimary())
    assert cause(judgement) == "off_codes_deg"
    assert "no red comes through" in judgement.reason
    # One that was dimmed, or another light that lacks red, is not called dead.
    for other in ((codes[0] // 2, *codes[1:]), (0, codes[1], codes[2] // 2)):
        lab = taught.fork()
        seen = lab.show(lab.counts(lab.light(*other)), lab.light(*codes))
        assert not seen.accepted
        assert "comes through" not in seen.reason


@pytest.mark.slow
def test_a_window_over_the_picture_is_told(taught: Bench) -> None:
    lab = taught.fork()
    judgement = lab.take(WHITE_STEP, PopUp())
    assert cause(judgement) == "uniformity"
    assert not judgement.voids  # every light since was judged by itself
    assert cause(lab.take(WHITE_STEP, PopUp(share=0.1))) == "uniformity"
    assert cause(lab.take(WHITE_STEP, PopUp(place=(-9, -9, 9, 9)))) == "off_codes_deg"


@pytest.mark.slow
def test_a_frame_given_twice_is_told_by_its_noise(taught: Bench) -> None:
    lab = taught.fork()
    step = lab.light(*ORANGE)
    counts = lab.counts(step)
    assert lab.show(counts, step).accepted
    assert cause(lab.show(counts, step)) == "repeated"
    assert cause(lab.show(counts, lab.light(*SKY))) == "repeated"
    # Passed on through something that changes a few counts: it is not the same file, but the same noise.
    changed = counts + (np.random.default_rng(1).random(counts.shape) < 0.2).astype(np.uint16)
    assert cause(lab.show(changed, step)) == "repeated"
    assert lab.take(step).accepted


@pytest.mark.slow
def test_missing_and_misplaced_rows_are_told(taught: Bench) -> None:
    lab = taught.fork()
    assert cause(lab.take(lab.light(*ORANGE), ZeroedStrip(top=0.5, bottom=0.51))) == "data"
    assert cause(lab.take(lab.light(*ORANGE), ScrambledRows())) == "rows"
    assert cause(lab.take(lab.light(*ORANGE), ScrambledRows(top=0.5, bottom=0.55))) == "rows"
    # Among the tags, whose edges look softer by it.
    torn = lab.take(lab.light(*ORANGE), ScrambledRows(top=0.3, bottom=0.35))
    assert (check(torn, "blur").value or 0) > 0.3
    assert cause(torn) == "rows"
    assert [found.name for found in torn.checks if found.reason] == ["rows"]


@pytest.mark.slow
def test_another_camera_exposure_or_file_is_told(taught: Bench, tmp_path: Path) -> None:
    lab = taught.fork()
    step = lab.light(*ORANGE)
    other = lab.show(lab.counts(step), step, serial="7")
    assert cause(other) == "other_camera"
    assert other.lasting
    body = replace(BODIES["Test"], model="CroP Other")
    assert cause(lab.show(lab.counts(step), step, body=body)) == "other_camera"
    assert cause(lab.show(lab.counts(step), step, settings=ExposureSettings(200, 8.0, 0.5))) == "settings"
    broken = tmp_path / "frame.dng"
    broken.write_bytes(b"II*\0 and no more")
    assert cause(lab.judge.judge(broken, step)) == "file"


@pytest.mark.slow
def test_dark_and_clipped_frames_are_told(taught: Bench) -> None:
    lab = taught.fork()
    assert cause(lab.show(lab.counts(DARK_STEP), lab.light(*ORANGE))) == "exposure"
    assert cause(lab.show(lab.counts(lab.light(*ORANGE)), DARK_STEP)) == "leak_share"
    bright = lab.world.expose(WHITE, replace(EXPOSURE, shutter_s=1.2), key=(5,))
    assert cause(lab.show(bright, WHITE_STEP)) == "clipping"


@pytest.mark.slow
def test_a_screen_that_stays_lit_is_told_in_the_dark_frame(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*ORANGE)).accepted
    assert "of the frame before" in lab.show(lab.counts(lab.light(*ORANGE)), DARK_STEP).reason


@pytest.mark.slow
@pytest.mark.parametrize("wanting", [1, 4])
def test_nothing_is_accepted_unseen_where_a_primary_or_the_dark_frame_is_wanting(few: Bench, wanting: int) -> None:
    green = SessionStep(903, "response", None, Colour(0, 250, 0))
    for step in few.steps[:5]:
        if step.number != wanting:
            assert few.take(step).accepted
        else:
            assert not few.show(few.counts(green), step).accepted
    # The screen stands still, and nothing would foretell its light.
    grey, light = few.steps[5], next(step for step in few.steps if step.kind == "light")
    unseen = [few.show(few.counts(green), step) for step in (grey, light)]
    assert [cause(judgement) for judgement in unseen] == ["off_codes_deg", "off_codes_deg"]
    assert "is accepted, from which it is known" in unseen[0].reason
    assert few.take(few.steps[wanting]).accepted
    assert [few.take(step).reason for step in (grey, light)] == ["", ""]
    assert cause(few.show(few.counts(green), light)) == "off_codes_deg"


@pytest.mark.slow
@pytest.mark.parametrize("passing", [0, 4])
def test_somebody_who_passes_in_a_frame_that_others_are_held_against_is_told(few: Bench, passing: int) -> None:
    hand = Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3)
    said = [few.take(step, *([hand] if step.number == passing else [])) for step in few.steps[:5]]
    assert [judgement.accepted for judgement in said] == [True] * 4 + [False]
    assert cause(said[4]) == "uniformity"
    assert said[4].voids
    light = next(step for step in few.steps if step.kind == "light")
    again = [few.take(step) for step in (*few.steps[:6], light)]
    assert [judgement.reason for judgement in again] == [""] * 7


@pytest.mark.slow
def test_somebody_who_passes_while_a_chart_that_moved_is_shown_the_primaries_is_told(
    few: Bench, earlier: list[tuple[SessionStep, bytes]]
) -> None:
    resumed = resume(few, earlier)
    elsewhere, hand = Bump(px=6.7), Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3)
    ties = link_steps(500)
    said = [resumed.take(step, elsewhere, *([hand] if step.number == 502 else [])) for step in ties[:4]]
    assert [judgement.voids for judgement in said] == [False, False, False, True]
    again = [resumed.take(step, elsewhere) for step in (*ties, resumed.light(*SKY))]
    assert [judgement.reason for judgement in again] == [""] * 7


@pytest.mark.slow
def test_a_session_whose_measurements_are_lost_goes_on(few: Bench) -> None:
    for step in few.steps[:2]:
        few.judge.recall(step, b"of another version", True)
    said = [few.take(step).reason for step in (*link_steps(500), few.light(*SKY), DARK_STEP, few.light(*SKY))]
    assert said == [""] * 9
    assert few.judge.state.modelled


@pytest.mark.slow
def test_a_run_taken_up_again_knows_what_was_seen(few: Bench, earlier: list[tuple[SessionStep, bytes]]) -> None:
    resumed = resume(few, earlier)
    assert resumed.judge.state.modelled
    # A day later the lamp is 3 % weaker: drift, no other light.
    weaker = LampStep(percent=-3)
    ties = [resumed.take(step, weaker) for step in link_steps(500)]
    assert [tie.reason for tie in ties] == [""] * 6
    assert check(ties[0], "off_brightness").value == pytest.approx(-3, abs=0.8)
    assert resumed.take(resumed.light(*SKY), weaker).accepted
    assert cause(resumed.show(resumed.counts(resumed.light(*SKY), weaker), resumed.light(*ORANGE))) == "off_codes_deg"
    assert cause(resumed.take(resumed.light(*SKY), LampStep(percent=-6))) == "off_brightness"
    # Another lamp is told before the first light is taken under it.
    tie = resume(few, earlier).take(link_steps(500)[0], LampStep(percent=-21))
    assert cause(tie) == "white_drift"
    assert tie.lasting


@pytest.mark.slow
def test_a_chart_that_moved_between_runs_is_told_and_followed(
    few: Bench, earlier: list[tuple[SessionStep, bytes]]
) -> None:
    resumed = resume(few, earlier)
    elsewhere = Bump(px=6.7, direction_deg=-27)
    said = [resumed.take(step, elsewhere) for step in link_steps(500)]
    assert all(judgement.accepted for judgement in said), [judgement.reason for judgement in said]
    assert check(said[0], "movement").value == pytest.approx(6.7, abs=0.3)
    later = resumed.take(resumed.light(*SKY), elsewhere)
    assert later.accepted, later.reason
    assert cause(resumed.take(resumed.light(*SKY))) == "movement"


@pytest.mark.slow
def test_without_response_frames_a_stale_light_is_told_and_others_are_not_refused(
    tmp_path: Path, taught: Bench
) -> None:
    lab = bench(tmp_path, Room(seed=3), count=6, every=3, response=False)
    lab.world = taught.world
    for step in lab.steps:
        assert (judgement := lab.take(step)).accepted, judgement.reason
    assert lab.take(lab.light(*SKY)).accepted
    assert cause(lab.show(lab.counts(lab.light(*SKY)), lab.light(*ORANGE))) == "off_codes_deg"
    person = lab.take(lab.light(*ORANGE), Person(place=(-0.1, -0.1, 0.55, 0.55)))
    assert cause(person) == "uniformity"


@pytest.mark.slow
def test_a_chart_that_is_not_there_is_said_in_the_first_frame(tmp_path: Path, taught: Bench) -> None:
    wall = taught.world.expose(Colour(0, 0, 0), EXPOSURE, key=(1,))
    wall[60:, 60:] += np.uint16(3000)
    lab = bench(tmp_path, Room(seed=3))
    judgement = lab.show(wall, WHITE_STEP)
    assert cause(judgement) == "chart"
    assert judgement.lasting
    bare = bench(tmp_path, Room(seed=3), lab=LAB + "[judge]\nchart = false\n")
    assert bare.show(wall, WHITE_STEP).accepted


@pytest.mark.slow
def test_a_projector_that_does_not_add_is_told_and_not_refused(tmp_path: Path, taught: Bench) -> None:
    lab = bench(tmp_path, Room(seed=3, wheel_hz=60, transfer=2.2), count=10, every=5)
    lab.world = taught.world

    def shown(colour: Colour) -> Situation:
        alone = lab.world.room.light_of(np.array(colour)) / 1.4
        return Situation(picture=(alone + 0.4 * alone.min()).astype(np.float32)[None, None])

    def take(step: SessionStep, colour: Colour | None = None) -> Judgement:
        key = (next(FRAMES),)
        return lab.show(lab.world.expose(step.colour, EXPOSURE, key=key, situation=shown(colour or step.colour)), step)

    said = [take(step) for step in lab.steps]
    assert [judgement.reason for judgement in said if judgement.reason] == []
    white = next(one for one, step in zip(said[::-1], lab.steps[::-1], strict=True) if step.kind == "white")
    assert check(white, "additivity").value == pytest.approx(40, abs=3)
    of_lights = [one for one, step in zip(said, lab.steps, strict=True) if step.kind == "light"]
    limits = [check(one, "off_codes_deg").high or 0 for one in of_lights]
    assert max(limits) > 0.8  # wider than where light adds
    assert cause(take(lab.light(*ORANGE), Colour(*SKY))) == "off_codes_deg"


@pytest.mark.slow
def test_a_picture_that_comes_late_is_told(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*SKY)).accepted
    late = lab.take(lab.light(*ORANGE), HalfChanged(place=(-9, -9, 9, 9), share=0.08), before=Colour(*SKY))
    assert cause(late) == "off_codes_deg"
    assert "of the frame before" in late.reason


@pytest.mark.slow
@pytest.mark.parametrize(("share", "said"), [(1.0, "for 100% of"), (0.3, "for 30% of")])
def test_a_part_that_still_shows_the_light_before_is_named_as_that(taught: Bench, share: float, said: str) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*SKY)).accepted
    part = HalfChanged(place=(-9, -9, 0.2, 0.2), share=share)
    uneven = lab.take(lab.light(*ORANGE), part, before=Colour(*SKY))
    assert cause(uneven) == "uniformity"
    assert "still showed the light of the frame before, " in uneven.reason
    assert said in uneven.reason


@pytest.mark.slow
def test_a_hand_is_named_as_one_also_where_the_light_before_was_darker(taught: Bench) -> None:
    hand = Person(place=(0.3, 0.4, 0.5, 0.6), left=0.3)
    for before in (SKY, (120, 77, 48)):
        lab = taught.fork()
        assert lab.take(lab.light(*before)).accepted
        uneven = lab.take(lab.light(*ORANGE), hand, before=Colour(*before))
        assert "does somebody or something stand before the chart" in uneven.reason
        assert "did only a part of the picture change?" in uneven.reason, "which a dark part may be, too"


@pytest.mark.slow
@pytest.mark.parametrize(("added", "told"), [(0.006, True), (0.003, False)])
def test_light_in_the_room_that_no_frame_tells_alone_is_told_by_two(added: float, told: bool) -> None:
    # In neutral lights, each of which may as well be a brighter lamp.
    leaning = Leaning(lamp=((0.003, 0.002),) * 2, added=((added, 0.0017),) * 2)
    assert (crept(leaning, 0.01) == ("", pytest.approx(added))) is told
    assert crept(replace(leaning, added=leaning.added[:1], lamp=leaning.lamp[:1]), 0.01) == ("", 0.0)


@pytest.mark.slow
def test_scrambled_rows_are_named_also_where_they_are_brighter(taught: Bench) -> None:
    for top in np.linspace(0.2, 0.8, 5).tolist():
        lab = taught.fork()
        assert cause(lab.take(lab.light(*ORANGE), ScrambledRows(top=top, bottom=top + 0.05))) == "rows", top


@pytest.mark.slow
def test_where_white_has_some_hundred_counts_noise_and_black_level_are_no_light(tmp_path: Path) -> None:
    lab = bench(tmp_path, Room(seed=14, wheel_hz=60, white_level_share=0.05), count=4, every=4)
    assert [said.reason for said in map(lab.take, lab.steps) if said.reason] == []
    assert lab.take(lab.light(*ORANGE)).accepted
    assert cause(lab.show(lab.counts(lab.light(*ORANGE)), lab.light(*SKY))) == "off_codes_deg"


@pytest.mark.slow
def test_a_first_frame_that_is_clipped_is_not_taken_again_and_again(tmp_path: Path) -> None:
    lab = bench(tmp_path, Room(seed=3, white_level_share=4.0))
    judgement = lab.take(WHITE_STEP)
    assert cause(judgement) == "clipping"
    assert judgement.lasting
    assert "dim the projector, or set a shorter exposure" in judgement.reason


@pytest.mark.slow
def test_a_light_too_dark_for_it_leaves_blur_to_the_next_reference(taught: Bench) -> None:
    lab = taught.fork()
    dim = lab.take(lab.light(0, 0, 56), Defocus(px=1))
    assert check(dim, "blur").value is None
    assert dim.accepted, dim.reason
    white = lab.take(WHITE_STEP, Defocus(px=1))
    assert cause(white) == "blur"
    assert white.voids


JUDGE = JudgeSettings()


def of_dark(state: JudgeState, frame: Measured) -> dict[str, Check]:
    return {check.name: check for check in judge_dark(state, frame, JUDGE.dark_percent, JUDGE.ambient_percent)}


def test_a_dark_frame_before_any_white_one_is_not_measured() -> None:
    assert judge_dark(JudgeState(), measured(LIT), JUDGE.dark_percent, JUDGE.ambient_percent) == (Check("leak_share"),)


@pytest.mark.parametrize(("percent", "passes"), [(4.9, True), (5.1, False)])
def test_a_dark_frame_is_held_against_white_in_its_worst_channel(percent: float, passes: bool) -> None:
    # Of what white adds to green; the others stay at 0.
    found = of_dark(known(first_dark=None), measured((0.0, 40.0 * percent, 0.0)))
    assert found["leak_share"].passed is passes
    assert found["leak_share"].value == pytest.approx(percent, abs=0.001)
    assert (found["leak_share"].high, found["leak_share"].unit) == (5.0, "%")
    assert "dark_drift" not in found, "there is no first dark frame that it could have changed from"


@pytest.mark.parametrize(("lit", "passes"), [(TILES // 20, True), (TILES // 10, False)])
def test_light_in_a_part_of_a_dark_frame_counts_from_six_of_a_hundred_tiles(lit: int, passes: bool) -> None:
    tiles = np.zeros((TILES, 3))
    tiles[:lit] = 0.06 * (np.array(LIT) - DARK)
    assert of_dark(known(first_dark=None), measured(tiles))["leak_share"].passed is passes


def test_where_white_hardly_lights_a_third_of_its_mean_stands_for_it() -> None:
    tiles = np.tile(np.array(LIT), (TILES, 1))
    tiles[: TILES // 5] = DARK
    state = replace(known(first_dark=None), white=measured(tiles))
    # 60 counts of green are 1.5 % of white where it lights, and 5.6 % of a third of its mean.
    unlit = np.zeros((TILES, 3))
    unlit[: TILES // 5, 1] = 60.0
    assert of_dark(state, measured(unlit))["leak_share"].value == pytest.approx(
        100 * 60 / (4000 * (1 - TILES // 5 / TILES) / 3), abs=1e-3
    )


@pytest.mark.parametrize("more", [True, False])
def test_a_lamp_in_a_corner_is_told_by_its_region(more: bool) -> None:
    """A corner of 4 × 4 tiles that changed by 1 % of white: a mean over all 24 regions would be below the limit."""
    grid = np.tile(np.array(DARK), (TILE_ROWS, TILE_COLUMNS, 1))
    grid[-4:, -4:] += (0.01 if more else -0.01) * (np.array(LIT) - DARK)
    found = of_dark(known(), measured(grid.reshape(TILES, 3)))
    assert found["leak_share"].passed
    assert not found["dark_drift"].passed
    assert found["dark_drift"].value == pytest.approx(1.0, abs=0.001)
    assert ("of white more" in found["dark_drift"].reason) is more
    assert ("of white less" in found["dark_drift"].reason) is not more
    assert of_dark(known(), measured(DARK))["dark_drift"] == Check("dark_drift", 0.0, None, 0.2, "%")


def test_the_change_that_is_allowed_in_the_dark_is_wider_where_noise_or_the_black_level_makes_one() -> None:
    def allowed(frame: Measured, white: npt.ArrayLike = LIT) -> float:
        return of_dark(replace(known(), white=measured(white)), frame)["dark_drift"].high or 0.0

    assert allowed(measured(DARK)) == JUDGE.ambient_percent
    # The black level's drift is .3 counts; σ is 40 counts, in 100 blocks of each of 16 tiles 1 count; white is 2000.
    noisy = Noise(1600.0, 0.0)
    assert allowed(measured(DARK, noise=noisy)) == pytest.approx(6 * 2**0.5 * np.hypot(0.05, 0.015), abs=1e-3)
    # Eight counts of 2000, the least of the three channels, where no border measures the black level.
    assert allowed(measured(DARK, black_measured=False)) == pytest.approx(0.4)
    # 0.3 counts of the black level, where white has 100.
    assert allowed(measured((0, 0, 0), noise=Noise(0.0, 0.0)), (110, 112, 111)) == pytest.approx(
        6 * 2**0.5 * 0.3, abs=1e-3
    )


def test_a_dark_frame_with_the_light_of_the_frame_before_is_named_a_screen_that_stands_still() -> None:
    dark = measured(DARK)
    basis = Basis.of_white(measured(LIT), dark)
    lit = measured(np.array(DARK) + 0.3 * (np.array(LIT) - DARK))
    orange = np.array([0.9, 0.5, 0.2])

    def seen(amounts: npt.NDArray[np.float64] | None) -> Check:
        state = known(basis=basis, recent=(Seen((255, 255, 255), lit, amounts),))
        (found,) = judge_dark(state, lit, JUDGE.dark_percent, JUDGE.ambient_percent)
        return found

    same, other, unknown = seen(basis.light(lit).amounts), seen(orange), seen(None)
    assert [found.name for found in (same, other, unknown)] == ["off_codes_deg", "leak_share", "leak_share"]
    assert not any(found.passed for found in (same, other, unknown))
    assert "stand still" in same.reason


@pytest.mark.parametrize("sign", [1, -1])
def test_paper_white_is_held_against_the_first_of_the_session(sign: int) -> None:
    paper = np.array([500.0, 1000.0, 700.0])
    first = Frame(measured(LIT), paper, np.zeros(2))

    def drift(percent: float) -> Check:
        # Another colour, of which the sum counts.
        now = paper * np.array([0.9, 1.0, 1.0])
        now[1] += paper.sum() * (1 + percent / 100) - now.sum()
        return judge_white(first, replace(first, paper=now))

    near, far = drift(sign * (limits.LAMP_TOTAL - 0.1)), drift(sign * (limits.LAMP_TOTAL + 0.1))
    assert (near.passed, far.passed) == (True, False)
    assert far.value == pytest.approx(sign * (limits.LAMP_TOTAL + 0.1), abs=0.01)
    assert (far.low, far.high) == (-limits.LAMP_TOTAL, limits.LAMP_TOTAL)


def test_white_without_paper_or_a_first_frame_is_not_measured() -> None:
    paper = Frame(measured(LIT), np.full(3, 500.0), np.zeros(2))
    unknown = replace(paper, paper=np.array([500.0, np.nan, 500.0]))
    for first, now in ((None, paper), (unknown, paper), (paper, unknown)):
        assert judge_white(first, now) == Check("white_drift")


@pytest.mark.parametrize("primary", [0, 1, 2])
def test_a_primary_is_told_by_its_own_channel(primary: int) -> None:
    white = np.array(LIT) - DARK
    levels = {name: np.full(3, 0.05) for name in ("own", "other", "black")}
    levels["own"][primary] = 0.8
    levels["other"][(primary + 1) % 3] = 0.8
    said = {
        name: judge_first_primary(known(), measured(DARK + share * white), primary) for name, share in levels.items()
    }
    assert {name: check.passed for name, check in said.items()} == {"own": True, "other": False, "black": False}
    assert [check.value for check in said.values()] == [80.0, 5.0, 5.0]
    assert "nearly black" in said["black"].reason
    assert f"more {('red', 'green', 'blue')[(primary + 1) % 3]}" in said["other"].reason


def test_a_primary_as_bright_as_white_is_a_screen_that_stands_still() -> None:
    as_white = np.array(LIT) - DARK
    still = judge_first_primary(known(), measured(DARK + np.array([0.96, 0.92, 0.94]) * as_white), 0)
    one_is_less = judge_first_primary(known(), measured(DARK + np.array([0.96, 0.89, 0.94]) * as_white), 0)
    assert (still.passed, one_is_less.passed) == (False, True)


@pytest.mark.parametrize(
    ("own", "other", "passes", "black"), [(0.11, 0, True, False), (0.09, 0, False, True), (0.11, 0.12, False, False)]
)
def test_a_primary_below_a_tenth_of_white_is_nearly_black(own: float, other: float, passes: bool, black: bool) -> None:
    share = np.array([0.0, own, other])
    found = judge_first_primary(known(), measured(DARK + share * (np.array(LIT) - DARK)), 1)
    assert (found.passed, "nearly black" in found.reason) == (passes, black)
    assert (found.low, found.high) == (10.0, None)
    # Without a dark frame the counts count as they are.
    bare = judge_first_primary(replace(known(), dark=None), measured(share * LIT), 1)
    assert (bare.value, bare.passed) == (pytest.approx(100 * own), passes)


def test_a_primary_before_any_white_frame_is_not_measured() -> None:
    assert judge_first_primary(JudgeState(), measured(DARK), 0) == Check("off_codes_deg")


LIGHT = SessionStep(20, "light", 0, Colour(255, 197, 126))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "name"),
    [
        ((1, 1, 1), None),
        ((1.2, 1, 1), "off_codes_deg"),
        ((1, 1, 0.8), "off_codes_deg"),
        (1.3, "off_brightness"),
        (0.7, "off_brightness"),
    ],
)
def test_the_first_white_frame_is_held_against_what_the_others_say_before_the_first_light(
    gain: npt.ArrayLike, name: str | None
) -> None:
    found = judge_first_frames(begun(gain), LIGHT, None, JUDGE)
    assert (None if found is None else found.name) == name
    if name == "off_brightness" and found is not None:
        assert found.value == pytest.approx(100 * (float(np.max(gain)) - 1), abs=2)
        assert found.low is not None
        assert found.low == -(found.high or 0) < -JUDGE.drift_percent
        assert f"{found.value:+.1f} % as bright" in found.reason


def test_the_first_white_frame_is_judged_at_the_first_light_alone_and_where_enough_is_known() -> None:
    odd = begun(1.3)
    assert judge_first_frames(odd, replace(LIGHT, kind="response"), None, JUDGE) is None
    assert judge_first_frames(replace(odd, founding=False), LIGHT, None, JUDGE) is None
    assert judge_first_frames(replace(odd, basis=None), LIGHT, None, JUDGE) is None
    assert judge_first_frames(replace(odd, first_frames=odd.first_frames[1:]), LIGHT, None, JUDGE) is None
    assert judge_first_frames(begun(1.3, greys=0), LIGHT, None, JUDGE) is None


def test_first_frames_are_doubted_where_a_step_contradicts_them_twice() -> None:
    uneven = Check("uniformity", 0.3, None, 0.02, "", "part is covered")
    state = begun()
    assert judge_first_frames(state, LIGHT, uneven, JUDGE) is None, "once may be anything"
    doubted = replace(state, doubted=frozenset({LIGHT.number}))
    found = judge_first_frames(doubted, LIGHT, uneven, JUDGE)
    assert found is not None
    assert (found.name, found.value, found.high) == ("uniformity", 0.3, 0.02)
    assert found.reason.startswith("part is covered; ")
    assert judge_first_frames(doubted, LIGHT, replace(uneven, name="file"), JUDGE) is None, "contradicts no frame"
    # A frame refused for want of the primaries has nothing that it could contradict.
    awaiting = replace(doubted, basis=None, asked=True)
    assert judge_first_frames(awaiting, LIGHT, Check("off_codes_deg", reason="is accepted"), JUDGE) is None
    assert judge_first_frames(awaiting, LIGHT, uneven, JUDGE) is not None
    assert judge_first_frames(doubted, LIGHT, Check("off_codes_deg", reason="is another"), JUDGE) is not None
    only_dark = replace(doubted, first_frames=(Seen((0, 0, 0), measured(DARK), None),))
    assert judge_first_frames(only_dark, LIGHT, uneven, JUDGE) is None, "of a dark frame nothing is learnt"


def test_first_frames_are_taken_again_as_often_as_a_passer_by_needs_and_then_somebody_is_asked() -> None:
    uneven = Check("uniformity", 0.3, None, 0.02, "", "part is covered")
    doubted = replace(begun(), doubted=frozenset({LIGHT.number}))
    said = [
        judge_first_frames(replace(doubted, restarts=restarts), LIGHT, uneven, JUDGE)
        for restarts in range(MOST_RESTARTS + 2)
    ]
    asked = ["do not agree" in found.reason for found in said if found is not None]
    assert asked == [False] * MOST_RESTARTS + [True, True]


def test_amounts_are_as_sure_as_the_noise_of_all_tiles_and_the_black_level() -> None:
    frame, basis = picture((200, 150, 100)), begun().basis
    assert basis is not None
    seen = frame.tiles[0] - DARK
    # Of 100 blocks to a tile, green twice a block; what else a tile is off by is 0.3 %.
    variance = NOISE.variance(frame.tiles[0]) / [100, 200, 100] + (0.003 * seen) ** 2
    gram: npt.NDArray[np.float64] = TILES * (PRIMARIES / variance) @ PRIMARIES.T
    by_noise = np.asarray(np.linalg.inv(gram), dtype=np.float64)
    # The black level of both frames is 0.3 counts off in all tiles alike.
    by_black = by_noise @ (TILES * PRIMARIES / variance)
    light = basis.light(frame)
    np.testing.assert_allclose(light.covariance, by_noise + 2 * 0.3**2 * by_black @ by_black.T)
    np.testing.assert_allclose(light.amounts, (np.array([200, 150, 100]) / TOP) ** 2.2, rtol=1e-9)


def test_more_light_is_no_room_s_light_where_the_lamp_scatters_as_much() -> None:
    codes, scatter = (255, 249, 255), 0.03
    first = begun()
    model = first.without_white()
    assert model is not None
    assert first.basis is not None
    light = first.basis.light(picture(codes, 1.08))

    def added(brightness_sd: float) -> tuple[float, float] | None:
        steady = replace(model, brightness=(100 * brightness_sd**2, 100.0))
        return judge._SeenLight(steady, light, codes, None, ())._added_of(None)

    assert added(scatter) is None
    found = added(0.0006)
    assert found is not None
    assert found[0] == pytest.approx(0.08, abs=0.01)


@pytest.mark.parametrize(
    ("rested", "candidate", "rests"),
    [(False, (np.nan, np.nan), (0.0, 0.0)), (False, (0.35, 0.0), (0.3, 0.0)), (True, (np.nan, np.nan), (0.3, 0.0))],
    ids=["creeps", "repeated", "after a pause"],
)
def test_a_chart_s_place_of_rest_is_another_only_if_it_is_shown_twice_or_after_a_pause(
    rested: bool, candidate: tuple[float, float], rests: tuple[float, float]
) -> None:
    frame = Frame(measured(LIT), np.full(3, 500.0), np.array([0.3, 0.0]))
    before = known(moved_px=np.zeros(2), rested=rested, candidate=(np.nan, *candidate))
    after = before.after(LIGHT, Examined(frame, None, True)).moved_px
    assert after is not None
    assert after.tolist() == list(rests)


Amounts = tuple[float, float, float]
FULL = (TOP, TOP, TOP)
SCATTER, TOGETHER, NO_LIGHT = 0.004, 0.002, 3e-4
"""Scatter of one amount, of all together, and of none, of a projector that is known exactly."""
MODEL = replace(ProjectorModel.unknown(), covariance=np.zeros_like(ProjectorModel.unknown().covariance))
SETTINGS = parse_lab('rig = "imported"\nchart = "c"\nilluminations = "l"\n', "LAB.toml")
NOTHING = np.zeros(0)


def seen_light(
    amounts: Amounts,
    codes: tuple[int, int, int] = FULL,
    before: tuple[tuple[int, int, int], Amounts | None] | None = None,
    plan: tuple[tuple[int, int, int], ...] = (),
) -> judge._SeenLight:
    light = FrameLight(np.array(amounts), np.zeros((3, 3)), Residuals(NOTHING, NOTHING, NOTHING))
    was = None if before is None else (None if before[1] is None else np.array(before[1]))
    frame = None if before is None else Seen(before[0], measured(LIT), was)
    return judge._SeenLight(MODEL, light, codes, frame, plan)


@pytest.mark.parametrize(
    ("codes", "amounts", "named"),
    [
        (FULL, (1, 1, 0.04), "blue"),
        (FULL, (1, 1, 0.06), None),
        (FULL, (0.04, 1, 0.04), "red and blue"),
        (FULL, (0.04, 0.04, 0.04), None),
        (FULL, (1.02, 1, 0.04), "blue"),  # 5.5 deviations of 0.0045 are 0.0246
        (FULL, (1.03, 1, 0.04), None),
        ((TOP, TOP, 24), (1, 1, 0), "blue"),  # 0.0058 of it was ordered
        ((TOP, TOP, 21), (1, 1, 0), None),  # 0.0043
    ],
)
def test_a_primary_is_missing_below_a_twentieth_where_the_others_are_as_ordered(
    codes: tuple[int, int, int], amounts: Amounts, named: str | None
) -> None:
    said = seen_light(amounts, codes)._missing()
    assert said.startswith(f"no {named} comes through") if named else not said


@pytest.mark.parametrize(
    ("more", "added"),
    [
        ((0.03, 0, 0), 0.01),
        ((0.03, 0, -0.013), 0.017 / 3),  # three deviations of 0.0045 are 0.0134
        ((0.03, 0, -0.014), 0),
        ((0.29, 0, 0), 0.29 / 3),
        ((0.31, 0, 0), 0),  # more than a tenth of white
        ((0.0117, 0, 0), 0),  # 0.0039 of white
        ((0.0123, 0, 0), 0.0041),
    ],
)
def test_coloured_light_is_what_takes_from_no_primary(more: Amounts, added: float) -> None:
    red, green, blue = more
    assert seen_light((1 + red, 1 + green, 1 + blue))._coloured() == pytest.approx(added)


def test_neutral_light_is_weighed_by_what_scatters_of_the_light_itself() -> None:
    added, sd = seen_light((0.01, 0.02, 0.03), (0, 0, 0)).neutral_light()
    assert (added, sd) == pytest.approx((0.02, NO_LIGHT / 3**0.5))
    added, sd = seen_light((1.01, 1.02, 1.03)).neutral_light()
    own = SCATTER**2 + NO_LIGHT**2
    assert (added, sd) == pytest.approx((0.02, np.sqrt(own / 3 + TOGETHER**2)))


@pytest.mark.parametrize(
    ("codes", "amounts", "added"),
    [
        ((0, 0, 0), (0.0021, 0.0021, 0.0021), 0.0021),
        ((0, 0, 0), (0.0019, 0.0019, 0.0019), None),
        ((0, 0, 0), (0.01, 0.01, 0.0119), 0.01 + 0.0019 / 3),
        ((0, 0, 0), (0.01, 0.01, 0.0122), None),  # two thirds of 0.0022² are more than 30 of 0.0003²
        (FULL, (1.0137, 1.0137, 1.0137), 0.0137),  # four deviations are 0.0129
        (FULL, (1.0120, 1.0120, 1.0120), None),
    ],
)
def test_light_is_added_where_it_explains_what_is_seen(
    codes: tuple[int, int, int], amounts: Amounts, added: float | None
) -> None:
    found = seen_light(amounts, codes)._added_of(None)
    assert (None if found is None else found[0]) == (None if added is None else pytest.approx(added))


def test_a_share_of_the_frame_before_remains_in_this_one() -> None:
    blue: tuple[tuple[int, int, int], Amounts] = ((0, 0, TOP), (0, 0, 1))
    light = seen_light((0.9, 0.9, 0.1), (TOP, TOP, 0), blue)
    found = light._added_of(light.before)
    assert found == (pytest.approx(0.1), pytest.approx(0, abs=1e-6))
    reason, added = light.cause(True, 0.01, again=False)
    assert reason.startswith("10.0 % of the light of the frame before remain")
    assert added == 0
    for unknown in (((TOP, TOP, 0), (1.0, 1.0, 0.0)), ((0, 0, 0), (0.0, 0.0, 0.0)), ((0, 0, TOP), None)):
        light = seen_light((0.9, 0.9, 0.1), (TOP, TOP, 0), unknown)
        assert light._added_of(light.before) is None


@pytest.mark.parametrize(
    ("amounts", "squared", "named"),
    [
        ((1, 1, 0), 20.1, f"({TOP}, {TOP}, 0)"),
        ((1, 1, 0), 19.9, None),
        ((1, 1, 0.0016), 1e9, f"({TOP}, {TOP}, 0)"),
        ((1, 1, 0.0017), 1e9, None),  # 5.5 of 0.0003
        ((0.0064, 0, 0), 1e9, "black"),  # 5.5 of 0.0012
        ((0.0067, 0, 0), 1e9, None),
    ],
)
def test_another_light_of_the_plan_is_named_where_it_fits_much_better(
    amounts: Amounts, squared: float, named: str | None
) -> None:
    said = seen_light(amounts, plan=((TOP, 0, TOP), (TOP, TOP, 0), FULL))._other(squared)
    assert said.startswith(f"another light is seen, {named}, {judge._named(FULL)} was ordered") if named else not said


@pytest.mark.parametrize(
    ("blue", "again", "before", "said"),
    [
        (0.96, True, (FULL, 0.96), ""),
        (0.96, False, (FULL, 0.96), "is not the one ordered"),
        (0.96, True, (FULL, 0.985), ""),  # 4.5 deviations of 0.004 · √2
        (0.96, True, (FULL, 0.995), "is not the one ordered"),  # 6.2
        (0.96, True, None, "is not the one ordered"),
        (0.92, True, (FULL, 0.92), "is not the one ordered"),  # by 2.2°, of which 2 are lived with
        (0.96, True, ((TOP, TOP, 200), 0.96), "light of the frame before"),
        (1.0, False, ((TOP, TOP, 245), 1.001), ""),  # both fit
    ],
)
def test_a_light_of_another_colour_is_lived_with_where_it_is_shown_twice(
    blue: float, again: bool, before: tuple[tuple[int, int, int], float] | None, said: str
) -> None:
    was = None if before is None else (before[0], (1.0, 1.0, before[1]))
    light = seen_light((1, 1, blue), before=was)
    reason, added = light.cause(blue < 1, 0.01, again=again)
    assert (said in reason) if said else not reason
    assert added == 0


def test_light_from_elsewhere_is_asked_for_where_what_is_off_is_light_alone() -> None:
    def said(light: judge._SeenLight) -> str:
        return light.cause(True, 0.01, again=False)[0]

    # A tenth of the frame before, which was brighter in red and green.
    brighter = said(seen_light((1.05, 1.02, 1), before=((TOP, TOP, 9), (1.5, 1.2, 1))))
    assert "remain in this one" in brighter
    assert "light from elsewhere" in brighter
    assert "elsewhere" not in said(seen_light((0.9, 0.9, 0.1), (TOP, TOP, 0), ((0, 0, TOP), (0, 0, 1))))
    # Another light of the plan, with more blue or with less than ordered.
    more = seen_light((1, 1, at(120)), (TOP, TOP, 0), plan=((TOP, TOP, 120),))
    less = seen_light((1, at(213), at(213)), plan=((TOP, 213, 213),))
    assert ["does other light fall" in said(light) for light in (more, less)] == [True, False]
    assert all("another light is seen" in said(light) for light in (more, less))


def test_brighter_light_of_one_colour_is_the_rooms_where_that_fits_better() -> None:
    reason, added = seen_light((1.05, 0.05, 0.05), (TOP, 0, 0)).cause(False, 0.02, again=False)
    assert "light from elsewhere, 5.0 % of white" in reason
    assert added == pytest.approx(0.05)
    assert seen_light((1.05, 0, 0), (TOP, 0, 0)).cause(False, 0.02, again=False) == ("", 0.0)


@pytest.mark.parametrize(("room", "allowed"), [(0.03, 3.0), (0.149, 14.9), (0.15, None)])
def test_the_lamp_s_limits_are_stated_below_what_no_session_may_have(room: float, allowed: float | None) -> None:
    low = None if allowed is None else -allowed
    assert lamp_check(np.log(0.98), room, "") == Check("off_brightness", -2.0, low, allowed, "%")


def test_the_lamp_is_followed_where_it_is_shown_twice_alike_and_by_five_per_cent_at_most() -> None:
    basis = begun().basis
    assert basis is not None
    step = SessionStep(20, "light", 0, Colour(*FULL))

    def lamp(level: float, before: float) -> tuple[bool, bool]:
        light = seen_light((level, level, level)).light
        state = replace(known(basis=basis, model=MODEL), candidate=(float(np.log(before)), np.nan, np.nan))
        checks, seen = judge._judge_light(state, step, light, (), 0.5, 1.0)
        assert [check.name for check in checks] == ["off_codes_deg", "off_brightness"]
        assert isinstance(seen, LampSeen)
        return not checks[1].reason, seen.stepped

    # Six deviations of the lamp's level, √(0.004²/3 + 0.002² + …), are 1.84 %.
    assert lamp(0.985, 1.2) == (True, False)
    assert lamp(0.98, 1.2) == (False, False)
    assert lamp(0.96, 0.968) == (True, True)
    assert lamp(0.96, 0.95) == (False, False)
    assert lamp(0.95, 0.95) == (True, True)
    assert lamp(0.945, 0.945) == (False, False)


def test_what_lamps_lean_by_is_as_sure_as_all_of_them() -> None:
    lamp = ((0.012, 0.003),)
    assert judge.crept(Leaning(lamp * 2, ((0.0, 1.0),) * 2), 0.01)[0] == ""  # 6 deviations are 0.0127
    assert "1.2 % stronger" in judge.crept(Leaning(lamp * 3, ((0.0, 1.0),) * 3), 0.01)[0]  # 0.0104
    assert judge.crept(Leaning(lamp * 3, ((0.0, 1.0),) * 3), 0.0125)[0] == ""
    assert judge.crept(Leaning(((0.0, 1.0),) * 2, ((0.0041, 0.001),) * 2), 0.01) == ("", pytest.approx(0.0041))
    assert judge.crept(Leaning(((0.0, 1.0),) * 2, ((0.0039, 0.001),) * 2), 0.01) == ("", 0.0)
    assert judge.crept(Leaning(((0.0, 1.0),) * 2, ((0.0041, 0.0014),) * 2), 0.01) == ("", 0.0)


@pytest.mark.parametrize(
    ("codes", "before", "amounts", "stale"),
    [
        ((255, 0, 0), (0, 255, 0), 0.5, True),
        ((255, 0, 0), (255, 0, 0), 0.5, False),
        ((0, 0, 0), (0, 255, 0), 0.5, False),
        ((200, 200, 200), (196, 196, 196), 0.5, False),  # 4 % darker
        ((200, 200, 200), (180, 180, 180), 0.5, True),  # 21 %
        ((255, 255, 240), (255, 255, 250), 0.5, False),  # 3° apart
        ((255, 0, 0), (0, 255, 0), 0.53, False),  # √3 · 0.03 / (0.005 · 0.53 · √2) is 13
        ((255, 0, 0), (0, 255, 0), 0.514, True),  # 6.6, of 7
    ],
)
def test_without_primaries_the_frame_before_is_told_by_light_that_did_not_change(
    codes: tuple[int, int, int], before: tuple[int, int, int], amounts: float, stale: bool
) -> None:
    light = seen_light((amounts, amounts, amounts)).light
    check = judge._without_model(light, codes, Seen(before, measured(LIT), np.full(3, 0.5)))
    assert bool(check.reason) is stale


def measured_place(
    place: tuple[float, float], gauges: int = 4, growth: float = 0.0, far: tuple[float, float] | None = None
) -> Any:
    """Return an anchor that finds the chart at a place, or by its tags far away."""

    class Moved:
        def shift(self, *_: object) -> Shift:
            return Shift(*place, 0.0, gauges, growth)

        def displacement(self, *_: object) -> tuple[float, float] | None:
            return far

    return Moved()


def moved(anchor: Any, state: JudgeState | None = None, paper: float = 1000.0) -> tuple[Check, Check, list[float]]:
    """Return what is said of movement and blur, and the place."""
    # Green has the best signal to noise; of paper the others would be too dark.
    frame = Frame(measured(LIT), np.array([1.0, paper, 1.0]), np.zeros(2))
    nothing: Any = None
    checks, at = judge._judge_movement(state or JudgeState(), anchor, nothing, np.zeros((2, 2)), frame, JUDGE)
    return checks[0], checks[-1], at.tolist()


def at_rest(x: float) -> JudgeState:
    return JudgeState(moved_px=np.array([x, 0.0]))


def repeated(x: float, y: float) -> JudgeState:
    return JudgeState(candidate=(np.nan, x, y))


@pytest.mark.parametrize(
    ("place", "state", "value", "passed"),
    [
        ((0.19, 0.0), JudgeState(), 0.19, True),
        ((0.0, -0.21), JudgeState(), 0.21, False),
        ((0.3, 0.4), JudgeState(), 0.5, False),
        ((0.3, 0.4), replace(JudgeState(), rested=True), 0.5, True),
        ((0.5, 0.0), at_rest(0.31), 0.19, True),
        ((0.1, 0.0), at_rest(0.31), 0.21, False),
        ((0.5, 0.0), repeated(0.41, 0.0), 0.5, True),
        ((0.5, 0.0), repeated(0.39, 0.0), 0.5, False),
        ((0.99, 0.0), repeated(0.99, 0.0), 0.99, True),
        ((1.01, 0.0), repeated(1.01, 0.0), 1.01, False),
    ],
)
def test_a_chart_has_moved_by_more_than_its_limit_from_where_it_rests(
    place: tuple[float, float], state: JudgeState, value: float, passed: bool
) -> None:
    movement, _, at = moved(measured_place(place), state)
    assert (movement.value, movement.high, movement.passed) == (pytest.approx(value), 0.2, passed)
    assert at == list(place)


@pytest.mark.parametrize(
    ("growth", "value", "reason"),
    [(0.29**2, 0.29, ""), (0.31**2, 0.31, "softer"), (-(0.59**2), -0.59, ""), (-(0.61**2), -0.61, "sharper")],
)
def test_blur_may_shrink_by_twice_what_it_may_grow(growth: float, value: float, reason: str) -> None:
    _, blur, _ = moved(measured_place((0, 0), growth=growth))
    assert (blur.value, blur.low, blur.high) == (pytest.approx(value), -0.6, 0.3)
    assert (reason in blur.reason) if reason else not blur.reason


def test_dim_paper_tells_no_movement_and_less_dim_paper_no_blur() -> None:
    found = [moved(measured_place((0.1, 0)), paper=paper) for paper in (39.9, 40.0, 499.9, 500.0)]
    told = [(movement.value is not None, blur.value is not None) for movement, blur, _ in found]
    assert told == [(False, False), (True, False), (True, False), (True, True)]
    dim, _, at = found[0]
    assert dim.passed
    assert np.isnan(at).all()


def test_a_chart_that_is_not_recognised_is_looked_for_by_its_tags() -> None:
    lost, _, at = moved(measured_place((0, 0), 0))
    assert (lost.value, "not recognised" in lost.reason, bool(np.isnan(at).all())) == (None, True, True)
    found, _, at = moved(measured_place((0, 0), 0, far=(3.0, 4.0)))
    assert (found.value, "5.00 px" in found.reason, at) == (5.0, True, [3.0, 4.0])


@pytest.mark.parametrize(
    ("level", "gauges", "dx", "far"),
    [(19.9, 0, 0.0, False), (20.1, 0, 0.0, True), (500.0, 4, 0.99, False), (500.0, 4, 1.01, True)],
)
def test_a_chart_lies_elsewhere_than_in_the_earlier_run(level: float, gauges: int, dx: float, far: bool) -> None:
    state = replace(JudgeState(), anchor=measured_place((dx, 0.0), gauges))
    nothing: Any = None
    assert judge._has_moved_far(state, nothing, np.zeros((2, 2)), measured((0, level, 0))) is far


@pytest.mark.parametrize(("empty", "value", "passed"), [(1e-5, 0.001, True), (1.1e-5, 0.0011, False)])
def test_photosites_without_count_are_a_file_that_lacks_a_part(empty: float, value: float, passed: bool) -> None:
    nothing: Any = None
    *_, data = judge._judge_origin(JudgeState(), nothing, replace(measured(LIT), empty=empty), SETTINGS)
    assert (data.value, data.high, data.passed) == (pytest.approx(value), pytest.approx(0.001), passed)


def test_a_frame_of_another_camera_is_told() -> None:
    nothing: Any = None
    first = replace(measured(LIT), camera="Canon EOS 550D", serial="1")
    for now, passed in (
        (first, True),
        (replace(first, serial=""), True),
        (replace(first, serial="2"), False),
        (replace(first, camera="Canon EOS 6D"), False),
        (replace(first, places=replace(first.places, rows=159)), False),
    ):
        camera, *_ = judge._judge_origin(JudgeState(first=first), nothing, now, SETTINGS)
        assert camera.passed is passed


def test_the_noise_of_two_frames_is_as_independent_as_it_is_not_correlated() -> None:
    random = np.random.default_rng(5)
    shared, own = random.normal(0, 20, (2, 40_000))

    def frame(difference: npt.NDArray[Any]) -> Any:
        samples = np.stack([5000 + difference, np.full(len(difference), 5000.0)], axis=1)
        return replace(measured(LIT), samples=samples.round().astype(np.uint16))

    one = frame(shared)
    for correlation in (0.0, 0.6, 0.9, 1.0):
        other = frame(correlation * shared + (1 - correlation**2) ** 0.5 * own)
        assert judge._independence(one, other) == pytest.approx((1 - correlation**2) ** 0.5, abs=0.02)
    assert judge._independence(one, frame(shared[:9])) is None
    # Counts that differ by one in a tenth of the blocks have 0.32, in a quarter 0.43, of which 0.4 are needed.
    steps = np.arange(40_000) % 40
    assert judge._independence(one, frame((steps < 4) * 1.0)) is None
    assert judge._independence(one, frame((steps < 10) * 1.0)) is not None


@pytest.mark.parametrize(
    ("checks", "named"),
    [
        ({"movement": 0.5, "off_codes_deg": 3.0, "rows": 9.0}, ["movement"]),
        ({"movement": None, "rows": 9.0}, ["rows"]),
        ({"blur": 0.69, "rows": 9.0}, ["rows"]),
        ({"blur": 0.71, "rows": 9.0}, ["blur"]),
        ({"movement": 0.99, "uniformity": 4.1}, ["uniformity"]),
        ({"movement": 0.99, "uniformity": 3.9}, ["movement"]),
        ({"movement": 1.01, "uniformity": 4.1}, ["movement"]),
        ({"blur": -0.69, "uniformity": 4.1}, ["uniformity"]),
        ({"blur": 0.71, "uniformity": 4.1}, ["blur"]),
        ({"off_codes_deg": 3.0, "off_brightness": 4.0, "stray_share": 1.0}, ["off_codes_deg"]),
        ({"stray_share": 1.0, "uniformity": 2.5}, ["uniformity"]),
        ({"leak_share": 6.0, "white_drift": 20.0}, ["leak_share", "white_drift"]),
        ({}, []),
    ],
)
def test_a_cause_is_named_once(checks: dict[str, float | None], named: list[str]) -> None:
    """Uniformity has a limit of 2 here, of which twice as much is plainly uneven."""
    found = [Check(name, value, None, 2.0, "", "is off") for name, value in checks.items()]
    # What passed does not matter, nor does a check that one of two measurements passed.
    found += [Check("other_camera"), *(Check(name) for name in checks)]
    assert [check.name for check in judge._named_once(found) if check.reason] == named


def test_causes_last_or_put_others_in_doubt() -> None:
    light, grey = SessionStep(20, "light", 0, Colour(9, 9, 9)), SessionStep(3, "response", None, Colour(*FULL))
    white = known()
    lasting = judge._is_lasting
    assert {name for name in CAUSES if lasting(white, light, name)} == {"other_camera", "chart"}
    assert {name for name in CAUSES if lasting(JudgeState(), light, name)} == {"other_camera", "chart", "clipping"}
    assert {name for name in CAUSES if lasting(white, grey, name)} == {"other_camera", "chart", "white_drift"}
    assert lasting(replace(white, refused=("off_codes_deg", 3)), light, "off_codes_deg")
    assert not lasting(replace(white, refused=("off_codes_deg", 2)), light, "off_codes_deg")
    voids = judge._voids_others
    hidden = {"stray_share", "dark_drift", "leak_share"}
    unmodelled = hidden | {"rows", "uniformity", "off_codes_deg", "off_brightness", "white_drift"}
    assert {name for name in CAUSES if voids(white, name)} == unmodelled
    modelled = replace(white, basis=begun().basis, untold=frozenset({"blur"}))
    assert {name for name in CAUSES if voids(modelled, name)} == hidden | {"blur"}


def flat() -> Basis:
    """Return pictures that are the same at all tiles and strips."""
    dark = measured(DARK)
    red, green, blue = (measured(np.array(DARK) + PRIMARIES[k]) for k in range(3))
    return Basis.between((red, green, blue), dark)


@pytest.mark.parametrize(
    ("deviation", "moved_px", "passed"),
    [(0.0199, 0.0, True), (0.0203, 0.0, False), (0.2190, 1.0, True), (0.2230, 1.0, False)],
)
def test_a_tile_is_off_by_two_per_cent_and_by_what_movement_brings_across_its_edge(
    deviation: float, moved_px: float, passed: bool
) -> None:
    """A tile has ten blocks, so that a block's movement brings a tenth of a cell of twice its light."""
    tiles = measured(LIT).tiles.copy()
    tiles[5] += deviation * tiles[5]
    frame, basis = measured(tiles), flat()
    frame = replace(frame, strips=frame.strips[:0])
    checks, off = judge._judge_evenness(basis, basis.light(frame), frame, np.array([moved_px, 0.0]))
    assert checks[0].passed is passed
    assert checks[0].high == pytest.approx(2 + 20 * moved_px, abs=0.01)
    assert np.flatnonzero(off).tolist() == ([] if passed else [5])


@pytest.mark.parametrize(("lit", "passed"), [(18, True), (19, False)])
def test_without_primaries_a_twentieth_of_the_tiles_must_be_off(lit: int, passed: bool) -> None:
    tiles = measured(LIT).tiles.copy()
    tiles[:lit] *= 1.3
    frame, basis = measured(tiles), Basis.of_white(measured(LIT), measured(DARK))
    frame = replace(frame, strips=frame.strips[:0])
    (check,), _ = judge._judge_evenness(basis, basis.light(frame), frame, np.zeros(2))
    assert (check.passed, check.high) == (passed, 25.0)


@pytest.mark.parametrize(
    ("deviation", "noise", "moved_px", "wrong"),
    [
        (0.149, 0.0, 0.0, False),
        (-0.151, 0.0, 0.0, True),
        (0.299, 0.0, 1.0, False),  # 15 % more for each px
        (0.301, 0.0, 1.0, True),
        (0.23, 0.03, 0.0, False),  # eight deviations of noise
        (0.25, 0.03, 0.0, True),
    ],
)
def test_a_strip_is_another_rows_beyond_its_room(deviation: float, noise: float, moved_px: float, wrong: bool) -> None:
    basis = flat()
    strips = 160 * SEGMENTS
    signed = np.zeros(strips)
    signed[40] = deviation
    rest = Residuals(np.abs(signed), np.full(strips, noise), signed)
    found = judge._wrong_rows(basis, rest, np.array([0.0, moved_px]))
    assert np.flatnonzero(found).tolist() == ([40] if wrong else [])
    unlit = replace(rest, relative=np.full(strips, np.nan))
    assert not judge._wrong_rows(basis, unlit, np.zeros(2)).any()


@pytest.mark.parametrize(
    ("tiles", "deviation", "late", "said"),
    [  # of 384
        (196, -0.5, 0.0, "51% of the frame are not what the primaries give together"),
        (188, -0.11, 0.0, "are 11% darker than the light of the rest"),
        (188, -0.09, 0.0, "did somebody walk past"),
        (188, 0.3, 0.0, "show another light than the rest, +30% bright; did only"),
        (188, -0.5, 0.3, "for 30% of the exposure"),
        (1, 0.3, 0.0, "1% of the frame, top left"),
    ],
)
def test_what_is_uneven_is_told_by_how_much_and_how(tiles: int, deviation: float, late: float, said: str) -> None:
    off = np.arange(TILE_ROWS * TILE_COLUMNS) < tiles
    rest = Residuals(np.where(off, 1.0, 0.0), np.zeros(len(off)), np.where(off, deviation, 0.0))
    assert said in judge._uneven_reason(rest, off, late)


@pytest.mark.parametrize(
    ("row", "column", "where"),
    [(5, 8, "top left"), (6, 9, "in the middle"), (9, 14, "in the middle"), (10, 15, "bottom right"), (8, 0, "left")],
)
def test_tiles_are_named_by_thirds_of_the_frame(row: int, column: int, where: str) -> None:
    off = np.zeros((TILE_ROWS, TILE_COLUMNS), dtype=np.bool_)
    off[row, column] = True
    assert judge._where(off.ravel()) == where


def test_shares_explain_what_is_seen_of_each_tile() -> None:
    by = np.array([[10.0, 0, 0], [0.0, 20, 0], [0.0, 0, 5]])
    share, left = judge._explained(np.array([[5.0, 0, 0], [0.0, 30, 0], [0.0, 0, -5]]), by)
    assert share.tolist() == [0.5, 1.0, 0.0]
    assert left == pytest.approx((10**2 + 5**2) / (5**2 + 30**2 + 5**2))


@pytest.mark.parametrize(("step", "rows", "ragged"), [(0.019, 9, False), (0.021, 9, True), (0.021, 3, False)])
def test_rows_of_several_places_differ_from_row_to_row(step: float, rows: int, ragged: bool) -> None:
    """By a tenth of what they deviate by, 0.2; of three rows there are two steps, where three are asked."""
    signed = np.zeros((20, SEGMENTS))
    signed[4 : 4 + rows, 1] = 0.2 + step * (np.arange(rows) % 2) - step / 2
    rest = Residuals(np.abs(signed.ravel()), np.zeros(signed.size), signed.ravel())
    assert judge._is_ragged(rest, rest.relative > 0) is ragged
