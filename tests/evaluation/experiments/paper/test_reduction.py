"""The picture with bits set to zero."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.experiments.paper.colour_reduction import PANEL, reduction_strip, reduction_table


def test_each_panel_has_its_bits_cleared() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (50, 70, 3), dtype=np.uint8)
    strip = reduction_strip(picture)
    assert strip.shape == (106, 4 * 76 - 6, 3)
    for bits in range(8):
        top, left = bits // 4 * 56, bits % 4 * 76
        panel = strip[top : top + 50, left : left + 70]
        np.testing.assert_array_equal(panel, picture // 2**bits * 2**bits)
    assert (strip[50:56] == 255).all()


def test_a_large_picture_is_made_smaller_first() -> None:
    strip = reduction_strip(np.full((1000, 500, 3), 201, np.uint8), (0, 3))
    assert strip.shape == (PANEL, 2 * PANEL // 2 + 6, 3)
    assert (strip[:, : PANEL // 2] == 201).all()
    assert (strip[:, -PANEL // 2 :] == 200).all()


def test_what_is_left() -> None:
    wedge = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)
    table = reduction_table(wedge)
    assert [row[1] for row in table.rows] == [256**3 // 8**bits for bits in range(8)]
    assert [row[2] for row in table.rows] == [256 >> bits for bits in range(8)]
    assert table.rows[0][3] is None
    # The mean of 0, 1, 4 … 49.
    assert table.rows[3][3] == pytest.approx(10 * np.log10(255**2 / 17.5))
