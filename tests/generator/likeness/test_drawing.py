"""Pictures drawn to be like a real data set, on made-up numbers."""

from __future__ import annotations

import pickle
from collections import Counter

import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import InputError
from generator.likeness.real_data import (
    BY_QUANTILES,
    BY_SPREAD,
    MeasuredPictures,
    cautions,
    draw_pictures,
    drawn_sources,
)
from generator.pictures.sources import Source, random_scenes
from generator.statistics import RealStatistics

Values = dict[str, npt.NDArray[np.float64]]


def numbers(count: int, seed: int, grey: float, spread: float, chroma: float) -> Values:
    """Return made-up numbers of images: independent, luminance and chroma log-normal."""
    random = np.random.default_rng(seed)
    medians = {"luminance_1": 0.02, "luminance_50": 0.2, "luminance_95": 0.7, "chroma_spread": chroma}
    return {name: random.lognormal(np.log(median), 0.3, count) for name, median in medians.items()} | {
        name: random.normal(grey, spread, count) for name in BY_SPREAD
    }


def target(values: Values) -> RealStatistics:
    lights = np.array([[0.3, 0.4, 0.3]])
    return RealStatistics("real", "generated", 64, (), len(values["grey_red"]), lights, values, "s.json", "0")


def measured(values: Values, unreadable: int = 0) -> MeasuredPictures:
    hidden = np.arange(len(values["grey_red"])) < unreadable
    return MeasuredPictures({name: np.where(hidden, np.nan, given) for name, given in values.items()}, hidden)


def test_draws_have_the_targets_figures() -> None:
    pictures, real = numbers(3000, 1, 0.1, 0.2, 0.04), target(numbers(500, 2, 0.0, 0.12, 0.05))
    drawn = draw_pictures(measured(pictures), real, None, seed=5)
    assert len(drawn.places) == 3000
    assert 600 <= drawn.effective < 3000
    for made in drawn.reached:
        assert made.is_alike, made.sentence()
    # Against the numbers themselves, not those that are told: within 4 standard errors of 500 real images.
    chosen = {name: pictures[name][drawn.places] for name in pictures}
    assert chosen["grey_red"].mean() == pytest.approx(real.values["grey_red"].mean(), abs=0.02)
    assert chosen["grey_red"].std() == pytest.approx(0.12, rel=0.1)
    assert np.median(chosen["chroma_spread"]) == pytest.approx(0.05, rel=0.06)
    assert pictures["grey_red"].std() == pytest.approx(0.2, rel=0.1), "before"


def test_each_picture_is_drawn_as_its_weight_says() -> None:
    drawn = draw_pictures(
        measured(numbers(400, 1, 0.1, 0.2, 0.04)), target(numbers(300, 2, 0, 0.1, 0.05)), 1000, seed=5
    )
    counts = Counter(map(int, drawn.places))
    expected = drawn.weights * 1000
    assert all(np.floor(want) <= counts[place] <= np.ceil(want) for place, want in enumerate(expected))
    assert sum(counts.values()) == 1000
    assert (np.diff(drawn.places) >= 0).all()


def test_a_seed_decides_the_draw_and_nothing_else_does() -> None:
    arguments = measured(numbers(300, 1, 0.1, 0.2, 0.04)), target(numbers(300, 2, 0, 0.1, 0.05)), 200
    first, again, other = (draw_pictures(*arguments, seed=seed).places for seed in (7, 7, 8))
    assert first.tolist() == again.tolist()
    assert first.tolist() != other.tolist()


def test_pictures_that_cannot_be_read_are_never_drawn() -> None:
    drawn = draw_pictures(measured(numbers(300, 1, 0, 0.2, 0.04), 100), target(numbers(300, 2, 0, 0.1, 0.05)), None, 0)
    assert drawn.places.min() >= 100
    assert len(drawn.places) == drawn.describe()["measured"] == 200
    with pytest.raises(InputError, match="none of the 300 pictures can be read"):
        draw_pictures(measured(numbers(300, 1, 0, 0.2, 0.04), 300), target(numbers(300, 2, 0, 0.1, 0.05)), None, 0)


def test_what_is_out_of_reach_is_told_and_the_rest_is_met() -> None:
    """Pictures of a pale print have no dark cells: no weight makes some, and chroma is brought to the target's."""
    pictures = numbers(2000, 1, 0.1, 0.2, 0.04)
    pictures["luminance_1"] = np.full(2000, 0.08)
    drawn = draw_pictures(measured(pictures), target(numbers(500, 2, 0.0, 0.12, 0.05)), None, seed=1)
    told = {made.name: made for made in drawn.reached}
    assert not told["luminance_1"].is_alike
    sentence = told["luminance_1"].sentence()
    assert sentence.startswith("Luminance, 1st percentile: ")
    assert sentence.endswith("not within 25 %")
    assert all(made.is_alike for name, made in told.items() if name != "luminance_1")
    assert drawn.effective >= 0.2 * 2000


