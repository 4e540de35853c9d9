"""Verdicts and states of the judge in numbers, in sessions with every disturbance once."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition.judge import judge, measure, state
from acquisition.judge.measure import Frame
from acquisition.judge.state import Basis, JudgeState, ProjectorModel
from drivers.presenter import BLACK, WHITE, Colour
from drivers.raw.rawfile import Plane
from experiment.measures import frame as measures
from experiment.measures.exposure import measure_exposure
from experiment.session.records import Check, Judgement, SessionStep
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
    Reflection,
    ScrambledRows,
    ScreenSaver,
    SensorWarming,
    ZeroedStrip,
)
from sim.world.world import Room
from tests.acquisition.judge import conftest
from tests.acquisition.judge.conftest import bench
from tests.acquisition.judge.made_up import DARK, LIT, PRIMARIES, measured
from tests.experiment.measures.test_frame import mosaic
from tests.pinned import Pinned

ORANGE, SKY, BLUE = (255, 197, 126), (113, 188, 255), (0, 0, 255)
WHITE_STEP = SessionStep(901, "white", None, WHITE)
DARK_STEP = SessionStep(902, "dark", None, BLACK)
ROUNDED = 0.011  # Checks are rounded to two digits, which may change in single precision


def said(judgement: Judgement) -> dict[str, Any]:
    """Return all numbers of a verdict."""
    numbers = {one.name: [one.value, one.low, one.high] for one in judgement.checks}
    return {**numbers, "voids": judgement.voids, "lasting": judgement.lasting}


def failed(judgement: Judgement) -> dict[str, Any]:
    failures = {check.name: check.value for check in judgement.checks if check.reason}
    return {**failures, "failed": len(failures), "voids": judgement.voids, "lasting": judgement.lasting}


def state_numbers(state: JudgeState) -> dict[str, Any]:
    """Return the state of a judge without its images."""
    model, first = state.model, state.first_white
    return {
        "model": [model.state, model.covariance, model.chroma, model.brightness, model.overlap, model.curves()],
        "moved": [
            state.moved_px,
            state.resumed,
            state.has_lost_reference,
            sorted(state.unmeasured),
            state.refusals,
            state.restarts,
            state.restart_step,
        ],
        "candidate": state.to_confirm,
        "paper": None if first is None else first.paper,
        "recent": [[one.codes, one.amounts] for one in state.recent],
        "basis": None if state.basis is None else [state.basis.maps, state.basis.dark],
    }


def frame_numbers(measurement: bytes) -> Any:
    frame = Frame.from_bytes(measurement)
    if frame is None:
        return None
    one, anchor = frame.measured, frame.anchor
    return {
        "light": [one.tiles, one.strips, one.noise, one.black, one.black_measured, one.range_dn, one.brightest_dn],
        "shares": [one.clipped, one.empty],
        "paper": frame.paper,
        "moved": frame.moved_px,
        "anchor": None if anchor is None else [anchor.paper, anchor.has_chart, anchor.boxes(), len(anchor.outlines)],
    }


@pytest.fixture
def numbered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the noise of frames independent of other tests."""
    monkeypatch.setattr(conftest, "FRAMES", itertools.count(70_000))


WRONG: dict[str, tuple[tuple[int, int, int], tuple[AnyDisturbance, ...]]] = {
    "dim": ((0, 0, 56), ()),
    "a small bump": (ORANGE, (Bump(px=0.3),)),
    "a bump": (BLUE, (Bump(px=3.0, turn_deg=0.3),)),
    "defocus": (ORANGE, (Defocus(px=1.0),)),
    "a weaker lamp": (SKY, (LampStep(percent=-2.0),)),
    "a lamp that fails": (SKY, (LampStep(percent=-50.0),)),
    "another colour": (SKY, (LampStep(percent=0.0, rgb=(4.0, 0.0, -3.0)),)),
    "light in the room": (BLUE, (AmbientStep(percent=1.0),)),
    "a person": (ORANGE, (Person(place=(-0.1, -0.1, 0.55, 0.55)),)),
    "a hand": (BLUE, (Person(place=(0.7, 0.6, 0.82, 0.78), left=0.3),)),
    "a screen saver": (ORANGE, (ScreenSaver(share=0.3),)),
    "a dead primary": (ORANGE, (DeadPrimary(),)),
    "half a picture": (ORANGE, (HalfChanged(share=0.3),)),
    "a late part": (ORANGE, (HalfChanged(place=(-9, -9, 0.2, 0.2)),)),
    "a pop-up": (SKY, (PopUp(share=0.2),)),
    "a reflection": (ORANGE, (Reflection(percent=4.0),)),
    "a warm sensor": (ORANGE, (SensorWarming(to_frame=1, dn=60.0),)),
    "no rows": (ORANGE, (ZeroedStrip(top=0.5, bottom=0.51),)),
    "other rows": (ORANGE, (ScrambledRows(top=0.3, bottom=0.35),)),
    "much": (ORANGE, (LampStep(percent=-4.0), Bump(px=0.5), Person(place=(0.3, 0.4, 0.5, 0.6), left=0.3))),
}
# Disturbances whose frames are repeated: accepted then, or lasting.
REPEATS = {"a small bump": 2, "a weaker lamp": 2, "another colour": 3, "much": 3}


