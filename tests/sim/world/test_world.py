"""The simulated room: light is additive, noise follows photon transfer, positions follow `project`.

Each statistical test has a false alarm rate of about one in a million; seeds are fixed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, WHITE, Colour
from sim.world.rendering import Print
from sim.world.sensors import BODIES, Body, Rectangle
from sim.world.world import REFERENCE_EXPOSURE, Room, World
from tests.sim.conftest import BARE

pytestmark = pytest.mark.slow

SIX_SIGMA = 5.0
PRIMARIES = (Colour(255, 0, 0), Colour(0, 255, 0), Colour(0, 0, 255))


def visible(frame: NDArray[np.uint16], body: Body) -> NDArray[np.float64]:
    area = body.visible
    return frame[area.top : area.top + area.height, area.left : area.left + area.width].astype(np.float64)


def channel_planes(signal: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return R, mean G and B of each RGGB block, (rows, columns, 3)."""
    rows, columns = (size // 2 * 2 for size in signal.shape)
    mosaic = signal[:rows, :columns].astype(np.float64)
    green = (mosaic[::2, 1::2] + mosaic[1::2, ::2]) / 2
    return np.stack([mosaic[::2, ::2], green, mosaic[1::2, 1::2]], axis=-1)


def test_light_is_additive(plain_world: World) -> None:
    together = plain_world.signal(WHITE, REFERENCE_EXPOSURE)
    apart = sum((plain_world.signal(one, REFERENCE_EXPOSURE) for one in PRIMARIES), np.zeros_like(together))
    np.testing.assert_allclose(apart, together, rtol=1e-5)


@pytest.mark.parametrize("code", [1, 10, 11, 128, 254])
def test_codes_follow_srgb(plain_world: World, code: int) -> None:
    # IEC 61966-2-1: linear = c / 12.92 up to c = 0.04045, ((c + 0.055) / 1.055)^2.4 above.
    c = code / 255
    linear = c / 12.92 if c <= 0.04045 else math.pow((c + 0.055) / 1.055, 2.4)
    full = plain_world.white(WHITE, REFERENCE_EXPOSURE)
    np.testing.assert_allclose(plain_world.white(Colour(code, code, code), REFERENCE_EXPOSURE), full * linear)


def test_power_law_leak_and_ambient_light() -> None:
    room = Room(transfer=2.0, black_leak=0.01, ambient=0.003)
    world = World(BARE, BODIES["Test"], room)
    full = World(BARE, BODIES["Test"], replace(room, black_leak=0, ambient=0)).white(WHITE, REFERENCE_EXPOSURE)
    np.testing.assert_allclose(world.white(BLACK, REFERENCE_EXPOSURE), full * (0.01 + 0.003))
    np.testing.assert_allclose(world.white(WHITE, REFERENCE_EXPOSURE), full * 1.003)
    grey = world.white(Colour(51, 51, 51), REFERENCE_EXPOSURE, lamp=0.5)
    np.testing.assert_allclose(grey, full * (0.5 * (0.01 + 0.99 * 0.04) + 0.003))


@pytest.mark.parametrize("name", BODIES)
def test_paper_white_has_the_level_of_the_room(name: str) -> None:
    body = BODIES[name]
    white = World(BARE, body, Room()).white(WHITE, REFERENCE_EXPOSURE)
    assert white.max() / (body.saturation - body.black) == pytest.approx(0.70)
    assert white.argmax() == 1


@pytest.mark.parametrize("colour", PRIMARIES, ids=["red", "green", "blue"])
def test_patches_have_the_exact_signal(plain_world: World, colour: Colour) -> None:
    sheet = plain_world.sheet
    centres = (sheet.rectangles_mm[:, :2] + sheet.rectangles_mm[:, 2:]) / 2
    primary = PRIMARIES.index(colour)
    pixels = np.round(plain_world.project(centres))
    x, y = pixels.astype(int).T
    planes = channel_planes(plain_world.signal(colour, REFERENCE_EXPOSURE))
    truth = plain_world.reflected(sheet.rgb, colour, REFERENCE_EXPOSURE)
    # R lies a quarter of a pixel up and left of the block's centre, B down and right.
    for channel, offset in enumerate((-0.25, 0, 0.25)):
        field = plain_world.field(plain_world.view.locate(pixels + offset))[:, primary]
        np.testing.assert_allclose(planes[y, x, channel], truth[:, channel] * field, rtol=3e-5)


def test_field_has_the_given_falloff_and_balance() -> None:
    lens_only = World(BARE, BODIES["Test"], Room(projector_falloff=0, vignetting=0.3))
    rows, columns = BODIES["Test"].half_size
    corner = lens_only.view.locate(np.array([[-0.75, -0.75], [(columns - 1) / 2, (rows - 1) / 2]]))
    np.testing.assert_allclose(lens_only.field(corner), [[0.7] * 3, [1] * 3], rtol=2e-3)
    mixed = World(BARE, BODIES["Test"], Room())
    x, y = np.meshgrid(np.linspace(0, 180, 37), np.linspace(0, 125, 26))
    field = mixed.field(np.stack([x, y], axis=-1))
    assert 0.95 < field[..., 1].max() <= 1
    np.testing.assert_allclose(field.mean(axis=(0, 1)) / field[..., 1].mean(), 1, atol=2e-3)
    assert np.ptp(field / field[..., 1:2]) > 0.01, "the primaries fall off differently"
    assert field.max() > 0.95
    # The primaries differ, but by little.
    assert 0.001 < np.ptp(field / field.mean(axis=-1, keepdims=True)) < 0.2


def test_photosites_integrate_over_aperture_and_blur() -> None:
    """Compared with a sum over ten thousand points of the print per photosite, found by `locate`."""
    rng = np.random.default_rng(11)
    x, y = (grid.ravel() for grid in np.meshgrid(2.1 * np.arange(70) + 15, 1.9 * np.arange(50) + 10))
    sheet = Print(
        (180, 125),
        np.stack([x, y, x + 2.1, y + 1.9], axis=-1).astype(np.float64),
        rng.choice([0, 90, 255], (3500, 3)).astype(np.uint8),
    )
    room = Room(vignetting=0, projector_falloff=0, response_spread=0, roll_deg=2, black_leak=0)
    world = World(sheet, BODIES["Test"], room)
    signal = world.signal(WHITE, REFERENCE_EXPOSURE)
    palette = world.reflected(sheet.rgb, WHITE, REFERENCE_EXPOSURE)
    white = world.white(WHITE, REFERENCE_EXPOSURE)
    photosites = np.stack([rng.integers(120, 680, 20), rng.integers(100, 450, 20)], axis=-1)
    blur = 2 * room.blur_px
    steps = np.linspace(-4.95, 4.95, 100)
    errors: list[float] = []
    for column, row in cast("list[list[int]]", photosites.tolist()):
        positions = np.stack(np.meshgrid(steps, steps), axis=-1) + rng.uniform(-0.05, 0.05, (100, 100, 2))
        edge = 0.5 / (blur * math.sqrt(2))
        spread = erf(positions / (blur * math.sqrt(2)) + edge) - erf(positions / (blur * math.sqrt(2)) - edge)
        weights = spread.prod(axis=-1)
        points = world.view.locate((np.array([column, row]) + positions - 0.5) / 2)
        cell = np.floor((points - [15, 10]) / [2.1, 1.9]).astype(int)
        channel = (0, 1, 1, 2)[2 * (row % 2) + column % 2]
        inside = ((cell >= 0) & (cell < [70, 50])).all(axis=-1)
        number = np.where(inside, cell[..., 1] * 70 + cell[..., 0], 0)
        value = palette[number, channel]
        value[~inside] = white[channel]
        errors.append(float((weights * value).sum() / weights.sum() - signal[row, column]) / white[channel])
    # The sum's own error is about 0.1 %; a photosite displaced by a tenth would be wrong by some 2 %.
    assert np.sqrt(np.mean(np.square(errors))) < 0.003
    assert np.abs(errors).max() < 0.01


def test_squares_are_at_projected_positions(square_world: World) -> None:
    """Centroids of the squares in each colour plane, compared with projected areas."""
    signal = square_world.signal(WHITE, REFERENCE_EXPOSURE).astype(np.float64)
    white = square_world.white(WHITE, REFERENCE_EXPOSURE)
    positions: NDArray[np.float64] = np.indices(signal.shape).astype(np.float64)
    rows, columns = positions[0], positions[1]
    for box in square_world.sheet.rectangles_mm:
        steps = (np.arange(40) + 0.5) / 40
        points = np.stack(np.meshgrid(*(a + steps * (b - a) for a, b in zip(box[:2], box[2:], strict=True))), axis=-1)
        expected_px = square_world.project(points)
        by_x = square_world.project(points + np.array([0.01, 0])) - expected_px
        by_y = square_world.project(points + np.array([0, 0.01])) - expected_px
        area = np.abs(by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0])
        expected = (expected_px * area[..., None]).sum(axis=(0, 1)) / area.sum()
        x, y = (round(2 * float(place) + 0.5) for place in expected)
        window = (slice(y - 42, y + 43), slice(x - 42, x + 43))
        for phase, channel in zip(product((0, 1), (0, 1)), (0, 1, 1, 2), strict=True):
            mine: NDArray[np.bool_] = (rows[window] % 2 == phase[0]) & (columns[window] % 2 == phase[1])
            darkness = (white[channel] - signal[window])[mine]
            measured = [
                float((darkness * place[window][mine]).sum() / darkness.sum() - 0.5) / 2 for place in (columns, rows)
            ]
            np.testing.assert_allclose(measured, expected, atol=0.003)


