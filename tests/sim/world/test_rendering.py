"""`project` and `locate` are inverse to each other and follow the equations of the lens."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim.world.rendering import Sheet, View, Waviness

pytestmark = pytest.mark.slow

PAGE_MM = (1189.0, 841.0)
FRAME_PX = (2601, 1732)


def view(waviness_mm: float = 3.0, turn: tuple[float, float, float] = (2.0, -3.0, 0.5), k1: float = -0.03) -> View:
    surface = Sheet(Waviness.random(1, waviness_mm, PAGE_MM))
    distortion = (k1, 0.01, 2e-4, -3e-4)
    return View.framed(surface, FRAME_PX, fill=0.94, focal_diagonals=1.3, turn_deg=turn, distortion=distortion)


def corners() -> NDArray[np.float64]:
    width, height = PAGE_MM
    return np.array([[0, 0], [width, 0], [width, height], [0, height], [width / 2, height / 2], [300, 700]])


def test_flat_print_fills_its_share_of_the_frame() -> None:
    surface = Sheet(Waviness.random(1, 0, PAGE_MM))
    straight = View.framed(
        surface, FRAME_PX, fill=0.94, focal_diagonals=1.3, turn_deg=(0, 0, 0), distortion=(0, 0, 0, 0)
    )
    pixels = straight.project(corners())
    # The height binds: 841 mm over 0.94 · 1732 px.
    scale = 0.94 * 1732 / 841
    np.testing.assert_allclose(pixels, (corners() - [1189 / 2, 841 / 2]) * scale + [1300, 865.5], atol=1e-9)


def test_project_equals_opencv() -> None:
    face = view()
    points = corners()
    flat = points - np.array(PAGE_MM) / 2
    space = np.column_stack([flat, -face.surface.height(points)])
    turn, _ = cv2.Rodrigues(face.rotation)
    camera = np.array(
        [
            [face.focal_px, 0, face.centre_px[0]],
            [0, face.focal_px, face.centre_px[1]],
            [0, 0, 1],
        ]
    )
    away = np.array([0.0, 0.0, face.distance_mm])
    expected, _ = cv2.projectPoints(space, turn, away, camera, np.array(face.distortion))
    np.testing.assert_allclose(face.project(points), expected[:, 0], atol=1e-6)


def test_nearer_points_are_farther_from_the_axis() -> None:
    flat, wavy = view(0, (0, 0, 0), 0), view(20, (0, 0, 0), 0)
    points = np.random.default_rng(2).uniform(0, 1, (200, 2)) * PAGE_MM
    centre = np.array(flat.centre_px)
    grows = np.linalg.norm(wavy.project(points) - centre, axis=1) > np.linalg.norm(
        flat.project(points) - centre, axis=1
    )
    np.testing.assert_array_equal(grows, wavy.surface.height(points) > 0)


@given(
    x=st.floats(-100, 2700),
    y=st.floats(-100, 1832),
    tilt=st.floats(-10, 10),
    pan=st.floats(-10, 10),
    roll=st.floats(-180, 180),
    waviness=st.floats(0, 12),
    k1=st.floats(-0.2, 0.2),
)
def test_locate_inverts_project(
    x: float, y: float, tilt: float, pan: float, roll: float, waviness: float, k1: float
) -> None:
    face = view(waviness, (tilt, pan, roll), k1)
    pixel = np.array([[x, y]])
    np.testing.assert_allclose(face.project(face.locate(pixel)), pixel, atol=1e-6)


@given(seed=st.integers(0, 2**32), height=st.floats(0.1, 20))
def test_paper_has_the_given_waviness(seed: int, height: float) -> None:
    surface = Waviness.random(seed, height, PAGE_MM)
    x, y = np.meshgrid(np.linspace(0, PAGE_MM[0], 97), np.linspace(0, PAGE_MM[1], 83))
    assert 0.97 * height <= np.ptp(surface.height(np.stack([x, y], axis=-1))) <= 1.03 * height
