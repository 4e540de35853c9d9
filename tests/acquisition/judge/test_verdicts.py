"""What is said of figures at their limits and just beyond them, without a room: lights, places, rows, causes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.judge import judge
from acquisition.judge.judge import CAUSES, lamp_check
from acquisition.judge.measure import Frame
from acquisition.judge.state import Basis, FrameLight, JudgeState, LampSeen, Leaning, ProjectorModel, Residuals, Seen
from drivers.presenter import Colour
from experiment.config import JudgeSettings, parse_lab
from experiment.framing.pictures import Shift
from experiment.measures.frame import SEGMENTS, TILE_COLUMNS, TILE_ROWS
from experiment.session.records import TOP, Check, SessionStep
from tests.acquisition.judge.test_projector_model import at
from tests.acquisition.judge.test_references import DARK, PRIMARIES, WHITE, begun, known, measured

Amounts = tuple[float, float, float]
FULL = (TOP, TOP, TOP)
SCATTER, TOGETHER, NO_LIGHT = 0.004, 0.002, 3e-4
"""Scatter of one amount, of all together, and of none, of a projector that is known exactly."""
MODEL = replace(ProjectorModel.unknown(), covariance=np.zeros_like(ProjectorModel.unknown().covariance))
JUDGE = JudgeSettings()
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
    frame = None if before is None else Seen(before[0], measured(WHITE), was)
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
    check = judge._without_model(light, codes, Seen(before, measured(WHITE), np.full(3, 0.5)))
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
    frame = Frame(measured(WHITE), np.array([1.0, paper, 1.0]), np.zeros(2))
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
    *_, data = judge._judge_origin(JudgeState(), nothing, replace(measured(WHITE), empty=empty), SETTINGS)
    assert (data.value, data.high, data.passed) == (pytest.approx(value), pytest.approx(0.001), passed)


def test_a_frame_of_another_camera_is_told() -> None:
    nothing: Any = None
    first = replace(measured(WHITE), camera="Canon EOS 550D", serial="1")
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
        return replace(measured(WHITE), samples=samples.round().astype(np.uint16))

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
    tiles = measured(WHITE).tiles.copy()
    tiles[5] += deviation * tiles[5]
    frame, basis = measured(tiles), flat()
    frame = replace(frame, strips=frame.strips[:0])
    checks, off = judge._judge_evenness(basis, basis.light(frame), frame, np.array([moved_px, 0.0]))
    assert checks[0].passed is passed
    assert checks[0].high == pytest.approx(2 + 20 * moved_px, abs=0.01)
    assert np.flatnonzero(off).tolist() == ([] if passed else [5])


@pytest.mark.parametrize(("lit", "passed"), [(18, True), (19, False)])
def test_without_primaries_a_twentieth_of_the_tiles_must_be_off(lit: int, passed: bool) -> None:
    tiles = measured(WHITE).tiles.copy()
    tiles[:lit] *= 1.3
    frame, basis = measured(tiles), Basis.of_white(measured(WHITE), measured(DARK))
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
