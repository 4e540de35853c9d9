"""Where a frame is looked at in which no chart is known: its brightest places and those of most texture."""

from __future__ import annotations

import numpy as np

from acquisition.judge import measure
from drivers.raw.rawfile import Plane


def test_the_brightest_place_of_each_part_is_paper() -> None:
    height, width = 12 * 24, 16 * 20
    values = np.full((height, width), 100, dtype=np.float32)
    random = np.random.default_rng(1)
    corners = [(left, top) for top in range(2, height - 24, 24) for left in range(2, width - 20, 20)]
    places = [(left + int(random.integers(2, 16)), top + int(random.integers(2, 20))) for left, top in corners]
    for number, (x, y) in enumerate(places):
        # A third are darker than paper may be where light falls off.
        values[y - 1 : y + 2, x - 1 : x + 2] = 600 if number % 3 == 0 else 1000
    values[:, -16:] = 1000  # beyond the last whole part but the margin
    found = measure._brightest(values)  # pyright: ignore[reportPrivateUsage]
    assert found.tolist() == [list(place) for number, place in enumerate(places) if number % 3]


def test_texture_is_many_edges_and_no_single_bright_photosite() -> None:
    values = np.zeros((480, 640), dtype=np.float32)
    x, y = 90, 100
    values[y - 12 : y + 12 : 2, x - 12 : x + 12] = 20
    values[180, 140] = 150
    framing = measure._textures(Plane("G", values, (0.5, 0.0)))  # pyright: ignore[reportPrivateUsage]
    middles = np.array([tag.corners_px.mean(axis=0) for tag in framing.tags])
    assert len(middles) == 8
    assert np.abs(middles - (x + 0.5, y)).max(axis=1).min() <= 6
