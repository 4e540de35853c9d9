"""Shoulders, veil and lateral aberration of the simulated lens, waves and curl of the paper, against their formulas."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.presenter import WHITE, Colour
from sim.optics import APERTURE_VARIANCE, MILD_SHOULDERS, STRONG_SHOULDERS, PhotographicLens
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import REFERENCE_EXPOSURE, Blob, Room, Situation, World

PAGE_MM = (180.0, 125.0)
EOS_550D_PHOTOSITE_MM = 22.3 / 5202
EVEN: dict[str, float] = {"vignetting": 0.0, "projector_falloff": 0.0, "response_spread": 0.0, "black_leak": 0.0}
FLAT: Mapping[str, float] = EVEN | {"waviness_mm": 0.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}


def mtf(blur_px: float, shoulder_share: float, shoulder_px: float, lp_per_mm: float, photosite_mm: float) -> float:
    """Return the contrast that lens and photosite leave of a sine pattern on the sensor, 0 … 1, without veiling glare.

    `blur_px`: standard deviation of the core without the photosite's aperture, half-size px. `lp_per_mm`: frequency of
    the pattern, line pairs per millimetre on the sensor. `photosite_mm`: pitch of the photosites; 0.00429 mm on an EOS
    550D.
    """
    frequency = lp_per_mm * 2 * photosite_mm
    variance = blur_px**2 + APERTURE_VARIANCE / 4
    core = math.exp(-2 * math.pi**2 * variance * frequency**2)
    wide = (1 + (2 * math.pi * shoulder_px / math.sqrt(3) * frequency) ** 2) ** -1.5
    return core * (1 - shoulder_share + shoulder_share * wide)


def planes(signal: NDArray[np.floating]) -> dict[str, NDArray[np.float64]]:
    """Return R, G1 and B of each RGGB block; each lies at its own place in the block."""
    whole = signal[: len(signal) // 2 * 2, : signal.shape[1] // 2 * 2].astype(np.float64)
    return {"R": whole[::2, ::2], "G": whole[::2, 1::2], "B": whole[1::2, 1::2]}


AT_PX = {"R": np.array([-0.25, -0.25]), "G": np.array([0.25, -0.25]), "B": np.array([0.25, 0.25])}
"""Where the photosite of each of `planes` lies in its block, x then y."""


def white_squares(centres: NDArray[np.float64], side: float) -> Print:
    """Return white squares on a black page."""
    boxes = np.concatenate([[[0, 0, *PAGE_MM]], np.column_stack([centres - side / 2, centres + side / 2])])
    rgb = np.full((len(boxes), 3), 255, dtype=np.uint8)
    rgb[0] = 0
    return Print(PAGE_MM, boxes, rgb)


@pytest.mark.parametrize(("lens", "at_10", "at_30"), [(MILD_SHOULDERS, 0.96, 0.73), (STRONG_SHOULDERS, 0.93, 0.64)])
def test_the_two_lenses_have_the_contrast_they_are_named_for(
    lens: Mapping[str, float], at_10: float, at_30: float
) -> None:
    assert mtf(**lens, lp_per_mm=10, photosite_mm=EOS_550D_PHOTOSITE_MM) == pytest.approx(at_10, abs=0.002)
    assert mtf(**lens, lp_per_mm=30, photosite_mm=EOS_550D_PHOTOSITE_MM) == pytest.approx(at_30, abs=0.002)


def test_the_kernel_has_the_transfer_that_is_stated() -> None:
    """Against the closed form of a two-dimensional exponential, at frequencies below a third of the sampling's."""
    kernel = PhotographicLens((100, 100), 0.1, 3.0, 0, 0, 0).kernel().astype(np.float64)
    np.testing.assert_allclose(kernel, kernel[::-1], rtol=1e-6)
    np.testing.assert_allclose(kernel, kernel.T, rtol=1e-6)
    across = np.arange(len(kernel)) - len(kernel) // 2
    for frequency in (0.02, 0.05, 0.1, 0.2, 0.3):
        found = (kernel.sum(axis=0) * np.cos(2 * np.pi * frequency * across)).sum()
        stated = (1 + (2 * np.pi * 3 / 3**0.5 * frequency) ** 2) ** -1.5
        assert found == pytest.approx(stated, abs=0.005)