@pytest.mark.slow
@pytest.mark.usefixtures("numbered")
def test_judges_a_session(tmp_path: Path, pinned: Pinned) -> None:
    lab = bench(tmp_path, Room(seed=3, wheel_hz=60, transfer=2.2), count=6, every=6)
    steps = [lab.take(step) for step in lab.steps]
    pinned("verdicts of a session", [said(one) for one in steps[::2]], same=1e-3, nothing=ROUNDED)
    pinned(
        "frames of a session as measured",
        [[one.seen, frame_numbers(one.measurement)] for one in steps[::4]],
        same=1e-4,
    )
    pinned("what the judge knows after a session", state_numbers(lab.judge.state), same=1e-4, nothing=1e-7)
    failures: dict[str, Any] = {}
    before = lab.fork()
    before.take(before.light(*SKY))
    for name, (codes, events) in WRONG.items():
        one = before.fork()
        again = [one.take(one.light(*codes), *events, before=Colour(*SKY)) for _ in range(REPEATS.get(name, 1))]
        failures[name] = {str(number): failed(each) for number, each in enumerate(again)}
        failures[name] |= {"candidate": one.judge.state.to_confirm, "refused": one.judge.state.refusals}
    references = (
        (WHITE_STEP, ("a small bump", "a weaker lamp", "light in the room", "a hand", "a pop-up", "defocus")),
        (DARK_STEP, ("light in the room", "a pop-up")),
    )
    for step, titles in references:
        for title in titles:
            failures[f"{step.kind}, {title}"] = failed(lab.fork().take(step, *WRONG[title][1]))
    pinned("verdicts of what goes wrong", failures, same=1e-3, nothing=ROUNDED)


def learnt(seed: int, count: int) -> tuple[ProjectorModel, ProjectorModel]:
    """Return a projector in which light does not add, and a model learnt from some illuminants."""
    random = np.random.default_rng(seed)
    truth = replace(ProjectorModel.unknown(), state=random.normal(size=len(ProjectorModel.unknown().state)) * 0.03)
    found = ProjectorModel.unknown()
    for number in range(count):
        red, green, blue = (random.integers(0, 256, 3) * (random.random(3) < 0.8)).tolist()
        codes = (250, 0, 0) if number == 0 else (red, green, blue)
        amounts = truth.predict(codes).amounts * (1 + 0.003 * random.normal(size=3)) + 2e-4 * random.normal(size=3)
        found = found.learn(amounts, codes, np.eye(3) * 1e-7 if number % 2 else None)
    return truth, found


def test_learns_a_projector(pinned: Pinned) -> None:
    truth, found = learnt(5, 24)
    codes = ((0, 0, 0), (255, 255, 255), (250, 0, 0), (9, 0, 1), (113, 188, 255), (40, 41, 42), (0, 77, 3))
    fits = [found.compare(truth.predict(one).amounts * 1.02 + 1e-3, one, np.eye(3) * 1e-6) for one in codes]
    facts = {
        "state": [found.state, found.covariance, found.chroma, found.brightness],
        "after a rest": [found.paused().covariance, found.stepped(0.02).covariance, found.stepped(0.02).brightness],
        "predictions": [found.predict(one) for one in codes],
        "fits": [[fit, fit.angle_limit(5.5)] for fit in fits],
        "curves": found.curves(),
        "overlap": [found.overlap, truth.overlap],
        "unknown": [ProjectorModel.unknown().predict(one) for one in codes],
    }
    pinned("what is learnt of a projector", facts, nothing=1e-12)