def test_frame_depends_on_its_key(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = world.expose(WHITE, REFERENCE_EXPOSURE, key=(3, 1))
    np.testing.assert_array_equal(frame, world.expose(WHITE, REFERENCE_EXPOSURE, key=(3, 1)))
    monkeypatch.setattr("sim.world.world.processor_count", lambda: 1)
    alone = World(world.sheet, world.body, world.room)
    np.testing.assert_array_equal(frame, alone.expose(WHITE, REFERENCE_EXPOSURE, key=(3, 1)))
    monkeypatch.setattr("sim.world.world.processor_count", lambda: 7)
    crowd = World(world.sheet, world.body, world.room)
    np.testing.assert_array_equal(frame, crowd.expose(WHITE, REFERENCE_EXPOSURE, key=(3, 1)))


@pytest.mark.parametrize("iso", [100, 800])
def test_masked_borders_and_dark_frames_have_read_noise(world: World, iso: int) -> None:
    settings = ExposureSettings(iso=iso, aperture=8, shutter_s=0.5)
    body = world.body
    lit = world.expose(WHITE, settings, key=(4,))
    dark = world.expose(WHITE, settings, key=(5,), lamp=0)
    # 6 DN at ISO 100 of which 2.8 electrons are the sensor's own; rounding adds 1/12.
    own = 2.8 / 1.8
    deviation = math.sqrt(6.0**2 - own**2 + (own * iso / 100) ** 2 + 1 / 12)
    for area in body.masked:
        masked = lit[area.top : area.top + area.height, area.left : area.left + area.width]
        check_normal(masked, body.black, deviation)
    check_normal(visible(dark, body), body.black, deviation)


def check_normal(counts: NDArray[np.number], mean: float, deviation: float) -> None:
    assert abs(counts.mean() - mean) < SIX_SIGMA * deviation / math.sqrt(counts.size)
    assert abs(counts.std() / deviation - 1) < SIX_SIGMA / math.sqrt(2 * counts.size)


@pytest.mark.parametrize("iso", [100, 400])
def test_noise_follows_photon_transfer(world: World, iso: int) -> None:
    """EMVA 1288: variance of counts = signal / gain + read noise² + 1/12 DN² for rounding."""
    settings = ExposureSettings(iso=iso, aperture=8, shutter_s=0.5 * 100 / iso)
    body = world.body
    signal = world.signal(WHITE, settings).astype(np.float64)
    one, other = (visible(world.expose(WHITE, settings, key=(6, n)), body) for n in range(2))
    gain = 1.8 * 100 / iso
    for low, high in ((100, 400), (400, 1000), (1000, 2000), (2000, 4000), (4000, 9000)):
        level = (signal >= low) & (signal < high)
        count = int(level.sum())
        assert count > 3000
        expected = signal[level].mean() / gain + body.noise_dn(iso) ** 2 + 1 / 12
        difference = one[level] - other[level]
        # Levels mix variances; the fourth moment of the mixture stays below that of twice the spread.
        assert difference.var() / 2 / expected == pytest.approx(1, abs=SIX_SIGMA * math.sqrt(3 / count))
        bias = (one[level] + other[level]).mean() / 2 - body.black - signal[level].mean()
        assert abs(bias) < SIX_SIGMA * math.sqrt(expected / 2 / count)


def test_counts_stop_at_saturation(world: World) -> None:
    frame = world.expose(WHITE, ExposureSettings(iso=100, aperture=4, shutter_s=2), key=(7,))
    assert frame.max() == world.body.saturation
    assert (visible(frame, world.body) == world.body.saturation).mean() > 0.3


@pytest.mark.parametrize(("shutter_s", "percent"), [(1 / 60, 7), (1.0, 0.11)])
def test_colour_wheel_changes_short_exposures(shutter_s: float, percent: float) -> None:
    """Compared with a separate simulation of R/G with 0.5 ms of jitter and one rotation in 1/60 s."""
    body = replace(BODIES["Test"], sensor=(4, 16), visible=Rectangle(0, 8, 4, 8), masked=(), electrons_per_dn=1e9)
    flat = Room(wheel_hz=60, response_spread=0, white_level_share=0.5, black_leak=0)
    world = World(BARE, replace(body, read_noise_dn=1e-3, sensor_noise_e=0), flat)
    settings = replace(REFERENCE_EXPOSURE, shutter_s=shutter_s, aperture=8 * math.sqrt(2 * shutter_s))
    ratios: list[float] = []
    for n in range(400):
        # The camera's channels overlap, so each primary is shown by itself; the key makes it the same exposure.
        red, green = (
            visible(world.expose(PRIMARIES[i], settings, key=(n,)), body).mean() - body.black for i in range(2)
        )
        ratios.append(float(red / green))
    measured = 100 * np.std(ratios) / np.mean(ratios)
    assert measured == pytest.approx(percent, rel=0.2)


def test_later_rectangles_cover_earlier_ones() -> None:
    boxes = np.array([[20.0, 20, 160, 100], [40, 40, 100, 80], [60, 50, 80, 70]])
    codes = np.array([[0, 0, 0], [255, 255, 255], [200, 0, 0]], dtype=np.uint8)
    world = World(Print((180, 125), boxes, codes), BODIES["Test"], Room(response_spread=0, black_leak=0))
    points = np.array([[10.0, 10], [30, 30], [50, 45], [70, 60], [120, 90]])
    planes = channel_planes(world.signal(PRIMARIES[1], REFERENCE_EXPOSURE))
    x, y = np.round(world.project(points)).astype(int).T
    expected = world.reflected(codes[[1, 0, 1, 2, 0]], PRIMARIES[1], REFERENCE_EXPOSURE)
    np.testing.assert_allclose(planes[y, x], expected * world.field(points)[:, 1, None], rtol=3e-3)


def test_stain_and_fold_have_the_given_depth() -> None:
    """Bare paper with and without wear: the loss of light is `worn`."""
    room = Room(response_spread=0, stain_mm=25, stain_depth=0.4, fold_mm=2)
    clean, worn = (World(BARE, BODIES["Test"], it) for it in (replace(room, stain_mm=0, fold_mm=0), room))
    assert worn.stain is not None
    assert worn.fold is not None
    assert clean.stain is None
    rows, columns = BODIES["Test"].half_size
    x, y = np.meshgrid(np.arange(20, columns - 20, 7), np.arange(20, rows - 20, 7))
    planes = channel_planes(worn.signal(WHITE, REFERENCE_EXPOSURE))[y, x]
    for channel, offset in enumerate((-0.25, 0, 0.25)):
        positions = worn.view.locate((np.stack([x, y], axis=-1) + offset).astype(np.float64))
        white = np.full((positions[..., 0].size, 3), 255)
        true = worn.camera_rgb_at(white, positions.reshape(-1, 2), WHITE, REFERENCE_EXPOSURE)[:, channel].reshape(
            x.shape
        )
        inside = ((positions > 2) & (positions < np.array(BARE.page_mm) - 2)).all(axis=-1)
        # A stain's rim is blurred by the lens, paper is not.
        rim = np.abs(np.linalg.norm(positions - worn.stain.centre_mm, axis=-1) - 12.5) < 3
        np.testing.assert_allclose(planes[..., channel][inside & ~rim], true[inside & ~rim], rtol=2e-3)
    middle = np.array(worn.stain.centre_mm)
    np.testing.assert_allclose(worn.stain.transmittance_at(middle), [0.88, 0.76, 0.6], atol=1e-6)
    away = np.array(worn.fold.at_mm) + np.array([[-6.0, 0], [6, 0], [-80, 0]])
    left, right, flat = worn.fold.shade(away).tolist()
    assert left - 1 == pytest.approx(1 - right, rel=0.02)
    assert abs(left - right) > 0.02, "a jump of the light across the crease"
    assert flat == pytest.approx(1, abs=0.003)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda: Room(seed=-1), "seed is -1"),
        (lambda: Room(fill=0), "fill is 0"),
        (lambda: Room(vignetting=1.0), "vignetting is 1.0"),
        (lambda: Room(blur_px=-0.5), "blur_px is -0.5"),
        (lambda: Room(stain_mm=-1.0), "stain_mm is -1.0"),
        (lambda: Room(stain_depth=1.0), "stain_depth is 1.0"),
        (lambda: Print((10, 10), np.zeros((2, 4)), np.zeros((1, 3), dtype=np.uint8)), r"\(1, 3\)"),
        (lambda: Print((10, 10), np.array([[5.0, 5, 4, 6]]), np.zeros((1, 3), dtype=np.uint8)), "right < left"),
        (lambda: replace(BODIES["Test"], pattern="RGBB"), "pattern is 'RGBB'"),
        (lambda: replace(BODIES["Test"], sensor=(100, 100)), "outside the sensor"),
    ],
)
def test_refuses_impossible_rooms(change: object, named: str) -> None:
    assert callable(change)
    with pytest.raises(ValueError, match=named):
        change()


