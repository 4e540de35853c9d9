"""Datasets made like a real one: pictures drawn on made-up numbers, what is advised, and `generate --like`."""

from __future__ import annotations

import csv
import json
import pickle
from collections import Counter
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from calibration.table.lut import open_lut
from foundation.errors import InputError
from generator.cli import main
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import open_dataset
from generator.lights.gamut import Gamut
from generator.likeness.real_data import (
    BY_QUANTILES,
    BY_SPREAD,
    DrawnPictures,
    MeasuredPictures,
    Reached,
    cautions,
    draw_pictures,
    drawn_sources,
    remedies,
)
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import Source
from generator.rendering.black_points import BlackPoint
from generator.statistics import RealStatistics, cell_means, numbers_of_cells
from tests.generator.likeness.tables import make_table, seen
from tests.generator.stats_files import write_stats

if TYPE_CHECKING:
    from calibration.table.lut import Lut


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
    with pytest.raises(InputError, match="300"):
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


PLAIN = DatasetOptions(rendering="codes")
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


pytestmark = pytest.mark.slow


def save(path: Path, codes: npt.NDArray[np.uint8]) -> None:
    path.write_bytes(cv2.imencode(".png", codes[..., ::-1])[1].tobytes())


PICTURES = 36


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a table and pictures of 24 x 20 px, half of them reddish, half bluish."""
    folder = tmp_path_factory.mktemp("likeness")
    make_table(folder / "lut", "one", (0, 1, 2, 3, 4))
    (folder / "pictures").mkdir()
    random = np.random.default_rng(8)
    for number in range(PICTURES):
        tint = np.array([60, 0, -60] if number % 2 else [-60, 0, 60])
        codes = np.clip(random.integers(0, 256, (20, 24, 3)) + tint, 0, 255).astype(np.uint8)
        save(folder / "pictures" / f"{number:02d}.png", codes)
    (folder / "pictures" / "bad.png").write_bytes(b"?")
    return folder


@pytest.fixture
def table(kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lut:
    """Go to a folder that leads to the table and the pictures."""
    for name in ("lut", "pictures"):
        (tmp_path / name).symlink_to(kept / name)
    monkeypatch.chdir(tmp_path)
    return open_lut(Path("lut"))


@cache
def real_numbers(reddish: float, black_taken: float = 0.0) -> dict[str, npt.ArrayLike]:
    """Return numbers as of a real set of which that share is reddish, else like the pictures.

    Of the print's black, which is a tenth of white, that share is taken out of them.
    """
    random = np.random.default_rng(1)
    cells = seen("one", 2)
    white = cells[-1]
    values: dict[str, list[float]] = {}
    for number in range(100):
        tint = np.array([60, 0, -60] if number < 100 * reddish else [-60, 0, 60])
        codes = np.clip(random.integers(0, 256, (20, 24, 3)) + tint, 0, 255)
        index = (codes >> 6) @ np.array([16, 4, 1])
        image = (np.rint(cells)[index] - 0.1 * black_taken * white) / (1 - 0.1 * black_taken)
        for name, value in numbers_of_cells(cell_means(image, white))[0].items():
            values.setdefault(name, []).append(value)
    return dict(values)


def lights_of(lut: Lut, count: int = 40) -> npt.NDArray[np.float64]:
    """Return lights within the table's gamut."""
    weights = np.random.default_rng(2).dirichlet(np.ones(len(lut.white)), count)
    return weights @ lut.ground_truth


def recorded(name: str = "out") -> dict[str, Any]:
    return json.loads(Path(name, "dataset.json").read_text())["options"]


WISH = ("--sources", "pictures", "--no-preview", "--like", "s.json", "--random", "1")


