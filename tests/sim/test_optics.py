"""Shoulders, veiling glare and lateral aberration of the lens, waves and curl of the paper, compared with formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.presenter import WHITE, Colour
from sim.optics import PhotographicLens
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import REFERENCE_EXPOSURE, Blob, Room, Situation, World

PAGE_MM = (180.0, 125.0)
EVEN: dict[str, float] = {"vignetting": 0.0, "projector_falloff": 0.0, "response_spread": 0.0, "black_leak": 0.0}


def planes(signal: NDArray[np.floating]) -> dict[str, NDArray[np.float64]]:
    """Return R, G1 and B of each RGGB block, at their positions in the block."""
    complete = signal[: len(signal) // 2 * 2, : signal.shape[1] // 2 * 2].astype(np.float64)
    return {"R": complete[::2, ::2], "G": complete[::2, 1::2], "B": complete[1::2, 1::2]}


AT_PX = {"R": np.array([-0.25, -0.25]), "G": np.array([0.25, -0.25]), "B": np.array([0.25, 0.25])}
"""Where the photosite of each of `planes` lies in its block, x then y."""


def white_squares(centres: NDArray[np.float64], side: float) -> Print:
    """Return white squares on a black page."""
    boxes = np.concatenate([[[0, 0, *PAGE_MM]], np.column_stack([centres - side / 2, centres + side / 2])])
    rgb = np.full((len(boxes), 3), 255, dtype=np.uint8)
    rgb[0] = 0
    return Print(PAGE_MM, boxes, rgb)


def test_kernel_has_the_documented_transfer() -> None:
    """Closed form of a two-dimensional exponential, up to a third of the sampling frequency."""
    kernel = PhotographicLens((100, 100), 0.1, 3.0, 0, 0, 0).kernel().astype(np.float64)
    np.testing.assert_allclose(kernel, kernel[::-1], rtol=1e-6)
    np.testing.assert_allclose(kernel, kernel.T, rtol=1e-6)
    across = np.arange(len(kernel)) - len(kernel) // 2
    for frequency in (0.02, 0.05, 0.1, 0.2, 0.3):
        measured = (kernel.sum(axis=0) * np.cos(2 * np.pi * frequency * across)).sum()
        stated = (1 + (2 * np.pi * 3 / 3**0.5 * frequency) ** 2) ** -1.5
        assert measured == pytest.approx(stated, abs=0.005)


@pytest.mark.slow
@pytest.mark.parametrize("situation", [Situation(), Situation(blobs=(Blob((0.2, 0.2, 0.7, 0.9)),))])
def test_veil_is_a_share_of_the_mean_light(situation: Situation) -> None:
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


def test_channels_are_at_projected_positions() -> None:
    """Centroids of white squares in each channel, with a wavy and rotated print."""
    x, y = np.meshgrid([12.0, 50.0, 90.0, 131.0, 168.0], [12.0, 62.0, 113.0])
    centres = np.column_stack([x.ravel(), y.ravel()])
    room = Room(lateral_red_px=1.5, lateral_blue_px=-0.8, blur_px=0.8, seed=4, tilt_deg=3, pan_deg=4)
    room = replace(room, **EVEN)  # pyrefly: ignore[bad-argument-type]
    world = World(white_squares(centres, 3.0), BODIES["Test"], room)
    for channel, plane in planes(world.signal(WHITE, REFERENCE_EXPOSURE)).items():
        truth = world.project(centres, channel)
        for position in truth:
            column, row = (round(float(along)) for along in position)
            rows, columns = slice(row - 15, row + 16), slice(column - 15, column + 16)
            if row < 15 or column < 15 or row + 16 > plane.shape[0] or column + 16 > plane.shape[1]:
                pytest.fail("the square lies too near to the frame's edge to be measured")
            light = plane[rows, columns] - np.median(plane[rows, columns])
            offsets = np.arange(-15, 16)
            measured = np.array([(light.sum(axis=0) @ offsets), (light.sum(axis=1) @ offsets)]) / light.sum()
            np.testing.assert_allclose(measured + [column, row] + AT_PX[channel], position, atol=0.01)


def test_lateral_aberration_has_the_documented_size() -> None:
    lens = PhotographicLens((1732, 2601), 0, 3.0, 0, 1.0, -0.5)
    corner, axis = np.array([[-0.5, -0.5]]), np.array(lens.centre_px)
    assert np.linalg.norm(lens.shifted(corner, "R") - axis) - lens.corner_px == pytest.approx(1.0)
    assert np.linalg.norm(lens.shifted(corner, "B") - axis) - lens.corner_px == pytest.approx(-0.5)
    half = (corner + axis) / 2
    assert np.linalg.norm(lens.shifted(half, "R") - half) == pytest.approx(0.5 * (1 + 0.25) / 2)
    positions = np.random.default_rng(1).uniform(-20, 2600, (50, 2))
    for channel in "RGB":
        np.testing.assert_allclose(lens.unshifted(lens.shifted(positions, channel), channel), positions, atol=1e-6)