HOT = Room(hot_per_million=40, hot_dn_per_s=3000, response_spread=0, black_leak=0)


def dark_excess(world: World, settings: ExposureSettings, frames: int = 8) -> NDArray[np.float64]:
    """Return the mean of dark frames above black, for the whole sensor."""
    dark = [world.expose(BLACK, settings, key=(k,)).astype(np.float64) for k in range(frames)]
    return np.mean(dark, axis=0) - world.body.black


def test_hot_photosites_are_constant_and_grow_with_time() -> None:
    world = World(BARE, BODIES["Test"], HOT)
    rows, columns = BODIES["Test"].sensor
    assert len(world.hot.rows) == round(40 * rows * columns / 1e6) == 21
    short = dark_excess(world, ExposureSettings(iso=100, aperture=8, shutter_s=0.5))
    where = np.zeros(BODIES["Test"].sensor, dtype=bool)
    where[world.hot.rows, world.hot.columns] = True
    # 8 frames of 6 DN: six standard errors are 13 DN.
    assert np.abs(short[~where]).max() < 13
    expected = np.minimum(0.5 * world.hot.dn_per_s, 13584 - 2048)
    error = np.sqrt((expected / 1.8 + 36) / 8)
    assert (np.abs(short[where] - expected) < SIX_SIGMA * error + 1).all()
    assert expected.mean() == pytest.approx(1500, rel=0.7)
    long = dark_excess(world, ExposureSettings(iso=400, aperture=8, shutter_s=1.0))
    below = 8 * expected < 9000
    assert 5 < below.sum() < 21
    np.testing.assert_allclose(long[where][below], 8 * expected[below], atol=6 * math.sqrt(9000 / 0.45 / 8))
    assert long.max() == 13584 - 2048