def test_pictures_lights_and_what_is_recorded(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    """Three quarters of the real images are reddish, so three quarters of the images are of reddish pictures."""
    write_stats(Path("s.json"), lights_of(table), real_numbers(0.75), sizes=[])
    assert main(("lut", "out", *WISH, "--draw", "200", "--seed", "4")) == 0
    printed = capsys.readouterr().out
    assert "lights: 0.0% of the 40 of real lie outside what lut can make" in printed
    assert "200 draws of" in printed
    assert f"of {PICTURES} measured" in printed
    dataset = open_dataset("out")
    different = len({entry.source for entry in dataset.entries})
    assert f"out: 200 images of 200 pictures, {different} of them different, under " in printed
    assert len(dataset.entries) == 200
    reddish = [int(entry.source.removesuffix(".png")) % 2 for entry in dataset.entries]
    # 100 real images say .75 within .04, and the prior draws it a little towards the half that it is without.
    assert np.mean(reddish) == pytest.approx(0.75, abs=0.08)
    options = recorded()
    assert options["like"]["file"] == "s.json"
    assert options["like"]["in"] == ["lights", "pictures", "exposure", "size"]
    assert options["like"]["pictures"]["measured"] == PICTURES
    assert options["like"]["pictures"]["drawn"] == 200
    assert options["lights"]["distribution"] == "log kernels"
    with Path("out/images.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    drawn: dict[str, int] = {}
    for entry in dataset.entries:
        drawn[entry.source] = drawn.get(entry.source, 0) + 1
    for entry, row in zip(dataset.entries, rows, strict=True):
        assert row["image"] == entry.image
        assert abs(drawn[entry.source] - 200 / PICTURES * float(row["weight"])) <= 1
    # A picture drawn several times is under another light each time, and shares its name, hence its fold.
    assert len({entry.lights for entry in dataset.entries}) > 190
    assert len({entry.source for entry in dataset.entries}) <= PICTURES


def test_the_same_command_gives_the_same_bytes(table: Lut) -> None:
    write_stats(Path("s.json"), lights_of(table), real_numbers(0.75))
    for out, workers in (("a", "1"), ("b", "3")):
        assert main(("lut", out, *WISH, "--workers", workers, "--seed", "4")) == 0
    assert Path("a/SHA256SUMS").read_bytes() == Path("b/SHA256SUMS").read_bytes()


def test_size_and_exposure(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    values = real_numbers(0.5) | {"exposure": np.linspace(0.2, 0.6, 100)}
    sizes = [{"width": 900, "height": 600, "images": 90}, {"width": 600, "height": 900, "images": 10}]
    write_stats(Path("s.json"), lights_of(table), values, sizes=sizes)
    assert main(("lut", "out", *WISH, "--seed", "4")) == 0
    printed = capsys.readouterr().out
    assert "size: 24x16 px, as large as nine of ten pictures allow in that shape; most real images have" in printed
    assert "exposure: 0.40 of saturation in the median" in printed
    dataset = open_dataset("out")
    images = [dataset.read_image(entry) for entry in dataset.entries]
    assert {image.shape for image in images} == {(16, 24, 3)}
    reached = [np.percentile(image.max(axis=2), 99) / 12000 for image in images]
    assert min(reached) > 0.17
    assert max(reached) < 0.65
    assert np.median(reached) == pytest.approx(0.4, abs=0.08)


def test_what_other_options_say_is_not_followed(table: Lut) -> None:
    write_stats(Path("s.json"), lights_of(table), real_numbers(0.5))
    wish = ("--sources", "pictures", "--no-preview", "--like", "s.json")
    assert main(("lut", "out", *wish, "--illuminations", "1,2", "--max-side", "20", "--exposure", "1")) == 0
    assert recorded()["like"]["in"] == ["pictures"]
    assert recorded()["lights"] == {"choice": "listed", "lights": [1, 2]}


def test_lights_of_the_very_table_are_not_outside_by_what_a_file_rounds(
    table: Lut, capsys: pytest.CaptureFixture[str]
) -> None:
    rounded: npt.NDArray[np.float64] = np.round(table.ground_truth, 6)
    write_stats(Path("s.json"), rounded, real_numbers(0.5))
    assert main(("lut", "out", *WISH, "--like-in", "lights", "--rendering", "codes")) == 0
    assert "lights: 0.0% of the 5 of real lie outside" in capsys.readouterr().out


def test_lights_outside_the_gamut_are_counted_and_others_drawn(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    far = np.array([[0.9, 0.05, 0.05], [0.89, 0.06, 0.05], [0.9, 0.06, 0.04], [0.88, 0.06, 0.06]])
    lights = np.concatenate([lights_of(table, 12), far])
    write_stats(Path("s.json"), lights, real_numbers(0.5))
    wish = (*WISH, "--like-in", "lights", "--rendering", "codes")
    assert main(("lut", "out", *wish)) == 0
    assert "lights: 25.0% of the 16 of real lie outside what lut can make; others" in capsys.readouterr().out
    assert recorded()["like"]["lights"] == {"count": 16, "outside": 0.25}
    truths = np.array([entry.truth for entry in open_dataset("out").entries])
    nearest = [Gamut.of(table).match(truth, "nearest").angle for truth in truths]
    assert max(nearest) < 0.02
    write_stats(Path("s.json"), far, real_numbers(0.5))
    assert main(("lut", "none", *wish)) == 2
    assert "of the distribution lies within what" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--like-in", "lights", "--match", "s.json"), "--match says the lights, and so does --like"),
        (("--like-in", "exposure"), "s.json knows no exposure"),
        (("--like-in", "lights", "--black-point", "like"), "--black-point like draws pictures with the shadows of"),
    ],
)
def test_options_that_do_not_go_together(
    table: Lut, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], told: str
) -> None:
    write_stats(Path("s.json"), lights_of(table), real_numbers(0.5))
    assert main(("lut", "out", "--sources", "pictures", "--like", "s.json", *options)) == 2
    assert told in capsys.readouterr().err


def test_files_that_cannot_be_followed(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    def refused() -> str:
        assert main(("lut", "out", *WISH)) == 2
        assert not Path("out").exists()
        return capsys.readouterr().err

    write_stats(Path("s.json"), lights_of(table, 2), real_numbers(0.5))
    assert "no density fits the 2 lights of s.json" in refused()
    write_stats(Path("s.json"), lights_of(table), {"grey_red": [0.1, 0.2, 0.3]})
    assert "s.json has luminance_1 of 0 images" in refused()


def test_an_encoded_and_a_small_real_set_are_told_of(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    values: dict[str, npt.ArrayLike] = {name: np.asarray(given)[:5] for name, given in real_numbers(0.5).items()}
    values["luminance_50"] = np.full(5, 0.45)
    write_stats(Path("s.json"), lights_of(table), values)
    assert main(("lut", "out", *WISH)) == 0
    printed = capsys.readouterr().out
    assert "if they are encoded for a display, describe linear ones" in printed
    assert "real has 5 images" in printed
    assert "Luminance, 50th percentile: " in printed
    assert "what may help: more pictures with --sources" in printed
    assert "pictures measured under one light" in printed


def test_pictures_are_measured_as_they_will_be_rendered(table: Lut) -> None:
    """Without the print's black, which is a tenth of white in this table, shadows are darker, and so measured."""
    write_stats(Path("s.json"), lights_of(table), real_numbers(0.5))
    found: dict[str, float] = {}
    for black in ("keep", "compensate"):
        wish = ("--sources", "pictures", "--no-preview", "--like", "s.json", "--like-in", "pictures")
        assert main(("lut", black, *wish, "--black-point", black, "--illuminations", "2")) == 0
        figure = recorded(black)["like"]["pictures"]["figures"]["luminance_1"]
        dataset = open_dataset(black)
        images = [(dataset.read_image(entry), entry.truth) for entry in dataset.entries]
        seen = [numbers_of_cells(cell_means(image, truth))[0]["luminance_1"] for image, truth in images]
        assert np.median(seen) == pytest.approx(figure["after"], rel=0.05)
        found[black] = figure["before"]
    assert found["compensate"] < 0.7 * found["keep"]


def test_shadows_are_made_like_the_real_ones_by_the_black_of_each_picture(
    table: Lut, capsys: pytest.CaptureFixture[str]
) -> None:
    write_stats(Path("s.json"), lights_of(table), real_numbers(0.5, black_taken=0.5))
    wish = ("--sources", "pictures", "--no-preview", "--like", "s.json", "--like-in", "pictures", "--draw", "150")
    wish += ("--rendering", "codes")
    away: dict[str, float] = {}
    for black in ("keep", "like"):
        assert main(("lut", black, *wish, "--black-point", black, "--random", "1")) == 0
        dataset = open_dataset(black)
        images = [(dataset.read_image(entry), entry.truth) for entry in dataset.entries]
        seen = [numbers_of_cells(cell_means(image, truth))[0]["luminance_1"] for image, truth in images]
        figure = recorded(black)["like"]["pictures"]["figures"]["luminance_1"]
        # What was promised is what the images are.
        assert np.median(seen) == pytest.approx(figure["after"], rel=0.1)
        away[black] = abs(np.log(np.median(seen) / figure["wanted"]))
    assert away["like"] < 0.05 < 0.15 < away["keep"]
    with Path("like/images.csv").open() as stream:
        shares = np.array([float(row["black_taken"]) for row in csv.DictReader(stream)])
    assert np.median(shares) == pytest.approx(0.5, abs=0.16)
    assert recorded("like")["like"]["pictures"]["black_taken"] == pytest.approx(shares.mean(), rel=1e-4)
    assert "share of the print's black taken out: " in capsys.readouterr().out
