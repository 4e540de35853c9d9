"""Each disturbance is refused at its frame and named; what is no disturbance is accepted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquisition.judge.judge import LiveJudge, crept
from acquisition.judge.state import Leaning
from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, WHITE, Colour
from experiment.session.records import Check, Judgement, SessionStep, link_steps
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

pytestmark = pytest.mark.slow

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


@pytest.mark.parametrize("codes", [SKY, DEEP_BLUE, (48, 255, 188)])
def test_a_light_that_was_ordered_is_accepted(taught: Bench, codes: tuple[int, int, int]) -> None:
    lab = taught.fork()
    said = [lab.take(lab.light(*codes)) for _ in range(2)]
    assert [judgement.reason for judgement in said] == ["", ""]
    assert said[0].seen is not None
    assert said[0].preview[:2] == b"\xff\xd8"


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


def test_a_frozen_screen_lasts_at_the_third_frame(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*ORANGE)).accepted
    said = [lab.show(lab.counts(lab.light(*ORANGE)), lab.light(*SKY)) for _ in range(3)]
    assert [judgement.lasting for judgement in said] == [False, False, True]


def test_another_light_of_the_plan_is_named(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*DEEP_BLUE)).accepted
    other = lab.lights[300].colour
    seen = lab.show(lab.counts(lab.light(*other)), lab.light(*ORANGE))
    assert cause(seen) == "off_codes_deg"
    assert str(tuple(other)) in seen.reason


@pytest.mark.parametrize(("codes", "pixels"), [(ORANGE, 0.3), (DEEP_BLUE, 3.0), (ORANGE, 8.0)])
def test_a_bump_is_movement(taught: Bench, codes: tuple[int, int, int], pixels: float) -> None:
    lab = taught.fork()
    judgement = lab.take(lab.light(*codes), Bump(px=pixels))
    assert cause(judgement) == "movement"
    assert check(judgement, "movement").value == pytest.approx(pixels, rel=0.25)


def test_a_small_bump_that_stays_is_followed_and_a_large_one_lasts(taught: Bench) -> None:
    lab = taught.fork()
    small = Bump(px=0.45)
    assert cause(lab.take(lab.light(*ORANGE), small)) == "movement"
    followed = lab.take(lab.light(*ORANGE), small)
    assert followed.accepted, followed.reason
    assert lab.take(lab.light(*SKY), small).accepted
    large = Bump(px=2)
    assert [lab.take(lab.light(*ORANGE), large).lasting for _ in range(3)] == [False, False, True]


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


def test_a_covered_part_is_told_and_where(taught: Bench) -> None:
    lab = taught.fork()
    person = lab.take(lab.light(*ORANGE), Person(place=(-0.1, -0.1, 0.55, 0.55)))
    assert cause(person) == "uniformity"
    assert "top left" in person.reason
    lab = taught.fork()
    hand = lab.take(lab.light(*DEEP_BLUE), Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3))
    assert cause(hand) == "uniformity"
    assert "bottom right" in hand.reason


def test_who_walks_past_is_no_chart_that_moved(taught: Bench) -> None:
    passing = taught.fork().take(WHITE_STEP, Person(place=(0.2, -0.2, 0.55, 1.2), left=0.9))
    assert cause(passing) == "uniformity"
    assert "walk past" in passing.reason
    # Nor does a chart that moved, or lost its focus, become somebody who passes.
    assert cause(taught.fork().take(WHITE_STEP, Bump(px=0.4))) == "movement"
    assert cause(taught.fork().take(WHITE_STEP, Defocus(px=0.5))) == "blur"


@pytest.mark.parametrize(("codes", "share"), [(ORANGE, 1.0), (DEEP_BLUE, 0.3)])
def test_a_screen_saver_is_named(taught: Bench, codes: tuple[int, int, int], share: float) -> None:
    lab = taught.fork()
    drawn = lab.take(lab.light(*codes), ScreenSaver(share=share))
    assert cause(drawn) == "uniformity"
    assert "screen saver" in drawn.reason
    assert "cable" not in drawn.reason


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


def test_a_window_over_the_picture_is_told(taught: Bench) -> None:
    lab = taught.fork()
    judgement = lab.take(WHITE_STEP, PopUp())
    assert cause(judgement) == "uniformity"
    assert not judgement.voids  # every light since was judged by itself
    assert cause(lab.take(WHITE_STEP, PopUp(share=0.1))) == "uniformity"
    assert cause(lab.take(WHITE_STEP, PopUp(place=(-9, -9, 9, 9)))) == "off_codes_deg"


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


def test_dark_and_clipped_frames_are_told(taught: Bench) -> None:
    lab = taught.fork()
    assert cause(lab.show(lab.counts(DARK_STEP), lab.light(*ORANGE))) == "exposure"
    assert cause(lab.show(lab.counts(lab.light(*ORANGE)), DARK_STEP)) == "leak_share"
    bright = lab.world.expose(WHITE, replace(EXPOSURE, shutter_s=1.2), key=(5,))
    assert cause(lab.show(bright, WHITE_STEP)) == "clipping"


def test_a_screen_that_stays_lit_is_told_in_the_dark_frame(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*ORANGE)).accepted
    assert "of the frame before" in lab.show(lab.counts(lab.light(*ORANGE)), DARK_STEP).reason


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


def test_a_session_whose_measurements_are_lost_goes_on(few: Bench) -> None:
    for step in few.steps[:2]:
        few.judge.recall(step, b"of another version", True)
    said = [few.take(step).reason for step in (*link_steps(500), few.light(*SKY), DARK_STEP, few.light(*SKY))]
    assert said == [""] * 9
    assert few.judge.state.modelled


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


def test_a_chart_that_is_not_there_is_said_in_the_first_frame(tmp_path: Path, taught: Bench) -> None:
    wall = taught.world.expose(Colour(0, 0, 0), EXPOSURE, key=(1,))
    wall[60:, 60:] += np.uint16(3000)
    lab = bench(tmp_path, Room(seed=3))
    judgement = lab.show(wall, WHITE_STEP)
    assert cause(judgement) == "chart"
    assert judgement.lasting
    bare = bench(tmp_path, Room(seed=3), lab=LAB + "[judge]\nchart = false\n")
    assert bare.show(wall, WHITE_STEP).accepted


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


def test_a_picture_that_comes_late_is_told(taught: Bench) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*SKY)).accepted
    late = lab.take(lab.light(*ORANGE), HalfChanged(place=(-9, -9, 9, 9), share=0.08), before=Colour(*SKY))
    assert cause(late) == "off_codes_deg"
    assert "of the frame before" in late.reason


@pytest.mark.parametrize(("share", "said"), [(1.0, "for 100% of"), (0.3, "for 30% of")])
def test_a_part_that_still_shows_the_light_before_is_named_as_that(taught: Bench, share: float, said: str) -> None:
    lab = taught.fork()
    assert lab.take(lab.light(*SKY)).accepted
    part = HalfChanged(place=(-9, -9, 0.2, 0.2), share=share)
    uneven = lab.take(lab.light(*ORANGE), part, before=Colour(*SKY))
    assert cause(uneven) == "uniformity"
    assert "still showed the light of the frame before, " in uneven.reason
    assert said in uneven.reason


def test_a_hand_is_named_as_one_also_where_the_light_before_was_darker(taught: Bench) -> None:
    hand = Person(place=(0.3, 0.4, 0.5, 0.6), left=0.3)
    for before in (SKY, (120, 77, 48)):
        lab = taught.fork()
        assert lab.take(lab.light(*before)).accepted
        uneven = lab.take(lab.light(*ORANGE), hand, before=Colour(*before))
        assert "does somebody or something stand before the chart" in uneven.reason
        assert "did only a part of the picture change?" in uneven.reason, "which a dark part may be, too"


@pytest.mark.parametrize(("added", "told"), [(0.006, True), (0.003, False)])
def test_light_in_the_room_that_no_frame_tells_alone_is_told_by_two(added: float, told: bool) -> None:
    # In neutral lights, each of which may as well be a brighter lamp.
    leaning = Leaning(lamp=((0.003, 0.002),) * 2, added=((added, 0.0017),) * 2)
    assert (crept(leaning, 0.01) == ("", pytest.approx(added))) is told
    assert crept(replace(leaning, added=leaning.added[:1], lamp=leaning.lamp[:1]), 0.01) == ("", 0.0)


def test_scrambled_rows_are_named_also_where_they_are_brighter(taught: Bench) -> None:
    for top in np.linspace(0.2, 0.8, 5).tolist():
        lab = taught.fork()
        assert cause(lab.take(lab.light(*ORANGE), ScrambledRows(top=top, bottom=top + 0.05))) == "rows", top


def test_where_white_has_some_hundred_counts_noise_and_black_level_are_no_light(tmp_path: Path) -> None:
    lab = bench(tmp_path, Room(seed=14, wheel_hz=60, white_level_share=0.05), count=4, every=4)
    assert [said.reason for said in map(lab.take, lab.steps) if said.reason] == []
    assert lab.take(lab.light(*ORANGE)).accepted
    assert cause(lab.show(lab.counts(lab.light(*ORANGE)), lab.light(*SKY))) == "off_codes_deg"


def test_a_first_frame_that_is_clipped_is_not_taken_again_and_again(tmp_path: Path) -> None:
    lab = bench(tmp_path, Room(seed=3, white_level_share=4.0))
    judgement = lab.take(WHITE_STEP)
    assert cause(judgement) == "clipping"
    assert judgement.lasting
    assert "dim the projector, or set a shorter exposure" in judgement.reason


def test_a_light_too_dark_for_it_leaves_blur_to_the_next_reference(taught: Bench) -> None:
    lab = taught.fork()
    dim = lab.take(lab.light(0, 0, 56), Defocus(px=1))
    assert check(dim, "blur").value is None
    assert dim.accepted, dim.reason
    white = lab.take(WHITE_STEP, Defocus(px=1))
    assert cause(white) == "blur"
    assert white.voids
