"""Shares of a picture's pixels among source nodes, and what a print makes of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from generator.rendering.gamut_summaries import node_shares
from generator.rendering.source_colours import node_codes


@given(st.integers(0, 2**24 - 1), st.integers(1, 3), st.integers(1, 3))
def test_the_nodes_of_a_colour_have_its_mean(colour: int, height: int, width: int) -> None:
    codes = np.array([colour >> 16, colour >> 8 & 255, colour & 255], np.uint8)
    shares = node_shares(np.broadcast_to(codes, (height, width, 3)))
    assert shares.min() >= 0
    assert shares.sum() == pytest.approx(1)
    np.testing.assert_allclose(shares @ node_codes(), codes / 255, atol=1e-12)
    assert (shares > 0).sum() <= 8


@pytest.mark.parametrize("shape", [(1, 200_000), (200_000, 1), (700, 500)])
def test_large_pictures_are_looked_at_on_a_grid(shape: tuple[int, int]) -> None:
    picture = np.zeros((*shape, 3), np.uint8)
    flat = picture.reshape(-1, 3)
    flat[len(flat) // 4 :] = 255
    shares = node_shares(picture)
    assert shares[0] == pytest.approx(0.25, abs=0.01)
    assert shares[-1] == pytest.approx(0.75, abs=0.01)
