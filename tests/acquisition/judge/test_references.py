"""What is said of the frames that others are held against: dark, white, primaries, and the first ones together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.judge import judge as judge_module
from acquisition.judge import limits
from acquisition.judge.judge import MOST_RESTARTS, judge_dark, judge_first_frames, judge_first_primary, judge_white
from acquisition.judge.measure import Frame
from acquisition.judge.state import Basis, Codes, Examined, JudgeState, Seen
from drivers.presenter import Colour
from experiment.config import JudgeSettings
from experiment.measures.frame import SEGMENTS, TILE_COLUMNS, TILE_ROWS, FramePlaces, Measured, Noise
from experiment.session.records import TOP, Check, SessionStep

TILES = TILE_ROWS * TILE_COLUMNS
PLACES = FramePlaces(160, 240)
DARK, WHITE = (10.0, 12.0, 11.0), (2010.0, 4012.0, 2411.0)
"""Camera RGB of a dark and of a white frame, counts above black: white adds 2000, 4000 and 2400."""
PRIMARIES = np.array([[1600.0, 300.0, 40.0], [300.0, 3200.0, 360.0], [100.0, 500.0, 2000.0]])
"""What each primary adds, counts: together what white adds."""
NOISE = Noise(1.0, 0.1)
JUDGE = JudgeSettings()


def measured(level: npt.ArrayLike, black_measured: bool = True, noise: Noise = NOISE) -> Measured:
    """Return a frame of the same level (3,) or of levels (T, 3) everywhere, counts above black."""
    tiles = np.broadcast_to(np.asarray(level, dtype=np.float64), (TILES, 3)).copy()
    strips = np.broadcast_to(tiles.mean(axis=0), (PLACES.rows * SEGMENTS, 3)).copy()
    samples = np.zeros((0, 2), dtype=np.uint16)
    return Measured(tiles, strips, samples, b"", noise, 0.0, black_measured, 1e4, 0.0, 0.0, 0.0, "", "", PLACES)


def known(**more: object) -> JudgeState:
    """Return what is known after a white and a dark frame."""
    dark = measured(DARK)
    return replace(JudgeState(white=measured(WHITE), dark=dark, first_dark=dark), **more)  # pyrefly: ignore[bad-argument-type]


def of_dark(state: JudgeState, frame: Measured) -> dict[str, Check]:
    return {check.name: check for check in judge_dark(state, frame, JUDGE.dark_percent, JUDGE.ambient_percent)}


def test_a_dark_frame_before_any_white_one_is_not_measured() -> None:
    assert judge_dark(JudgeState(), measured(WHITE), JUDGE.dark_percent, JUDGE.ambient_percent) == (
        Check("leak_share"),
    )


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
    tiles[:lit] = 0.06 * (np.array(WHITE) - DARK)
    assert of_dark(known(first_dark=None), measured(tiles))["leak_share"].passed is passes


def test_where_white_hardly_lights_a_third_of_its_mean_stands_for_it() -> None:
    tiles = np.tile(np.array(WHITE), (TILES, 1))
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
    grid[-4:, -4:] += (0.01 if more else -0.01) * (np.array(WHITE) - DARK)
    found = of_dark(known(), measured(grid.reshape(TILES, 3)))
    assert found["leak_share"].passed
    assert not found["dark_drift"].passed
    assert found["dark_drift"].value == pytest.approx(1.0, abs=0.001)
    assert ("of white more" in found["dark_drift"].reason) is more
    assert ("of white less" in found["dark_drift"].reason) is not more
    assert of_dark(known(), measured(DARK))["dark_drift"] == Check("dark_drift", 0.0, None, 0.2, "%")


def test_the_change_that_is_allowed_in_the_dark_is_wider_where_noise_or_the_black_level_makes_one() -> None:
    def allowed(frame: Measured, white: npt.ArrayLike = WHITE) -> float:
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
    basis = Basis.of_white(measured(WHITE), dark)
    lit = measured(np.array(DARK) + 0.3 * (np.array(WHITE) - DARK))
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
    first = Frame(measured(WHITE), paper, np.zeros(2))

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
    paper = Frame(measured(WHITE), np.full(3, 500.0), np.zeros(2))
    unknown = replace(paper, paper=np.array([500.0, np.nan, 500.0]))
    for first, now in ((None, paper), (unknown, paper), (paper, unknown)):
        assert judge_white(first, now) == Check("white_drift")


@pytest.mark.parametrize("primary", [0, 1, 2])
def test_a_primary_is_told_by_its_own_channel(primary: int) -> None:
    white = np.array(WHITE) - DARK
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
    as_white = np.array(WHITE) - DARK
    still = judge_first_primary(known(), measured(DARK + np.array([0.96, 0.92, 0.94]) * as_white), 0)
    one_is_less = judge_first_primary(known(), measured(DARK + np.array([0.96, 0.89, 0.94]) * as_white), 0)
    assert (still.passed, one_is_less.passed) == (False, True)


@pytest.mark.parametrize(
    ("own", "other", "passes", "black"), [(0.11, 0, True, False), (0.09, 0, False, True), (0.11, 0.12, False, False)]
)
def test_a_primary_below_a_tenth_of_white_is_nearly_black(own: float, other: float, passes: bool, black: bool) -> None:
    share = np.array([0.0, own, other])
    found = judge_first_primary(known(), measured(DARK + share * (np.array(WHITE) - DARK)), 1)
    assert (found.passed, "nearly black" in found.reason) == (passes, black)
    assert (found.low, found.high) == (10.0, None)
    # Without a dark frame the counts count as they are.
    bare = judge_first_primary(replace(known(), dark=None), measured(share * WHITE), 1)
    assert (bare.value, bare.passed) == (pytest.approx(100 * own), passes)


def test_a_primary_before_any_white_frame_is_not_measured() -> None:
    assert judge_first_primary(JudgeState(), measured(DARK), 0) == Check("off_codes_deg")


def picture(codes: Codes, gain: npt.ArrayLike = 1.0) -> Measured:
    """Return the frame of codes of a projector of gamma 2.2, its primaries times `gain`."""
    amounts = (np.array(codes) / TOP) ** 2.2 * np.asarray(gain)
    return measured(DARK + amounts @ PRIMARIES)


def begun(gain: npt.ArrayLike = 1.0, greys: int = 6) -> JudgeState:
    """Return what is known after the first frames, white among them times `gain`."""
    dark, white = measured(DARK), picture((255, 255, 255), gain)
    primaries = [(TOP, 0, 0), (0, TOP, 0), (0, 0, TOP)]
    codes = [*primaries, *[(grey, grey, grey) for grey in (TOP, 208, 160, 112, 64, 32)[:greys]]]
    frames = [Seen(one, picture(one), None) for one in codes]
    basis = Basis.between((frames[0].measured, frames[1].measured, frames[2].measured), dark)
    return known(basis=basis, first_frames=(Seen((255, 255, 255), white, None), *frames))


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
        return judge_module._SeenLight(steady, light, codes, None, ())._added_of(None)

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
    frame = Frame(measured(WHITE), np.full(3, 500.0), np.array([0.3, 0.0]))
    before = known(moved_px=np.zeros(2), rested=rested, candidate=(np.nan, *candidate))
    after = before.after(LIGHT, Examined(frame, None, True)).moved_px
    assert after is not None
    assert after.tolist() == list(rests)
