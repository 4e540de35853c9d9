"""Comparisons of arrays that compare nothing fail: `tests/conftest.py` sees to it."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.mark.parametrize("compare", [np.testing.assert_allclose, np.testing.assert_array_equal])
def test_an_array_without_numbers_is_no_match(compare: object) -> None:
    assert callable(compare)
    compare(np.ones(2), 1)
    compare(np.ones(0), np.ones(0))
    with pytest.raises(AssertionError, match="nothing was tested"):
        compare(np.ones((20, 30))[10:-10], 1)
