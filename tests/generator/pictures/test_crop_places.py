"""Several crops of one picture: different, repeatable, the first where a single one is cut."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from foundation.errors import FormatError
from generator.pictures.sources import Preparation, open_picture, random_places


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a picture of 60 x 50 px."""
    codes = np.random.default_rng(3).integers(0, 256, (50, 60, 3)).astype(np.uint8)
    place = tmp_path / "a.png"
    place.write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    return place


def test_crops_are_parts_of_the_picture_and_the_first_is_the_single_one(path: Path) -> None:
    whole = open_picture(path).picture
    several = open_picture(path, Preparation(crop=(16, 12), crops=5, seed=4))
    single = open_picture(path, Preparation(crop=(16, 12), crop_at="random", seed=4))
    np.testing.assert_array_equal(several.picture, single.picture)
    assert len({(cut.left, cut.top) for cut in several.cuts}) == 5
    for cut in several.cuts:
        np.testing.assert_array_equal(cut.picture, whole[cut.top : cut.top + 12, cut.left : cut.left + 16])
    fewer = open_picture(path, Preparation(crop=(16, 12), crops=2, seed=4))
    assert [(cut.left, cut.top) for cut in fewer.cuts] == [(cut.left, cut.top) for cut in several.cuts[:2]]
    other = open_picture(path, Preparation(crop=(16, 12), crops=2, seed=5))
    assert [(cut.left, cut.top) for cut in other.cuts] != [(cut.left, cut.top) for cut in fewer.cuts]


def test_the_first_of_several_is_in_the_centre_where_that_is_said(path: Path) -> None:
    whole = open_picture(path, Preparation(crop=(16, 12))).picture
    wish = Preparation(crop=(16, 12), crops=4, crop_at="centre", seed=4)
    cuts = open_picture(path, wish).cuts
    assert (cuts[0].left, cuts[0].top) == (22, 19)
    np.testing.assert_array_equal(cuts[0].picture, whole)
    assert len({(cut.left, cut.top) for cut in cuts}) == 4


@pytest.mark.slow
def test_crops_keep_away_from_each_other() -> None:
    def shared(count: int, together: bool) -> float:
        """Return the mean share of a crop that the second has in common with the first."""
        total = 0
        for number in range(count):
            if together:
                one, other = random_places((61, 41), (40, 40), 2, 9, f"{number}.png")
            else:
                (one,), (other,) = (random_places((61, 41), (40, 40), 1, seed, f"{number}.png") for seed in (9, 10))
            total += max(0, 40 - abs(one[0] - other[0])) * max(0, 40 - abs(one[1] - other[1]))
        return total / 1600 / count

    assert shared(300, together=True) < 0.35 * shared(300, together=False)


def test_every_place_is_found_where_all_are_wanted(path: Path) -> None:
    assert len(set(random_places((5, 4), (9, 9), 20, 1, "x"))) == 20
    with pytest.raises(FormatError, match="has 3"):
        open_picture(path, Preparation(crop=(58, 50), crops=4))


@pytest.mark.slow
def test_places_are_even() -> None:
    places = np.array([random_places((10, 10), (5, 5), 1, 0, f"{number}")[0] for number in range(1500)])
    counts = np.bincount(places[:, 0] * 10 + places[:, 1], minlength=100)
    # Chi-squared of 99 degrees of freedom exceeds 149 once in a thousand.
    assert np.square(counts - 15).sum() / 15 < 149
