"""Disturbances of the simulated laboratory have the given sizes and positions."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.presenter import BLACK, WHITE, Colour
from drivers.raw.rawfile import read_raw
from foundation.clock import SIM_START
from foundation.errors import ConfigurationError
from sim.camera.film import WorldFilm
from sim.world.disturbances import (
    AmbientStep,
    AnyDisturbance,
    Bump,
    Defocus,
    Disturbances,
    LampDrift,
    LampStep,
    Moment,
    Person,
    Reflection,
    SensorWarming,
    StaleFile,
    read_disturbances,
)
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import REFERENCE_EXPOSURE, Room, Situation, World
from tests.sim.conftest import BARE, PAGE_MM

pytestmark = pytest.mark.slow

RED, GREEN, GREY = Colour(255, 0, 0), Colour(0, 255, 0), Colour(128, 128, 128)
TEST = BODIES["Test"]
STRAIGHT = Room(
    tilt_deg=0, pan_deg=0, roll_deg=0, k1=0, k2=0, p1=0, p2=0, waviness_mm=0, vignetting=0, projector_falloff=0,
    response_spread=0, black_leak=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def bare() -> World:
    """Bare paper in uniform light, seen straight by photosites with negligible noise."""
    quiet = replace(TEST, read_noise_dn=0.01, sensor_noise_e=0.0, electrons_per_dn=1e6)
    return World(BARE, quiet, STRAIGHT)


def frame_counts(world: World, *events: AnyDisturbance, colour: Colour = WHITE, frame: int = 5) -> NDArray[np.float64]:
    """Return the visible counts of a frame above black, after `frame` red frames, one per minute."""
    earlier = tuple((60.0 * k, RED) for k in range(frame))
    moment, happens = Moment(frame, 60.0 * frame, colour, earlier), Disturbances(events)
    projected, situation = happens.shown(moment), happens.situation(moment)
    counts = world.expose(projected, REFERENCE_EXPOSURE, key=(7,), situation=situation)
    area = world.body.visible
    counts = happens.counted(counts, moment)[area.top : area.top + area.height, area.left : area.left + area.width]
    return counts.astype(np.float64) - world.body.black


def at(world: World, x: float, y: float, frame: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R, G, B of the 2×2 block at a position relative to the page."""
    column, row = np.round(world.project(np.array(PAGE_MM) * (x, y))).astype(int)
    block = frame[2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
    return np.array([block[0, 0], (block[0, 1] + block[1, 0]) / 2, block[1, 1]])


@pytest.mark.parametrize("room_light", [0.0, 0.02])
def test_lamp_and_ambient_light_have_the_given_brightness(bare: World, room_light: float) -> None:
    white = frame_counts(bare).mean()
    frame = frame_counts(bare, LampStep(percent=-10), AmbientStep(percent=100 * room_light)).mean()
    assert frame / white == pytest.approx(0.9 + room_light, abs=1e-3)
    halfway = frame_counts(bare, LampDrift(percent=-2, from_frame=0, to_frame=10)).mean()
    assert halfway / white == pytest.approx(0.99, abs=1e-4)
    by_time = frame_counts(bare, LampDrift(percent=-2, from_s=200, to_s=300)).mean()
    assert by_time / white == pytest.approx(0.98, abs=1e-4), "the effect stays"


def test_person_hides_the_chart(bare: World) -> None:
    white = frame_counts(bare)
    frame = frame_counts(bare, Person(place=(0.2, 0.2, 0.6, 0.8), left=0.05))
    ratio = at(bare, 0.4, 0.5, frame) / at(bare, 0.4, 0.5, white)
    np.testing.assert_allclose(ratio, 0.05, atol=2e-3)
    np.testing.assert_array_equal(at(bare, 0.65, 0.5, frame), at(bare, 0.65, 0.5, white))
    np.testing.assert_array_equal(at(bare, 0.22, 0.22, frame), at(bare, 0.22, 0.22, white))


def _centres(world: World, frame: NDArray[np.float64], *events: Bump) -> NDArray[np.float64]:
    """Return the centroids (12, 2) of the black squares of `tests.sim.conftest.squares`, half-size px."""
    green = (frame[:-1:2, 1::2] + frame[1::2, :-1:2]) / 2
    dark = green[: frame.shape[0] // 2].max() - green
    x, y = np.meshgrid([25.37, 66.11, 107.83, 151.29], [24.71, 61.05, 99.43])
    centres: list[tuple[float, float]] = []
    for middle in world.project(np.stack([x.ravel(), y.ravel()], axis=-1)):
        column, row = (round(float(one)) for one in middle)
        spot = dark[row - 26 : row + 27, column - 26 : column + 27]
        spot = np.where(spot > 0.5 * spot.max(), 1.0, spot / (0.5 * spot.max()) * (spot > 0.05 * spot.max()))
        rows, columns = np.mgrid[row - 26 : row + 27, column - 26 : column + 27]
        centres.append((float((spot * columns).sum() / spot.sum()), float((spot * rows).sum() / spot.sum())))
    return np.array(centres)


@pytest.mark.parametrize(("px", "direction"), [(0.3, 0.0), (1.0, 30.0), (8.0, 200.0)])
def test_bump_moves_the_chart(square_world: World, px: float, direction: float) -> None:
    unmoved = _centres(square_world, frame_counts(square_world))
    pushed = _centres(square_world, frame_counts(square_world, Bump(px=px, direction_deg=direction)))
    by = (pushed - unmoved).mean(axis=0)
    expected = px * np.array([np.cos(np.radians(direction)), np.sin(np.radians(direction))])
    # The chart is rolled by 1.5° and turned by more.
    np.testing.assert_allclose(by, expected, atol=0.02 + 0.035 * px)


def test_defocus_has_the_given_standard_deviation() -> None:
    page = Print(PAGE_MM, np.array([[0.0, 0.0, 90.0, 125.0]]), np.zeros((1, 3), dtype=np.uint8))
    world = World(page, TEST, STRAIGHT)

    def spread(*events: Defocus) -> float:
        row = frame_counts(world, *events)[101:401:2, ::2].mean(axis=0)
        step = np.abs(np.diff(row[150:250]))
        position = np.arange(len(step))
        return float(np.average((position - np.average(position, weights=step)) ** 2, weights=step))

    assert spread(Defocus(px=3.0)) - spread() == pytest.approx(9.0, rel=0.1)


def test_warming_sensor_only_raises_the_black_level(bare: World) -> None:
    dark = frame_counts(bare, colour=BLACK)
    warm = frame_counts(bare, SensorWarming(dn=6, from_frame=0, to_frame=10), colour=BLACK)
    assert (warm - dark).mean() == pytest.approx(3.0, abs=0.05)
    difference = frame_counts(bare, SensorWarming(dn=6, from_frame=0, to_frame=10)) - frame_counts(bare)
    assert difference.mean() == pytest.approx(3.0, abs=0.05)


def test_projected_picture_illuminates_each_position(bare: World) -> None:
    picture = np.zeros((90, 160, 3), dtype=np.float32)
    picture[:45, :80, 0] = 1
    picture[45:, 80:] = 0.25
    area = bare.body.visible

    def lit(projected: NDArray[np.float32]) -> NDArray[np.float64]:
        counts = bare.expose(GREEN, REFERENCE_EXPOSURE, key=(7,), situation=Situation(picture=projected))
        counts = counts[area.top : area.top + area.height, area.left : area.left + area.width]
        return counts.astype(np.float64) - bare.body.black

    frame, red, white = lit(picture), frame_counts(bare, colour=RED), frame_counts(bare)
    np.testing.assert_allclose(at(bare, 0.25, 0.25, frame), at(bare, 0.25, 0.25, red), atol=1)
    np.testing.assert_allclose(at(bare, 0.75, 0.75, frame), 0.25 * at(bare, 0.75, 0.75, white), atol=1)
    np.testing.assert_allclose(at(bare, 0.75, 0.25, frame), 0, atol=1)
    # The middle of the picture is that of the page, and it changes there.
    np.testing.assert_allclose(at(bare, 0.48, 0.48, frame), at(bare, 0.48, 0.48, red), atol=1)
    np.testing.assert_allclose(at(bare, 0.52, 0.52, frame), 0.25 * at(bare, 0.52, 0.52, white), atol=1)
    plain = lit(np.full((1, 1, 3), 0.5, dtype=np.float32))
    np.testing.assert_allclose(plain, lit(np.full((9, 16, 3), 0.5, dtype=np.float32)), atol=1)
    np.testing.assert_allclose(at(bare, 0.5, 0.5, plain), 0.5 * at(bare, 0.5, 0.5, white), atol=1)


def test_stale_file_repeats_the_previous_one(plain_world: World, tmp_path: Path) -> None:
    projected = [RED, GREEN, GREY]
    events = Disturbances((StaleFile(from_frame=1, to_frame=1), StaleFile(from_frame=2, to_frame=2, new_header=True)))
    film = WorldFilm(plain_world, lambda: projected[0], lambda: 1.0, "1", {}, events)
    files: list[bytes] = []
    for number in range(4):
        into = io.BytesIO()
        film.expose(REFERENCE_EXPOSURE, SIM_START + timedelta(seconds=10 * number), into)
        files.append(into.getvalue())
        projected.append(projected.pop(0))
    assert files[1] == files[0]
    assert files[2] != files[0]
    pictures = [_counts(file, tmp_path / f"{number}.dng") for number, file in enumerate(files)]
    np.testing.assert_array_equal(pictures[2], pictures[0])
    assert not np.array_equal(pictures[3], pictures[0])


def _counts(file: bytes, path: Path) -> NDArray[np.uint16]:
    path.write_bytes(file)
    return np.asarray(read_raw(path).sensor)


@pytest.mark.parametrize(
    ("limits", "moments"),
    [
        ({"from_frame": 4, "to_frame": 8}, {(3, 0): None, (4, 0): 0.0, (6, 0): 0.5, (8, 0): 1.0, (20, 0): 1.0}),
        ({"from_s": 10.0, "to_s": 30.0}, {(0, 9.9): None, (0, 10): 0.0, (0, 15): 0.25, (0, 30): 1.0, (0, 99): 1.0}),
        ({"to_s": 40.0}, {(0, 0): 0.0, (0, 10): 0.25}),
        ({"from_frame": 4, "to_frame": 4}, {(4, 0): 0.0, (5, 0): 1.0}),
    ],
)
def test_gradual_events_grow_linearly(limits: dict[str, Any], moments: dict[tuple[int, float], float | None]) -> None:
    for (frame, at_s), grown in moments.items():
        drift = LampDrift(percent=-20, rgb=(0, 0, 50), **limits)
        happens = Disturbances((drift, SensorWarming(dn=8, **limits)))
        situation = happens.situation(Moment(frame, at_s))
        less = 1 - 0.2 * (grown or 0)
        assert situation.lamp == pytest.approx((less, less, less * (1 + 0.5 * (grown or 0))))
        assert situation.black_dn == pytest.approx(8 * (grown or 0))
        assert len(happens.at(Moment(frame, at_s))) == (0 if grown is None else 2)


def test_events_have_the_documented_defaults() -> None:
    page = (Path(__file__).parents[3] / "docs/reference/simulated-faults.md").read_text(encoding="utf-8")
    table = page.partition("| `what` | keys with default values |\n")[2].partition("\n\n")[0]
    kinds = {kind.what: kind for kind in get_args(AnyDisturbance)}
    compared = 0
    for line in table.splitlines():
        named, _, described = line.strip("| ").partition("|")
        events = [kinds[name] for name in re.findall("`(.*?)`", named)]
        for key, value in re.findall(r"`(\w+) = ([^`]+)`", described):
            # The first that has the key; of two that have it, each its own.
            event = next(one for one in events if key in one.__dataclass_fields__)
            events = [*events[1:], event] if len(events) > 1 else events
            default: Any = event.__dataclass_fields__[key].default
            assert json.loads(json.dumps(default)) == json.loads(value), (event.what, key)
            compared += 1
    assert compared == 27


@pytest.mark.parametrize(
    ("event", "words"),
    [
        ({"what": "earthquake"}, "unknown event, expected one of frozen screen, pop-up, half-changed"),
        ({"from_frame": 3}, "has no event name; add what, one of frozen screen"),
        ({"what": "bump", "px": "far"}, "simulated.events[0].px = 'far': expected a number"),
        ({"what": "bump", "px": 1, "from_frame": 1.5}, "simulated.events[0].from_frame = 1.5: expected a whole number"),
        ("bump", "simulated.events[0] = 'bump'"),
        ({"what": "bump", "size": 3}, "simulated.events[0].size"),
        ({"what": "pop-up", "colour": [1, 2]}, "simulated.events[0].colour"),
        ({"what": "pop-up", "colour": [-1, 0, 0]}, "simulated.events[0].colour"),
        ({"what": "pop-up", "colour": [0, 0, 256]}, "= 256: expected a code from 0 to 255; correct it"),
        ({"what": "lamp drift"}, "expected to_frame or to_s"),
        ({"what": "person", "from_frame": 5, "to_frame": 3}, "end to_frame = 3 is before its start"),
    ],
)
def test_refuses_bad_events(event: Any, words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read_disturbances([event], "LAB.toml")
    assert str(caught.value).startswith("LAB.toml: simulated.events[0]")
    assert words in str(caught.value)
    assert "Input" not in str(caught.value)
    assert "valid" not in str(caught.value)


def test_reflection_adds_a_share_of_paper_white() -> None:
    """5 % of the light from paper in its centre and 5 % / e² on its edge, on black ink as on paper."""
    quiet = replace(TEST, read_noise_dn=0.01, sensor_noise_e=0.0, electrons_per_dn=1e6)
    black = Print(PAGE_MM, np.array([[0.0, 0.0, PAGE_MM[0] / 2, PAGE_MM[1]]]), np.zeros((1, 3), dtype=np.uint8))
    world = World(black, quiet, STRAIGHT)
    glare = Reflection(place=(0.1, 0.2, 0.9, 0.8), percent=5)
    for colour in (WHITE, RED):
        added = frame_counts(world, glare, colour=colour) - frame_counts(world, colour=colour)
        white = world.white(colour, REFERENCE_EXPOSURE)
        for position, share in (((0.49, 0.5), 0.05), ((0.51, 0.5), 0.05), ((0.9, 0.5), 0.05 / np.e**2)):
            np.testing.assert_allclose(at(world, *position, added), share * white, rtol=0.02, atol=1.5)
