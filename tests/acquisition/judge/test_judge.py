"""Every disturbance is refused at its frame with the right cause, and undisturbed frames are accepted.

First in a simulated room, then at the limits of single checks without a room.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.judge import judge, limits
from acquisition.judge.judge import (
    CAUSES,
    MOST_RESTARTS,
    LiveJudge,
    judge_dark,
    judge_first_frames,
    judge_first_primary,
    judge_white,
)
from acquisition.judge.measure import Frame
from acquisition.judge.state import (
    Deviations,
    ExaminedFrame,
    FrameLight,
    JudgeState,
    LampState,
    ProjectorModel,
    RecentFrame,
    Residuals,
)
from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, WHITE, Colour
from experiment.config import JudgeSettings
from experiment.framing.pictures import Shift
from experiment.measures.frame import SEGMENTS, TILE_COLUMNS, TILE_ROWS, Measured, Noise
from experiment.session.records import TOP, Check, Judgement, SessionStep, link_steps
from sim.world.disturbances import (
    AmbientStep,
    AnyDisturbance,
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
from tests.acquisition.judge.made_up import (
    DARK,
    LIT,
    NOISE,
    PRIMARIES,
    TILES,
    base_state,
    measured,
    picture,
    started_state,
)

ORANGE, SKY, DEEP_BLUE = (255, 197, 126), (113, 188, 255), (0, 0, 255)
WHITE_STEP = SessionStep(901, "white", None, WHITE)
DARK_STEP = SessionStep(902, "dark", None, BLACK)


@pytest.fixture
def few(trained: Bench, tmp_path: Path) -> Bench:
    """Return a lab with a plan of six illuminants and no frames, in the room of `trained`."""
    lab = bench(tmp_path, Room(seed=3, wheel_hz=60, transfer=2.2), count=6, every=6)
    lab.world = trained.world
    return lab


@pytest.fixture(scope="module")
def earlier(trained: Bench, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[SessionStep, bytes]]:
    """Return steps and measurements of an earlier run of such a plan without its last two frames."""
    lab = bench(tmp_path_factory.mktemp("earlier"), Room(seed=3, wheel_hz=60, transfer=2.2), count=6, every=6)
    lab.world = trained.world
    measurements: list[tuple[SessionStep, bytes]] = []
    for step in lab.steps[:-2]:
        judgement = lab.take(step)
        assert judgement.accepted
        measurements.append((step, judgement.measurement))
    return measurements


def resume(lab: Bench, earlier: list[tuple[SessionStep, bytes]]) -> Bench:
    """Return the lab after a new judge has recalled the frames of an earlier run."""
    resumed = replace(lab, judge=LiveJudge(lab.settings, lab.chart, lab.lights))
    for step, measurement in earlier:
        resumed.judge.recall(step, measurement, True)
    return resumed


def cause(judgement: Judgement) -> str:
    return next((check.name for check in judgement.checks if check.reason), "")


def check(judgement: Judgement, name: str) -> Check:
    return next(check for check in judgement.checks if check.name == name)


@pytest.mark.slow
@pytest.mark.parametrize("codes", [SKY, DEEP_BLUE, (48, 255, 188)])
def test_accepts_ordered_illuminants(trained: Bench, codes: tuple[int, int, int]) -> None:
    lab = trained.fork()
    judgements = [lab.take(lab.light(*codes)) for _ in range(2)]
    assert [judgement.reason for judgement in judgements] == ["", ""]
    assert judgements[0].seen is not None
    assert judgements[0].preview[:2] == b"\xff\xd8"


@pytest.mark.slow
@pytest.mark.parametrize(("shown", "ordered"), [(ORANGE, SKY), (SKY, ORANGE), ((255, 249, 255), (255, 245, 246))])
def test_reports_previous_illuminant(
    trained: Bench, shown: tuple[int, int, int], ordered: tuple[int, int, int]
) -> None:
    lab = trained.fork()
    assert lab.take(lab.light(*shown)).accepted
    stale = lab.take(lab.light(*shown))
    assert stale.accepted  # the same light ordered again is no fault
    frozen = lab.show(lab.counts(lab.light(*shown)), lab.light(*ordered))
    assert cause(frozen) == "off_codes_deg"
    assert "the previous illuminant" in frozen.reason
    assert str(shown) in frozen.reason


@pytest.mark.slow
def test_reports_other_illuminant_of_plan(trained: Bench) -> None:
    lab = trained.fork()
    assert lab.take(lab.light(*DEEP_BLUE)).accepted
    other = lab.lights[300].colour
    judgement = lab.show(lab.counts(lab.light(*other)), lab.light(*ORANGE))
    assert cause(judgement) == "off_codes_deg"
    assert str(tuple(other)) in judgement.reason


@pytest.mark.slow
def test_follows_small_bump_and_stops_at_large_one(trained: Bench) -> None:
    lab = trained.fork()
    small = Bump(px=0.45)
    assert cause(lab.take(lab.light(*ORANGE), small)) == "movement"
    followed = lab.take(lab.light(*ORANGE), small)
    assert followed.accepted, followed.reason
    assert lab.take(lab.light(*SKY), small).accepted
    large = Bump(px=2)
    assert [lab.take(lab.light(*ORANGE), large).lasting for _ in range(3)] == [False, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("percent", [-3.0, -50.0])
def test_reports_lamp_step(trained: Bench, percent: float) -> None:
    lab = trained.fork()
    judgement = lab.take(lab.light(*SKY), LampStep(percent=percent))
    assert cause(judgement) == "off_brightness"
    assert check(judgement, "off_brightness").value == pytest.approx(percent, abs=1.0)
    again = lab.take(lab.light(*SKY), LampStep(percent=percent))
    assert again.accepted == (percent == -3)
    if percent == -3:
        assert lab.take(lab.light(*ORANGE), LampStep(percent=percent)).accepted


@pytest.mark.slow
def test_reports_room_light(trained: Bench) -> None:
    lit = AmbientStep(percent=1.0)
    lab = trained.fork()
    blue = lab.take(lab.light(*DEEP_BLUE), lit)
    assert cause(blue) == "stray_share", blue.reason
    assert check(blue, "stray_share").value == pytest.approx(1.0, rel=0.2)
    lab = trained.fork()
    dark = lab.take(DARK_STEP, lit)
    assert cause(dark) == "dark_drift"
    assert dark.voids
    lab = trained.fork()
    neutral = [lab.take(lab.light(*codes), lit) for codes in ((255, 245, 246), SKY)]
    assert not all(judgement.accepted for judgement in neutral)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("codes", "event", "name", "words"),
    [
        (ORANGE, Person(place=(-0.1, -0.1, 0.55, 0.55)), "uniformity", "top left"),
        (DEEP_BLUE, Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3), "uniformity", "bottom right"),
        (ORANGE, ScreenSaver(share=1.0), "uniformity", "screen saver"),
        (DEEP_BLUE, ScreenSaver(share=0.3), "uniformity", "screen saver"),
        (ORANGE, HalfChanged(place=(-9, -9, 9, 9), share=0.08), "off_codes_deg", "of the previous illuminant"),
        (ORANGE, HalfChanged(place=(-9, -9, 0.2, 0.2)), "uniformity", "for 100% of"),
        (ORANGE, HalfChanged(place=(-9, -9, 0.2, 0.2), share=0.3), "uniformity", "for 30% of"),
    ],
)
def test_reports_uneven_and_late_pictures(
    trained: Bench, codes: tuple[int, int, int], event: AnyDisturbance, name: str, words: str
) -> None:
    lab = trained.fork()
    assert lab.take(lab.light(*SKY)).accepted
    judgement = lab.take(lab.light(*codes), event, before=Colour(*SKY))
    assert cause(judgement) == name
    assert words in judgement.reason
    assert ("still showed the previous illuminant" in judgement.reason) == words.startswith("for ")


@pytest.mark.slow
def test_distinguishes_person_from_movement(trained: Bench) -> None:
    passing = trained.fork().take(WHITE_STEP, Person(place=(0.2, -0.2, 0.55, 1.2), left=0.9))
    assert cause(passing) == "uniformity"
    assert "walked past" in passing.reason
    # A moved or defocused chart is not reported as a person.
    assert cause(trained.fork().take(WHITE_STEP, Bump(px=0.4))) == "movement"
    assert cause(trained.fork().take(WHITE_STEP, Defocus(px=0.5))) == "blur"


@pytest.mark.slow
@pytest.mark.parametrize("codes", [ORANGE, (40, 180, 220)])
def test_reports_missing_primary(trained: Bench, codes: tuple[int, int, int]) -> None:
    lab = trained.fork()
    assert "red is missing" in lab.take(lab.light(*codes), DeadPrimary()).reason
    # A dimmed primary, or another illuminant without red, is not reported as missing.
    for other in ((codes[0] // 2, *codes[1:]), (0, codes[1], codes[2] // 2)):
        lab = trained.fork()
        judgement = lab.show(lab.counts(lab.light(*other)), lab.light(*codes))
        assert not judgement.accepted
        assert "is missing" not in judgement.reason


@pytest.mark.slow
def test_reports_window_over_picture(trained: Bench) -> None:
    lab = trained.fork()
    judgement = lab.take(WHITE_STEP, PopUp())
    assert cause(judgement) == "uniformity"
    assert not judgement.voids  # every light since was judged by itself
    assert cause(lab.take(WHITE_STEP, PopUp(share=0.1))) == "uniformity"
    assert cause(lab.take(WHITE_STEP, PopUp(place=(-9, -9, 9, 9)))) == "off_codes_deg"


@pytest.mark.slow
def test_reports_repeated_frame_by_noise(trained: Bench) -> None:
    lab = trained.fork()
    step = lab.light(*ORANGE)
    counts = lab.counts(step)
    assert lab.show(counts, step).accepted
    assert cause(lab.show(counts, step)) == "repeated"
    assert cause(lab.show(counts, lab.light(*SKY))) == "repeated"
    # Some counts were changed on the way: another file, but the same noise.
    changed = counts + (np.random.default_rng(1).random(counts.shape) < 0.2).astype(np.uint16)
    assert cause(lab.show(changed, step)) == "repeated"
    assert lab.take(step).accepted


@pytest.mark.slow
def test_reports_missing_and_misplaced_rows(trained: Bench) -> None:
    lab = trained.fork()
    assert cause(lab.take(lab.light(*ORANGE), ZeroedStrip(top=0.5, bottom=0.51))) == "data"
    assert cause(lab.take(lab.light(*ORANGE), ScrambledRows())) == "rows"
    # Among the tags, whose edges look softer by it.
    torn = lab.take(lab.light(*ORANGE), ScrambledRows(top=0.3, bottom=0.35))
    assert (check(torn, "blur").value or 0) > 0.3
    assert cause(torn) == "rows"
    assert [found.name for found in torn.checks if found.reason] == ["rows"]


@pytest.mark.slow
def test_reports_wrong_camera_exposure_or_file(trained: Bench, tmp_path: Path) -> None:
    lab = trained.fork()
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
def test_reports_dark_and_clipped_frames(trained: Bench) -> None:
    lab = trained.fork()
    assert cause(lab.show(lab.counts(DARK_STEP), lab.light(*ORANGE))) == "exposure"
    assert cause(lab.show(lab.counts(lab.light(*ORANGE)), DARK_STEP)) == "leak_share"
    bright = lab.world.expose(WHITE, replace(EXPOSURE, shutter_s=1.2), key=(5,))
    assert cause(lab.show(bright, WHITE_STEP)) == "clipping"


@pytest.mark.slow
def test_reports_lit_screen_in_dark_frame(trained: Bench) -> None:
    lab = trained.fork()
    assert lab.take(lab.light(*ORANGE)).accepted
    assert "previous illuminant" in lab.show(lab.counts(lab.light(*ORANGE)), DARK_STEP).reason


@pytest.mark.slow
@pytest.mark.parametrize("missing", [1, 4])
def test_refuses_unpredictable_illuminants(few: Bench, missing: int) -> None:
    green = SessionStep(903, "response", None, Colour(0, 250, 0))
    for step in few.steps[:5]:
        if step.number != missing:
            assert few.take(step).accepted
        else:
            assert not few.show(few.counts(green), step).accepted
    # The screen is frozen, and its light cannot be predicted.
    grey, light = few.steps[5], next(step for step in few.steps if step.kind == "light")
    unpredicted = [few.show(few.counts(green), step) for step in (grey, light)]
    assert [cause(judgement) for judgement in unpredicted] == ["off_codes_deg", "off_codes_deg"]
    assert "cannot be predicted" in unpredicted[0].reason
    assert few.take(few.steps[missing]).accepted
    assert [few.take(step).reason for step in (grey, light)] == ["", ""]
    assert cause(few.show(few.counts(green), light)) == "off_codes_deg"


@pytest.mark.slow
@pytest.mark.parametrize("passing", [0, 4])
def test_reports_person_in_first_frames(few: Bench, passing: int) -> None:
    hand = Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3)
    judgements = [few.take(step, *([hand] if step.number == passing else [])) for step in few.steps[:5]]
    assert [judgement.accepted for judgement in judgements] == [True] * 4 + [False]
    assert cause(judgements[4]) == "uniformity"
    assert judgements[4].voids
    light = next(step for step in few.steps if step.kind == "light")
    repeated = [few.take(step) for step in (*few.steps[:6], light)]
    assert [judgement.reason for judgement in repeated] == [""] * 7


@pytest.mark.slow
def test_reports_person_in_primaries_of_moved_chart(few: Bench, earlier: list[tuple[SessionStep, bytes]]) -> None:
    resumed = resume(few, earlier)
    elsewhere, hand = Bump(px=6.7), Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3)
    ties = link_steps(500)
    judgements = [resumed.take(step, elsewhere, *([hand] if step.number == 502 else [])) for step in ties[:4]]
    assert [judgement.voids for judgement in judgements] == [False, False, False, True]
    repeated = [resumed.take(step, elsewhere) for step in (*ties, resumed.light(*SKY))]
    assert [judgement.reason for judgement in repeated] == [""] * 7


@pytest.mark.slow
def test_continues_without_earlier_measurements(few: Bench) -> None:
    for step in few.steps[:2]:
        few.judge.recall(step, b"of another version", True)
    judgements = [few.take(step).reason for step in (*link_steps(500), few.light(*SKY), DARK_STEP, few.light(*SKY))]
    assert judgements == [""] * 9
    assert few.judge.state.has_primaries


@pytest.mark.slow
def test_resumes_with_earlier_model(few: Bench, earlier: list[tuple[SessionStep, bytes]]) -> None:
    resumed = resume(few, earlier)
    assert resumed.judge.state.has_primaries
    # A lamp that is 3 % weaker after a day has drifted.
    weaker = LampStep(percent=-3)
    ties = [resumed.take(step, weaker) for step in link_steps(500)]
    assert [tie.reason for tie in ties] == [""] * 6
    assert check(ties[0], "off_brightness").value == pytest.approx(-3, abs=0.8)
    assert resumed.take(resumed.light(*SKY), weaker).accepted
    assert cause(resumed.show(resumed.counts(resumed.light(*SKY), weaker), resumed.light(*ORANGE))) == "off_codes_deg"
    assert cause(resumed.take(resumed.light(*SKY), LampStep(percent=-6))) == "off_brightness"
    # Another lamp is reported before the first illuminant.
    tie = resume(few, earlier).take(link_steps(500)[0], LampStep(percent=-21))
    assert cause(tie) == "white_drift"
    assert tie.lasting


@pytest.mark.slow
def test_follows_chart_that_moved_between_runs(few: Bench, earlier: list[tuple[SessionStep, bytes]]) -> None:
    resumed = resume(few, earlier)
    elsewhere = Bump(px=6.7, direction_deg=-27)
    judgements = [resumed.take(step, elsewhere) for step in link_steps(500)]
    assert all(judgement.accepted for judgement in judgements), [judgement.reason for judgement in judgements]
    assert check(judgements[0], "movement").value == pytest.approx(6.7, abs=0.3)
    later = resumed.take(resumed.light(*SKY), elsewhere)
    assert later.accepted, later.reason
    assert cause(resumed.take(resumed.light(*SKY))) == "movement"


@pytest.mark.slow
def test_judges_without_response_frames(tmp_path: Path, trained: Bench) -> None:
    lab = bench(tmp_path, Room(seed=3), count=6, every=3, response=False)
    lab.world = trained.world
    for step in lab.steps:
        assert (judgement := lab.take(step)).accepted, judgement.reason
    assert lab.take(lab.light(*SKY)).accepted
    assert cause(lab.show(lab.counts(lab.light(*SKY)), lab.light(*ORANGE))) == "off_codes_deg"
    person = lab.take(lab.light(*ORANGE), Person(place=(-0.1, -0.1, 0.55, 0.55)))
    assert cause(person) == "uniformity"


@pytest.mark.slow
def test_reports_missing_chart_in_first_frame(tmp_path: Path, trained: Bench) -> None:
    wall = trained.world.expose(Colour(0, 0, 0), EXPOSURE, key=(1,))
    wall[60:, 60:] += np.uint16(3000)
    lab = bench(tmp_path, Room(seed=3))
    judgement = lab.show(wall, WHITE_STEP)
    assert cause(judgement) == "chart"
    assert judgement.lasting
    bare = bench(tmp_path, Room(seed=3), lab=LAB + "[judge]\nchart = false\n")
    assert bare.show(wall, WHITE_STEP).accepted


@pytest.mark.slow
def test_reports_non_additive_projector_without_refusing(tmp_path: Path, trained: Bench) -> None:
    lab = bench(tmp_path, Room(seed=3, wheel_hz=60, transfer=2.2), count=10, every=5)
    lab.world = trained.world

    def shown(colour: Colour) -> Situation:
        alone = lab.world.room.light_of(np.array(colour)) / 1.4
        return Situation(picture=(alone + 0.4 * alone.min()).astype(np.float32)[None, None])

    def take(step: SessionStep, colour: Colour | None = None) -> Judgement:
        key = (next(FRAMES),)
        return lab.show(lab.world.expose(step.colour, EXPOSURE, key=key, situation=shown(colour or step.colour)), step)

    judgements = [take(step) for step in lab.steps]
    assert [judgement.reason for judgement in judgements if judgement.reason] == []
    white = next(
        judgement for judgement, step in zip(judgements[::-1], lab.steps[::-1], strict=True) if step.kind == "white"
    )
    assert check(white, "additivity").value == pytest.approx(40, abs=3)
    of_lights = [judgement for judgement, step in zip(judgements, lab.steps, strict=True) if step.kind == "light"]
    limits = [check(judgement, "off_codes_deg").high or 0 for judgement in of_lights]
    assert max(limits) > 0.8  # wider than where light adds
    assert cause(take(lab.light(*ORANGE), Colour(*SKY))) == "off_codes_deg"


@pytest.mark.slow
def test_accepts_dim_session_with_black_level_errors(tmp_path: Path) -> None:
    lab = bench(tmp_path, Room(seed=14, wheel_hz=60, white_level_share=0.05), count=4, every=4)
    assert [judgements.reason for judgements in map(lab.take, lab.steps) if judgements.reason] == []
    assert lab.take(lab.light(*ORANGE)).accepted
    assert cause(lab.show(lab.counts(lab.light(*ORANGE)), lab.light(*SKY))) == "off_codes_deg"


@pytest.mark.slow
def test_stops_at_clipped_first_frame(tmp_path: Path) -> None:
    lab = bench(tmp_path, Room(seed=3, white_level_share=4.0))
    judgement = lab.take(WHITE_STEP)
    assert cause(judgement) == "clipping"
    assert judgement.lasting
    assert "dim the projector, or set a shorter exposure" in judgement.reason


@pytest.mark.slow
def test_measures_blur_at_next_reference_after_dim_illuminant(trained: Bench) -> None:
    lab = trained.fork()
    dim = lab.take(lab.light(0, 0, 56), Defocus(px=1))
    assert check(dim, "blur").value is None
    assert dim.accepted, dim.reason
    white = lab.take(WHITE_STEP, Defocus(px=1))
    assert cause(white) == "blur"
    assert white.voids


JUDGE = JudgeSettings()


def dark_checks(state: JudgeState, frame: Measured) -> dict[str, Check]:
    return {check.name: check for check in judge_dark(state, frame, JUDGE.dark_percent, JUDGE.ambient_percent)}


@pytest.mark.parametrize(("percent", "passes"), [(4.9, True), (5.1, False)])
def test_compares_dark_frame_with_white_per_channel(percent: float, passes: bool) -> None:
    # Of what white adds to green; the others stay at 0.
    checks = dark_checks(base_state(first_dark=None), measured((0.0, 40.0 * percent, 0.0)))
    assert checks["leak_share"].passed is passes
    assert checks["leak_share"].value == pytest.approx(percent, abs=0.001)
    assert (checks["leak_share"].high, checks["leak_share"].unit) == (5.0, "%")
    assert "dark_drift" not in checks, "there is no first dark frame that it could have changed from"


@pytest.mark.parametrize(("lit", "passes"), [(TILES // 20, True), (TILES // 10, False)])
def test_refuses_light_in_six_percent_of_dark_tiles(lit: int, passes: bool) -> None:
    tiles = np.zeros((TILES, 3))
    tiles[:lit] = 0.06 * (np.array(LIT) - DARK)
    assert dark_checks(base_state(first_dark=None), measured(tiles))["leak_share"].passed is passes


def test_replaces_dim_white_by_third_of_mean() -> None:
    tiles = np.tile(np.array(LIT), (TILES, 1))
    tiles[: TILES // 5] = DARK
    state = replace(base_state(first_dark=None), white=measured(tiles))
    # 60 counts of green are 1.5 % of white where it lights, and 5.6 % of a third of its mean.
    unlit = np.zeros((TILES, 3))
    unlit[: TILES // 5, 1] = 60.0
    assert dark_checks(state, measured(unlit))["leak_share"].value == pytest.approx(
        100 * 60 / (4000 * (1 - TILES // 5 / TILES) / 3), abs=1e-3
    )


@pytest.mark.parametrize("is_brighter", [True, False])
def test_reports_lamp_in_corner_of_dark_frame(is_brighter: bool) -> None:
    """A corner of 4 × 4 tiles changed by 1 % of white; the mean of all 24 regions would be below the limit."""
    grid = np.tile(np.array(DARK), (TILE_ROWS, TILE_COLUMNS, 1))
    grid[-4:, -4:] += (0.01 if is_brighter else -0.01) * (np.array(LIT) - DARK)
    checks = dark_checks(base_state(), measured(grid.reshape(TILES, 3)))
    assert checks["leak_share"].passed
    assert not checks["dark_drift"].passed
    assert checks["dark_drift"].value == pytest.approx(1.0, abs=0.001)
    assert ("(more)" in checks["dark_drift"].reason) is is_brighter
    assert ("(less)" in checks["dark_drift"].reason) is not is_brighter
    assert dark_checks(base_state(), measured(DARK))["dark_drift"] == Check("dark_drift", 0.0, None, 0.2, "%")


def test_widens_dark_limit_by_noise_and_black_level() -> None:
    def allowed(frame: Measured, white: npt.ArrayLike = LIT) -> float:
        return dark_checks(replace(base_state(), white=measured(white)), frame)["dark_drift"].high or 0.0

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


@pytest.mark.parametrize("sign", [1, -1])
def test_limits_drift_of_paper_white(sign: int) -> None:
    paper = np.array([500.0, 1000.0, 700.0])
    first = Frame(measured(LIT), paper, np.zeros(2))

    def drift(percent: float) -> Check:
        # Another colour, of which the sum counts.
        now = paper * np.array([0.9, 1.0, 1.0])
        now[1] += paper.sum() * (1 + percent / 100) - now.sum()
        return judge_white(first, replace(first, paper=now))

    near, far = drift(sign * (limits.MAX_WHITE_DRIFT - 0.1)), drift(sign * (limits.MAX_WHITE_DRIFT + 0.1))
    assert (near.passed, far.passed) == (True, False)
    assert far.value == pytest.approx(sign * (limits.MAX_WHITE_DRIFT + 0.1), abs=0.01)
    assert (far.low, far.high) == (-limits.MAX_WHITE_DRIFT, limits.MAX_WHITE_DRIFT)


@pytest.mark.parametrize(
    ("own", "other", "passes", "black"), [(0.11, 0, True, False), (0.09, 0, False, True), (0.11, 0.12, False, False)]
)
def test_refuses_primary_below_tenth_of_white(own: float, other: float, passes: bool, black: bool) -> None:
    share = np.array([0.0, own, other])
    failed = judge_first_primary(base_state(), measured(DARK + share * (np.array(LIT) - DARK)), 1)
    assert (failed.passed, "nearly black" in failed.reason) == (passes, black)
    assert (failed.low, failed.high) == (10.0, None)
    # Without a dark frame the counts count as they are.
    bare = judge_first_primary(replace(base_state(), dark=None), measured(share * LIT), 1)
    assert (bare.value, bare.passed) == (pytest.approx(100 * own), passes)


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
def test_compares_first_white_with_prediction(gain: npt.ArrayLike, name: str | None) -> None:
    failed = judge_first_frames(started_state(gain), LIGHT, None, JUDGE)
    assert (None if failed is None else failed.name) == name
    if name == "off_brightness" and failed is not None:
        assert failed.value == pytest.approx(100 * (float(np.max(gain)) - 1), abs=2)
        assert failed.low is not None
        assert failed.low == -(failed.high or 0) < -JUDGE.drift_percent
        assert f"{failed.value:+.1f} %" in failed.reason


def test_judges_first_white_only_at_first_illuminant() -> None:
    odd = started_state(1.3)
    assert judge_first_frames(odd, replace(LIGHT, kind="response"), None, JUDGE) is None
    assert judge_first_frames(replace(odd, is_starting=False), LIGHT, None, JUDGE) is None
    assert judge_first_frames(replace(odd, basis=None), LIGHT, None, JUDGE) is None
    assert judge_first_frames(replace(odd, first_frames=odd.first_frames[1:]), LIGHT, None, JUDGE) is None
    assert judge_first_frames(started_state(1.3, greys=0), LIGHT, None, JUDGE) is None


def test_repeats_first_frames_after_two_contradictions() -> None:
    uneven = Check("uniformity", 0.3, None, 0.02, "", "part is covered")
    state = started_state()
    assert judge_first_frames(state, LIGHT, uneven, JUDGE) is None, "one contradiction is no evidence"
    contradicted = replace(state, contradicted=frozenset({LIGHT.number}))
    failed = judge_first_frames(contradicted, LIGHT, uneven, JUDGE)
    assert failed is not None
    assert (failed.name, failed.value, failed.high) == ("uniformity", 0.3, 0.02)
    assert failed.reason.startswith("part is covered; ")
    assert judge_first_frames(contradicted, LIGHT, replace(uneven, name="file"), JUDGE) is None, "contradicts no frame"
    # A frame that was refused because primaries are missing contradicts no frame.
    awaiting = replace(contradicted, basis=None, primary_shown=True)
    assert judge_first_frames(awaiting, LIGHT, Check("off_codes_deg", reason="is accepted"), JUDGE) is None
    assert judge_first_frames(awaiting, LIGHT, uneven, JUDGE) is not None
    assert judge_first_frames(contradicted, LIGHT, Check("off_codes_deg", reason="is another"), JUDGE) is not None
    only_dark = replace(contradicted, first_frames=(RecentFrame((0, 0, 0), measured(DARK), None),))
    assert judge_first_frames(only_dark, LIGHT, uneven, JUDGE) is None, "a dark frame cannot be contradicted"


def test_asks_for_help_after_repeated_restarts() -> None:
    uneven = Check("uniformity", 0.3, None, 0.02, "", "part is covered")
    contradicted = replace(started_state(), contradicted=frozenset({LIGHT.number}))
    judgements = [
        judge_first_frames(replace(contradicted, restarts=restarts), LIGHT, uneven, JUDGE)
        for restarts in range(MOST_RESTARTS + 2)
    ]
    need_person = ["still disagree" in conflict.reason for conflict in judgements if conflict is not None]
    assert need_person == [False] * MOST_RESTARTS + [True, True]


def test_computes_covariance_of_amounts() -> None:
    frame, basis = picture((200, 150, 100)), started_state().basis
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


@pytest.mark.parametrize(
    ("resumed", "to_confirm", "rests"),
    [(False, (np.nan, np.nan), (0.0, 0.0)), (False, (0.35, 0.0), (0.3, 0.0)), (True, (np.nan, np.nan), (0.3, 0.0))],
    ids=["creeps", "repeated", "after a pause"],
)
def test_changes_rest_position_after_two_frames_or_pause(
    resumed: bool, to_confirm: tuple[float, float], rests: tuple[float, float]
) -> None:
    frame = Frame(measured(LIT), np.full(3, 500.0), np.array([0.3, 0.0]))
    before = base_state(moved_px=np.zeros(2), resumed=resumed, to_confirm=(np.nan, *to_confirm))
    after = before.updated(LIGHT, ExaminedFrame(frame, None, True)).moved_px
    assert after is not None
    assert after.tolist() == list(rests)


Amounts = tuple[float, float, float]
FULL = (TOP, TOP, TOP)
MODEL = replace(ProjectorModel.unknown(), covariance=np.zeros_like(ProjectorModel.unknown().covariance))


def comparison_of(
    amounts: Amounts,
    codes: tuple[int, int, int] = FULL,
    before: tuple[tuple[int, int, int], Amounts | None] | None = None,
    plan: tuple[tuple[int, int, int], ...] = (),
) -> judge._LightComparison:
    nothing = np.zeros(0)
    light = FrameLight(np.array(amounts), np.zeros((3, 3)), Residuals(nothing, nothing, nothing))
    amounts_before = None if before is None else (None if before[1] is None else np.array(before[1]))
    frame = None if before is None else RecentFrame(before[0], measured(LIT), amounts_before)
    return judge._LightComparison(MODEL, light, codes, frame, plan)


@pytest.mark.parametrize(
    ("blue", "again", "before", "words"),
    [
        (0.96, True, (FULL, 0.96), ""),
        (0.96, False, (FULL, 0.96), "is not the ordered"),
        (0.96, True, (FULL, 0.985), ""),  # 4.5 deviations of 0.004 · √2
        (0.96, True, (FULL, 0.995), "is not the ordered"),  # 6.2
        (0.96, True, None, "is not the ordered"),
        (0.92, True, (FULL, 0.92), "is not the ordered"),  # by 2.2°, of which 2° are accepted
        (0.96, True, ((TOP, TOP, 200), 0.96), "the previous illuminant"),
        (1.0, False, ((TOP, TOP, 245), 1.001), ""),  # both fit
    ],
)
def test_accepts_small_colour_error_shown_twice(
    blue: float, again: bool, before: tuple[tuple[int, int, int], float] | None, words: str
) -> None:
    previous = None if before is None else (before[0], (1.0, 1.0, before[1]))
    light = comparison_of((1, 1, blue), before=previous)
    reason, added = light.cause(blue < 1, 0.01, was_refused=again)
    assert (words in reason) if words else not reason
    assert added == 0


def test_accepts_lamp_step_shown_twice_up_to_limit() -> None:
    basis = started_state().basis
    assert basis is not None
    step = SessionStep(20, "light", 0, Colour(*FULL))

    def lamp(level: float, before: float) -> tuple[bool, bool]:
        light = comparison_of((level, level, level)).light
        state = replace(base_state(basis=basis, model=MODEL), to_confirm=(float(np.log(before)), np.nan, np.nan))
        checks, lamp_state = judge._judge_light(state, step, light, (), 0.5, 1.0)
        assert [check.name for check in checks] == ["off_codes_deg", "off_brightness"]
        assert isinstance(lamp_state, LampState)
        return not checks[1].reason, lamp_state.stepped

    # Six deviations of the lamp's level, √(0.004²/3 + 0.002² + …), are 1.84 %.
    assert lamp(0.985, 1.2) == (True, False)
    assert lamp(0.98, 1.2) == (False, False)
    assert lamp(0.96, 0.968) == (True, True)
    assert lamp(0.96, 0.95) == (False, False)
    assert lamp(0.95, 0.95) == (True, True)
    assert lamp(0.945, 0.945) == (False, False)


def test_detects_slow_change_in_several_frames() -> None:
    lamp = ((0.012, 0.003),)
    assert judge.slow_change(Deviations(lamp * 2, ((0.0, 1.0),) * 2), 0.01)[0] == ""  # 6 deviations are 0.0127
    assert "1.2 % stronger" in judge.slow_change(Deviations(lamp * 3, ((0.0, 1.0),) * 3), 0.01)[0]  # 0.0104
    assert judge.slow_change(Deviations(lamp * 3, ((0.0, 1.0),) * 3), 0.0125)[0] == ""
    assert judge.slow_change(Deviations(((0.0, 1.0),) * 2, ((0.0041, 0.001),) * 2), 0.01) == ("", pytest.approx(0.0041))
    assert judge.slow_change(Deviations(((0.0, 1.0),) * 2, ((0.0039, 0.001),) * 2), 0.01) == ("", 0.0)
    assert judge.slow_change(Deviations(((0.0, 1.0),) * 2, ((0.0041, 0.0014),) * 2), 0.01) == ("", 0.0)


def moved(
    place: tuple[float, float], state: JudgeState | None = None, growth: float = 0.0
) -> tuple[Check, Check, list[float]]:
    """Return the checks of movement and blur for a chart at a position, and the position."""
    anchor: Any = Mock()
    anchor.shift.return_value = Shift(*place, 0.0, 4, growth)
    # Green has the best signal to noise; of paper the others would be too dark.
    frame = Frame(measured(LIT), np.array([1.0, 1000.0, 1.0]), np.zeros(2))
    nothing: Any = None
    checks, at = judge._judge_movement(state or JudgeState(), anchor, nothing, np.zeros((2, 2)), frame, JUDGE)
    return checks[0], checks[-1], at.tolist()


def at_rest(x: float) -> JudgeState:
    return JudgeState(moved_px=np.array([x, 0.0]))


def repeated(x: float, y: float) -> JudgeState:
    return JudgeState(to_confirm=(np.nan, x, y))


@pytest.mark.parametrize(
    ("place", "state", "value", "passed"),
    [
        ((0.19, 0.0), JudgeState(), 0.19, True),
        ((0.0, -0.21), JudgeState(), 0.21, False),
        ((0.3, 0.4), JudgeState(), 0.5, False),
        ((0.3, 0.4), replace(JudgeState(), resumed=True), 0.5, True),
        ((0.5, 0.0), at_rest(0.31), 0.19, True),
        ((0.1, 0.0), at_rest(0.31), 0.21, False),
        ((0.5, 0.0), repeated(0.41, 0.0), 0.5, True),
        ((0.5, 0.0), repeated(0.39, 0.0), 0.5, False),
        ((0.99, 0.0), repeated(0.99, 0.0), 0.99, True),
        ((1.01, 0.0), repeated(1.01, 0.0), 1.01, False),
    ],
)
def test_limits_movement_from_rest_position(
    place: tuple[float, float], state: JudgeState, value: float, passed: bool
) -> None:
    movement, _, at = moved(place, state)
    assert (movement.value, movement.high, movement.passed) == (pytest.approx(value), 0.2, passed)
    assert at == list(place)


@pytest.mark.parametrize(
    ("growth", "value", "reason"),
    [(0.29**2, 0.29, ""), (0.31**2, 0.31, "softer"), (-(0.59**2), -0.59, ""), (-(0.61**2), -0.61, "sharper")],
)
def test_limits_blur_asymmetrically(growth: float, value: float, reason: str) -> None:
    _, blur, _ = moved((0, 0), growth=growth)
    assert (blur.value, blur.low, blur.high) == (pytest.approx(value), -0.6, 0.3)
    assert (reason in blur.reason) if reason else not blur.reason


def test_measures_independence_of_noise() -> None:
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


def test_causes_are_lasting_or_void_other_frames() -> None:
    light, grey = SessionStep(20, "light", 0, Colour(9, 9, 9)), SessionStep(3, "response", None, Colour(*FULL))
    white = base_state()
    lasting = judge._is_lasting
    assert {name for name in CAUSES if lasting(white, light, name)} == {"other_camera", "chart"}
    assert {name for name in CAUSES if lasting(JudgeState(), light, name)} == {"other_camera", "chart", "clipping"}
    assert {name for name in CAUSES if lasting(white, grey, name)} == {"other_camera", "chart", "white_drift"}
    assert lasting(replace(white, refusals=("off_codes_deg", 3)), light, "off_codes_deg")
    assert not lasting(replace(white, refusals=("off_codes_deg", 2)), light, "off_codes_deg")
    voids = judge._voids_earlier_frames
    hidden = {"stray_share", "dark_drift", "leak_share"}
    unmodelled = hidden | {"rows", "uniformity", "off_codes_deg", "off_brightness", "white_drift"}
    assert {name for name in CAUSES if voids(white, name)} == unmodelled
    with_primaries = replace(white, basis=started_state().basis, unmeasured=frozenset({"blur"}))
    assert {name for name in CAUSES if voids(with_primaries, name)} == hidden | {"blur"}


@pytest.mark.parametrize(("step", "rows", "ragged"), [(0.019, 9, False), (0.021, 9, True), (0.021, 3, False)])
def test_detects_rows_of_several_places(step: float, rows: int, ragged: bool) -> None:
    """By a tenth of their deviation of 0.2; three rows have two steps, but three are needed."""
    signed = np.zeros((20, SEGMENTS))
    signed[4 : 4 + rows, 1] = 0.2 + step * (np.arange(rows) % 2) - step / 2
    rest = Residuals(np.abs(signed.ravel()), np.zeros(signed.size), signed.ravel())
    assert judge._is_ragged(rest, rest.relative > 0) is ragged
