"""Unfit colours are replaced by the nearest fit colour, other colours are kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.table.lut import Provenance, Unfit
from generator.kernels.choice import channels_of
from generator.kernels.unfit import colours_in, nearest_fit_colours, replace_unfit_colours


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(1, 5), st.integers(1, 30), st.integers(1, 30), st.integers(0, 2**32 - 1), st.booleans())
def test_replaces_exactly_the_unfit_colours(bits: int, height: int, width: int, seed: int, is_single: bool) -> None:
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    unfit = rng.choice(8**bits, 1 if is_single else min(8**bits - 1, 40), replace=False)
    provenance = Provenance(
        camera="Test",
        bits=bits,
        white_level=9,
        session_sha256="1" * 64,
        chart_sha256="2" * 64,
        software="test",
        unfit=[Unfit(colour=int(colour), cause="stain") for colour in unfit],
    )
    original = picture.copy()
    fit, count = replace_unfit_colours(picture, provenance)
    np.testing.assert_array_equal(picture, original)
    upper = (picture >> (8 - bits)).astype(np.int64)
    colour = (upper[..., 0] << 2 * bits) | (upper[..., 1] << bits) | upper[..., 2]
    np.testing.assert_array_equal(np.flatnonzero(colours_in(picture, bits)), np.unique(colour))
    is_unfit = np.isin(colour, unfit)
    assert count == np.count_nonzero(is_unfit)
    np.testing.assert_array_equal(fit[~is_unfit], picture[~is_unfit])
    replacements = dict(zip(unfit.tolist(), nearest_fit_colours(unfit, bits).tolist(), strict=True))
    codes = channels_of([replacements[index] for index in colour[is_unfit].tolist()], bits) << (8 - bits)
    np.testing.assert_array_equal(fit[is_unfit], codes.reshape(-1, 3))