def test_of_five_real_images_little_is_taken() -> None:
    """Five real images that are as the pictures are, but for chance; and a hundred of each, which is no chance."""
    pictures, real = measured(numbers(1000, 1, 0.0, 0.2, 0.04)), numbers(5, 3, 0.0, 0.2, 0.04)
    hundredfold = {name: np.repeat(values, 100) for name, values in real.items()}
    few, many = (draw_pictures(pictures, target(values), None, 0, least_effective=0) for values in (real, hundredfold))
    assert few.effective > 10 * many.effective
    assert "has 5 images" in cautions(target(numbers(5, 3, 0, 0.1, 0.04)))[0]
    assert cautions(target(numbers(500, 3, 0, 0.1, 0.04))) == []


@pytest.mark.parametrize("count", [0, 1, 2])
def test_without_a_spread_there_is_nothing_to_follow(count: int) -> None:
    with pytest.raises(InputError, match=rf"of {count} images, expected 3 or more"):
        draw_pictures(measured(numbers(20, 1, 0, 0.2, 0.04)), target(numbers(count, 2, 0, 0.1, 0.05)), None, 0)


def test_numbers_that_masks_hide_do_not_count() -> None:
    """A real image that is masked whole has no numbers, and changes nothing."""
    real = numbers(200, 2, 0, 0.1, 0.05)
    hidden = {name: np.concatenate([values, [np.nan]]) for name, values in real.items()}
    pictures = measured(numbers(300, 1, 0.1, 0.2, 0.04))
    one, other = (draw_pictures(pictures, target(values), None, 0) for values in (real, hidden))
    assert one.weights.tolist() == other.weights.tolist()


def test_real_images_that_are_all_alike() -> None:
    real = {name: np.full(50, 0.1) for name in (*BY_QUANTILES, *BY_SPREAD)}
    drawn = draw_pictures(measured(numbers(300, 1, 0.1, 0.2, 0.04)), target(real), None, 0)
    assert np.isfinite(drawn.weights).all()
    assert drawn.effective >= 60


def test_each_draw_has_the_share_of_black_that_it_was_measured_with() -> None:
    """A picture without black has shadows that the real images have; all else of it is the same with any share."""
    pictures, shares = numbers(300, 1, 0.0, 0.1, 0.05), (0.0, 0.5, 1.0)
    pictures = {name: np.repeat(given, 3) for name, given in pictures.items()}
    pictures["luminance_1"] = pictures["luminance_1"] * np.tile([4.0, 2.0, 1.0], 300)
    given = MeasuredPictures(pictures, np.repeat(np.arange(300) < 7, 3), shares)
    drawn = draw_pictures(given, target(numbers(400, 2, 0.0, 0.1, 0.05)), 900, seed=5)
    assert drawn.blacks is not None
    assert len(drawn.weights) == 300
    assert (drawn.weights[:7] == 0).all()
    assert drawn.places.min() >= 7
    assert drawn.places.max() < 300
    assert drawn.effective > 60
    assert np.mean(drawn.blacks == 1.0) > 0.8
    reached = {made.name: made for made in drawn.reached}
    assert reached["luminance_1"].is_alike
    assert reached["luminance_1"].before > 1.6 * reached["luminance_1"].wanted
    sources = drawn_sources(random_scenes(300, 8, 6, seed=3), drawn)
    assert [source.black_taken for source in sources] == drawn.blacks.tolist()
    assert sources[0].read().black_taken == sources[0].to_json()["black_taken"] == sources[0].black_taken


def test_drawn_sources_keep_their_names_and_know_their_weights() -> None:
    scenes = random_scenes(300, 8, 6, seed=3)
    drawn = draw_pictures(measured(numbers(300, 1, 0.1, 0.2, 0.04)), target(numbers(300, 2, 0, 0.1, 0.05)), 900, seed=5)
    sources = drawn_sources(scenes, drawn)
    assert [source.name for source in sources] == [scenes[place].name for place in map(int, drawn.places)]
    weights = {source.name: source.weight for source in sources}
    counts = Counter(map(str, (source.name for source in sources)))
    assert all(abs(counts[name] - 3 * weight) <= 1 for name, weight in weights.items())
    # Workers of a cluster get sources by pickle.
    again: Source = pickle.loads(pickle.dumps(sources[0]))
    assert again.to_json() == sources[0].to_json()
    assert sources[0].read().weight == sources[0].weight
    first: Source = scenes[int(drawn.places[0])]
    assert sources[0].to_json() == {**first.to_json(), "weight": sources[0].weight}