def lit_frame(seed: int, amounts: tuple[float, float, float], noise: float, hand: float = 1.0) -> Any:
    """Return a frame of an illuminant, brighter in the middle, some tiles of which are covered."""
    random = np.random.default_rng(seed)
    tiles = len(measured(DARK).tiles)
    falloff = 1 - 0.4 * np.linspace(-1, 1, tiles)[:, None] ** 2
    falloff[5:9] = 0.001
    light = (np.array(amounts) @ PRIMARIES) * falloff
    light[40:70] *= hand
    frame = measured(np.array(DARK) + light + noise * random.normal(size=(tiles, 3)))
    strips = np.array(DARK) + (np.array(amounts) @ PRIMARIES) * (1 + 0.1 * random.random((len(frame.strips), 1)))
    samples = random.poisson(2000, (4000, 2)).astype(np.uint16)
    return replace(frame, strips=strips, samples=samples, digest=bytes([seed]))


@pytest.mark.slow
def test_compares_frames_with_a_basis(pinned: Pinned) -> None:
    dark, white = lit_frame(1, (0, 0, 0), 0.3), lit_frame(2, (1, 1, 1), 0.5)
    red, green, blue = (lit_frame(3 + k, tuple(np.eye(3)[k].tolist()), 0.4) for k in range(3))
    bases = {"primaries": Basis.from_primaries((red, green, blue), dark), "white": Basis.from_white(white, dark)}
    frames = {
        "white": white,
        "dim": lit_frame(7, (0.01, 0.004, 0.0), 0.2),
        "orange": lit_frame(8, (0.9, 0.4, 0.1), 2.0),
        "a hand": lit_frame(9, (0.5, 0.5, 0.6), 1.0, hand=0.4),
        "a glint": lit_frame(10, (0.5, 0.5, 0.6), 1.0, hand=1.03),
    }
    found: dict[str, Any] = {"with dark": bases["primaries"].with_dark(white).spread}
    before = state.RecentFrame((255, 0, 0), red, np.array([1.0, 0, 0]))
    for name, frame in frames.items():
        for title, basis in bases.items():
            if title == "white" and name not in ("white", "a hand"):
                continue
            light = basis.light(frame)
            strips = [basis.strips(frame, light.amounts, *moved) for moved in ((0, 0), (0.021, 0), (1.5, 0), (0, 0.7))]
            checks, off = judge._judge_evenness(basis, light, frame, np.array([0.3, -0.4]), before)
            rows = [] if strips[0] is None else judge._judge_rows(basis, light, frame, np.zeros(2), uneven=True)
            found[f"{name} by {title}"] = [
                light,
                strips[:: 1 if name == "orange" else 3],
                checks,
                np.flatnonzero(off),
                rows,
            ]
    lights = [bases["primaries"].light(frame).amounts for frame in frames.values()]
    now = replace(JudgeState(white=white, dark=dark, first_dark=dark), basis=bases["primaries"], recent=(before,))
    darks = [lit_frame(20 + n, (level, level, level / 2), 0.2) for n, level in enumerate((0.0, 0.004, 0.03, 0.07))]
    darks += [red, replace(darks[1], black_measured=False)]
    papers = [Frame(white, np.array(paper), np.zeros(2)) for paper in ([500.0, 900, 400], [590.0, 1000, 500])]
    found["references"] = {
        "same": [[judge._light_distance(a, b, scatter) for b in lights] for a in lights for scatter in (0.0, 0.003)],
        "dark": [judge.judge_dark(now, one, 5.0, 0.2) for one in darks],
        "white": [judge.judge_white(papers[0], paper) for paper in papers],
        "primaries": [judge.judge_first_primary(now, one, k) for one in (red, green, white, dark) for k in (0, 1)],
        "independence": [judge._independence(a, b) for a in (white, red) for b in (white, red, dark)],
        "without model": [
            judge._without_model(bases["white"].light(frame), codes, before)
            for frame in frames.values() for codes in ((255, 0, 0), (255, 20, 0), (0, 0, 255))
        ],
        "best": [judge._best_channel(frame) for frame in (white, red, blue, dark)],
        "regions": [judge._by_region(white.tiles), judge._neighbour_contrast(bases["white"])],
    }  # fmt: skip
    pinned("frames held against pictures", found, nothing=1e-7)


