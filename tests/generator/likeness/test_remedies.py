"""What is advised where pictures drawn are not like the real data set."""

from __future__ import annotations

import numpy as np
import pytest

from generator.dataset.plan import DatasetOptions
from generator.likeness.real_data import DrawnPictures, Reached, remedies
from generator.rendering.black_points import BlackPoint

PLAIN = DatasetOptions()
FREED = DatasetOptions(rendering="colorimetric", black_point=BlackPoint("like"))


def drawn(**ratios: float) -> DrawnPictures:
    """Return pictures whose figures are so many times the wanted ones."""
    reached = tuple(Reached(name, 0.1, 0.2, 0.1 * ratio, 0.1) for name, ratio in ratios.items())
    return DrawnPictures(np.ones(4) / 4, np.arange(4), reached)


def test_what_is_alike_needs_no_advice() -> None:
    assert remedies(drawn(luminance_1=1.2, chroma_spread=0.85), PLAIN) == []


@pytest.mark.parametrize("ratios", [{"luminance_1": 1.6}, {"chroma_spread": 0.5}])
def test_pale_pictures_are_rendered_by_colour_without_black(ratios: dict[str, float]) -> None:
    advice = " ".join(remedies(drawn(**ratios), PLAIN))
    assert "--rendering colorimetric" in advice
    assert "--black-point like" in advice
    # What is on already is no advice: more pictures are left.
    (only,) = remedies(drawn(**ratios), FREED)
    assert "more pictures" in only


def test_shadows_that_are_too_dark_get_as_much_black_as_is_theirs() -> None:
    taken = DatasetOptions(rendering="colorimetric", black_point=BlackPoint("compensate"))
    advice = " ".join(remedies(drawn(luminance_1=0.5), taken))
    assert "--black-point like" in advice
    assert "--rendering" not in advice


def test_chroma_that_is_too_much_is_not_made_more() -> None:
    (only,) = remedies(drawn(chroma_spread=1.6), PLAIN)
    assert "more pictures" in only
