"""Red and blue lie further out than green, or nearer: measured with the map, and none where there is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.geometry import LateralColour
from calibration.registration.register import Registration, register
from drivers.raw.rawfile import Mosaic
from experiment.framing.planes import CHANNELS
from sim.world.room import Room
from tests.calibration.lab import Lab, hang

SIZE = (400, 300)


def compared(
    true: npt.NDArray[np.float64], noise_px: float = 0.0
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return places, information and pull of blocks that channels with terms `true` (2, 2) and the map move."""
    random = np.random.default_rng(3)
    places = random.uniform((0, 0), SIZE, (600, 2))
    information = np.stack([np.broadcast_to(np.eye(2) * level, (600, 2, 2)) for level in (300.0, 900.0, 200.0)])
    blank = LateralColour.unmeasured(SIZE)
    shifted = LateralColour(blank.centre_px, blank.radius_px, true, blank.covariance_px2)
    moved = np.stack([0.3 + shifted.shift_px(places, channel) for channel in CHANNELS])
    moved = moved + noise_px * random.standard_normal(moved.shape)
    return places, information, np.einsum("cnij,cnj->cni", information, moved)


def test_what_channels_share_is_the_map_and_the_rest_the_lens() -> None:
    true = np.array([[0.4, 0.7], [-0.2, -0.3]])
    found = LateralColour.unmeasured(SIZE).remeasured(*compared(true))
    assert found.terms_px == pytest.approx(true, abs=0.01)
    assert found.corner_px("R") == pytest.approx(1.1, abs=0.01)
    assert found.corner_px("B") == pytest.approx(-0.5, abs=0.01)
    assert found.corner_px("G") == 0 == found.corner_error_px("G")


def test_its_error_is_that_of_its_noise() -> None:
    true = np.array([[0.4, 0.7], [-0.2, -0.3]])
    found = LateralColour.unmeasured(SIZE).remeasured(*compared(true, noise_px=0.4))
    off = (found.terms_px - true).ravel()
    assert off @ np.linalg.solve(found.covariance_px2, off) < 18.5, "χ² of 4 degrees of freedom, once in a thousand"
    assert 0.02 < found.corner_error_px("R") < 0.3


def test_an_outline_known_across_alone_tells_it() -> None:
    true = np.array([[0.4, 0.7], [-0.2, -0.3]])
    blank = LateralColour.unmeasured(SIZE)
    along = np.linspace(20, np.array(SIZE) - 20, 100)
    level = np.full(100, 1.0)
    sides = [(along[:, 0], level * 30, (0, 1)), (along[:, 0], level * 270, (0, 1))]
    sides += [(level * 40, along[:, 1], (1, 0)), (level * 360, along[:, 1], (1, 0))]
    places = np.concatenate([np.stack([x, y], axis=-1) for x, y, _ in sides])
    normals = np.repeat(np.array([normal for _, _, normal in sides], dtype=np.float64), 100, axis=0)
    across = np.einsum("ni,nj->nij", normals, normals)
    information = np.array([100.0, 300.0, 50.0])[:, None, None, None] * across
    # Where blue is not clear nothing was measured, and where only green is clear nothing is told of the others.
    information[2, ::3] = 0
    information[0, ::6] = 0
    shifted = LateralColour(blank.centre_px, blank.radius_px, true, blank.covariance_px2)
    moved = np.stack([0.2 + shifted.shift_px(places, channel) for channel in CHANNELS])
    found = blank.remeasured(places, information, np.einsum("cnij,cnj->cni", information, moved))
    assert found.terms_px == pytest.approx(true, abs=0.02)
    assert found.corner_error_px("R") < 0.1
    green = information * np.array([0, 1, 0])[:, None, None, None]
    alone = blank.remeasured(places, green, np.einsum("cnij,cnj->cni", green, moved))
    assert not alone.terms_px.any()
    assert alone.corner_error_px("R") == blank.corner_error_px("R")


def test_blocks_of_another_picture_do_not_count_much() -> None:
    true = np.array([[0.4, 0.7], [-0.2, -0.3]])
    places, information, pull = compared(true, noise_px=0.05)
    pull[0, ::10] += information[0, ::10, 0, 0, None] * 4.0
    found = LateralColour.unmeasured(SIZE).remeasured(places, information, pull)
    assert found.corner_px("R") == pytest.approx(1.1, abs=0.06)


def test_a_dark_channel_is_as_uncertain_as_before() -> None:
    places, information, pull = compared(np.zeros((2, 2)))
    information[0], pull[0] = 0, 0
    found = LateralColour.unmeasured(SIZE).remeasured(places, information, pull)
    assert found.corner_px("R") == 0
    assert found.corner_error_px("R") > 1


def misses(registration: Registration, lab: Lab, mosaic: Mosaic) -> dict[str, float]:
    """Return the RMS distance of each channel's cells from the truth, px."""
    visible = lab.world.body.visible
    aside = np.array([mosaic.visible.left - visible.left, mosaic.visible.top - visible.top]) / 2
    found: dict[str, float] = {}
    for channel in CHANNELS:
        true = lab.world.project(lab.chart.centres_mm, channel) - aside
        off = registration.to_pixels(lab.chart.centres_mm, channel) - true
        found[channel] = float(np.sqrt((off**2).sum(axis=1).mean()))
    return found


def test_every_channel_has_its_own_place(tmp_path: Path) -> None:
    room = Room(waviness_mm=1.0, lateral_red_px=1.0, lateral_blue_px=-0.6)
    lab = hang(room=room)
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    assert max(misses(registration, lab, mosaic).values()) < 0.04
    lateral = registration.lateral
    assert lateral.corner_px("R") == pytest.approx(1.0, abs=4 * lateral.corner_error_px("R"))
    assert lateral.corner_px("B") == pytest.approx(-0.6, abs=4 * lateral.corner_error_px("B"))
    assert lateral.corner_error_px("R") < 0.1


def test_none_is_found_where_there_is_none(lab: Lab, tmp_path: Path) -> None:
    lateral = register(lab.mosaic(tmp_path), lab.chart).lateral
    for channel in ("R", "B"):
        assert abs(lateral.corner_px(channel)) < 4 * lateral.corner_error_px(channel) < 0.5