@pytest.mark.slow
def test_explains_wrong_illuminants(pinned: Pinned) -> None:
    _, model = learnt(3, 40)
    random, numbers = np.random.default_rng(8), list[float]()
    nothing = state.Residuals(np.zeros(0), np.zeros(0), np.zeros(0))
    plan = ((255, 255, 255), (0, 0, 0), (255, 0, 0), (200, 100, 50), (30, 60, 90), (0, 255, 0), (255, 128, 0))
    for number in range(80):
        codes, other_codes = (plan[int(k)] for k in random.integers(0, len(plan), 2))
        amounts = model.predict(codes).amounts
        match number % 10:
            case 0:
                amounts = amounts * random.choice([0.9, 0.97, 1.03, 1.2])
            case 1:
                amounts = amounts + random.choice([0.002, 0.01, 0.05])
            case 2:
                amounts = amounts * [1, 1, random.choice([0.0, 0.04, 0.5, 0.97])]
            case 3:
                amounts = model.predict(other_codes).amounts
            case 4:
                amounts = 0.85 * amounts + 0.15 * model.predict(other_codes).amounts
            case 5:
                amounts = amounts + random.choice([0.004, 0.02, 0.11]) * np.array([1.0, 0.2, 0.1])
            case _:
                amounts = amounts * (1 + 0.01 * random.normal(size=3))
        light = state.FrameLight(amounts, np.eye(3) * 1e-8, nothing)
        comparison = judge._LightComparison(
            model, light, codes, state.RecentFrame(other_codes, measured(LIT), model.predict(other_codes).amounts), plan
        )
        fit, added = (
            comparison.fit,
            [comparison._added_light(frame) or (-1.0, -1.0) for frame in (None, comparison.previous)],
        )
        causes = [
            comparison.cause(wrong, 0.01, was_refused=again) for wrong in (True, False) for again in (True, False)
        ]
        numbers += [fit.distance, fit.angle_deg, fit.brightness, fit.brightness_sd, comparison._coloured_light()]
        numbers += [*comparison.neutral_light(), *added[0], *added[1], *(light for _, light in causes)]
        numbers.append(sum(bool(reason) for reason, _ in causes))
    pinned("lights that are off", np.array(numbers))


def test_reports_one_of_two_causes(pinned: Pinned) -> None:
    """A value of 0.6 is a small blur or movement, a value of 9 a large one."""
    named: dict[str, list[bool]] = {}
    for first, second in itertools.combinations(judge.CAUSES, 2):
        for value in (0.6, 9.0):
            found = [Check(name, value, None, 2.0, reason="wrong") for name in (first, second)]
            named.setdefault(f"{first} {value:g}", []).extend(
                bool(check.reason) for check in judge._without_consequences(found)
            )
    pinned("causes of which one is named", named)


@pytest.mark.slow
def test_measures_random_frames(pinned: Pinned) -> None:
    random = np.random.default_rng(6)
    found: dict[str, Any] = {}
    for black, rows, columns, pattern in ((0.0, 160, 240, "RGGB"), (63.0, 97, 131, "BGGR"), (512.0, 65, 151, "GRBG")):
        frame = mosaic(black)
        level = random.gamma(1.5, 800, frame.counts.shape)
        counts = np.minimum(black + random.poisson(level) + random.normal(0, 4, level.shape), 15831)
        counts = np.maximum(counts, 0).astype(np.uint16)[: 2 * rows + 1, : 2 * columns + 1]
        counts[random.random(counts.shape) < 1e-3] = 15520
        counts[7, 9:20] = [0, 1, 31, 32, 255, 256, 257, 15513, 15514, 15515, 15831]
        odd = replace(frame, counts=np.ascontiguousarray(counts), pattern=pattern)
        one = measures.measure(odd)
        places = one.places
        plane = Plane("G", counts[::2, ::2].astype(np.float32), (0.25, -0.25))
        found[f"{pattern} {black:g}"] = {
            "measured": [one.tiles, one.strips, one.samples, one.noise],
            "levels": [one.brightest_dn, one.range_dn, one.clipped, one.empty, one.level, one.digest.hex()],
            "places": [places.x_edges, places.y_edges, places.tile_blocks, [places.tile_box(n) for n in (0, 25, 383)]],
            "exposure": measure_exposure(odd),
            "paper": [
                measure._brightest_centres(plane.values),
                measure._paper_centres(plane.values, random.uniform(0, 70, (40, 2))),
            ],
            "texture": [tag.corners_px for tag in measure._textured_areas(plane).tags],
            "noise": [measures._noise(random.normal(50, 3, (900, 2)) + rise) for rise in (0, np.arange(900)[:, None])],
        }  # fmt: skip
    pinned("frames of chance as measured", found, same=1e-5)