@pytest.mark.slow
def test_shoulders_spread_a_share_of_a_squares_light_as_the_profile_says() -> None:
    """Around a white square on black, against the profile integrated over the square's picture."""
    side, share, scale = 6.0, 0.1, 3.0
    world = World(
        white_squares(np.array([[90.0, 62.5]]), side),
        BODIES["Test"],
        replace(Room(shoulder_share=share, shoulder_px=scale, tilt_deg=0, pan_deg=0, roll_deg=0), **FLAT),  # pyrefly: ignore[bad-argument-type]
    )
    seen = planes(world.signal(WHITE, REFERENCE_EXPOSURE))["G"]
    white, black = (world.reflected([code], WHITE, REFERENCE_EXPOSURE)[0, 1] for code in ((255,) * 3, (0,) * 3))
    corners = world.project(np.array([[90 - side / 2, 62.5 - side / 2], [90 + side / 2, 62.5 + side / 2]]))
    (left, top), (right, bottom) = corners.tolist()
    step = 0.05
    x, y = np.meshgrid(np.arange(left + step / 2, right, step), np.arange(top + step / 2, bottom, step))
    length = scale / math.sqrt(3)
    # The core, whose variance is that of the blur and of half a half-size pixel's aperture, widens the shoulders.
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    core = math.sqrt(0.5**2 + 1 / 48)
    for away in (4, 7, 10, 14):
        column, row = round(right) + away, round((top + bottom) / 2)
        place = np.array([column, row]) + AT_PX["G"]
        wide = 0.0
        for (along, by_x), (down, by_y) in product(zip(nodes, weights, strict=True), repeat=2):
            radius = np.hypot(x - place[0] - core * along, y - place[1] - core * down)
            light = np.exp(-radius / length).sum() * step**2 / (2 * np.pi * length**2)
            wide += light * by_x * by_y / weights.sum() ** 2
        assert (seen[row, column] - black) / (white - black) == pytest.approx(share * wide, rel=0.01, abs=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("situation", [Situation(), Situation(blobs=(Blob((0.2, 0.2, 0.7, 0.9)),))])
def test_a_veil_is_the_share_of_each_channels_mean_light_also_when_someone_stands_in_it(situation: Situation) -> None:
    centres = np.array([[60.0, 50.0], [120.0, 70.0]])
    veil, settings = 0.03, REFERENCE_EXPOSURE
    frames: list[dict[str, NDArray[np.float64]]] = []
    for share in (0.0, veil):
        world = World(white_squares(centres, 30), BODIES["Test"], Room(seed=3, veil=share))
        area = world.body.visible
        counts = world.expose(Colour(250, 120, 60), settings, key=(1,), situation=situation)
        lit = counts[area.top : area.top + area.height, area.left : area.left + area.width] - float(world.body.black)
        frames.append(planes(lit))
    without, veiled = frames
    for channel, plane in without.items():
        # The same deviates make nearly the same noise; its mean over the plane is below 0.02 DN.
        np.testing.assert_allclose(veiled[channel].mean(), plane.mean(), atol=0.1)
        dark = (slice(0, 20), slice(0, 60))
        lifted = veiled[channel][dark].mean() - (1 - veil) * plane[dark].mean()
        assert lifted == pytest.approx(veil * plane.mean(), abs=0.3)


def test_each_channel_lies_where_project_says() -> None:
    """Centroids of white squares on black, in each channel, with a wavy and turned print."""
    x, y = np.meshgrid([12.0, 50.0, 90.0, 131.0, 168.0], [12.0, 62.0, 113.0])
    centres = np.column_stack([x.ravel(), y.ravel()])
    room = Room(lateral_red_px=1.5, lateral_blue_px=-0.8, blur_px=0.8, seed=4, tilt_deg=3, pan_deg=4)
    room = replace(room, **EVEN)  # pyrefly: ignore[bad-argument-type]
    world = World(white_squares(centres, 3.0), BODIES["Test"], room)
    for channel, plane in planes(world.signal(WHITE, REFERENCE_EXPOSURE)).items():
        truth = world.project(centres, channel)
        for place in truth:
            column, row = (round(float(along)) for along in place)
            rows, columns = slice(row - 15, row + 16), slice(column - 15, column + 16)
            if row < 15 or column < 15 or row + 16 > plane.shape[0] or column + 16 > plane.shape[1]:
                pytest.fail("the square lies too near to the frame's edge to be measured")
            light = plane[rows, columns] - np.median(plane[rows, columns])
            offsets = np.arange(-15, 16)
            found = np.array([(light.sum(axis=0) @ offsets), (light.sum(axis=1) @ offsets)]) / light.sum()
            np.testing.assert_allclose(found + [column, row] + AT_PX[channel], place, atol=0.01)


def test_lateral_aberration_is_as_large_as_stated_and_half_of_it_cubic() -> None:
    lens = PhotographicLens((1732, 2601), 0, 3.0, 0, 1.0, -0.5)
    corner, axis = np.array([[-0.5, -0.5]]), np.array(lens.centre_px)
    assert np.linalg.norm(lens.shifted(corner, "R") - axis) - lens.corner_px == pytest.approx(1.0)
    assert np.linalg.norm(lens.shifted(corner, "B") - axis) - lens.corner_px == pytest.approx(-0.5)
    half = (corner + axis) / 2
    assert np.linalg.norm(lens.shifted(half, "R") - half) == pytest.approx(0.5 * (1 + 0.25) / 2)
    places = np.random.default_rng(1).uniform(-20, 2600, (50, 2))
    for channel in "RGB":
        np.testing.assert_allclose(lens.unshifted(lens.shifted(places, channel), channel), places, atol=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"shoulder_share": 1.0}, {"shoulder_px": 0.0}, {"veil": -0.1}, {"wave_mm": -1.0}], ids=str
)
def test_settings_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(Room(), **wrong)  # pyrefly: ignore[bad-argument-type]
