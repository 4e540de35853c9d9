"""`generate --like`, with a table and pictures whose numbers are known."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from generator.cli import main
from generator.dataset.reader import open_dataset
from generator.lights.gamut import Gamut
from generator.statistics import cell_means, numbers_of_cells
from tests.generator.likeness.tables import make_table
from tests.generator.statistics.stats_files import write_stats

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from calibration.table.lut import Lut


def save(path: Path, codes: npt.NDArray[np.uint8]) -> None:
    path.write_bytes(cv2.imencode(".png", codes[..., ::-1])[1].tobytes())


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lut:
    """Go to a folder with a table and 60 pictures of 24 x 20 px, half of them reddish, half bluish."""
    lut = make_table(tmp_path / "lut", "one", (0, 1, 2, 3, 4))
    (tmp_path / "pictures").mkdir()
    random = np.random.default_rng(8)
    for number in range(60):
        tint = np.array([60, 0, -60] if number % 2 else [-60, 0, 60])
        codes = np.clip(random.integers(0, 256, (20, 24, 3)) + tint, 0, 255).astype(np.uint8)
        save(tmp_path / "pictures" / f"{number:02d}.png", codes)
    (tmp_path / "pictures" / "bad.png").write_bytes(b"?")
    monkeypatch.chdir(tmp_path)
    return lut


def real_numbers(lut: Lut, reddish: float, black_taken: float = 0.0) -> dict[str, npt.ArrayLike]:
    """Return numbers as of a real set of which that share is reddish, else like the pictures.

    Of the print's black, which is a tenth of white, that share is taken out of them.
    """
    random = np.random.default_rng(1)
    values: dict[str, list[float]] = {}
    for number in range(100):
        tint = np.array([60, 0, -60] if number < 100 * reddish else [-60, 0, 60])
        codes = np.clip(random.integers(0, 256, (20, 24, 3)) + tint, 0, 255)
        index = (codes >> 6) @ np.array([16, 4, 1])
        image = lut.samples[2].astype(float).mean(axis=1)[index]
        image = (image - 0.1 * black_taken * lut.white[2]) / (1 - 0.1 * black_taken)
        for name, value in numbers_of_cells(cell_means(image, lut.white[2]))[0].items():
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
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.75), sizes=[])
    assert main(("lut", "out", *WISH, "--draw", "200", "--seed", "4")) == 0
    printed = capsys.readouterr().out
    assert "lights: 0.0% of the 40 of real lie outside what lut can make" in printed
    assert "200 draws of" in printed
    assert "of 60 measured" in printed
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
    assert options["like"]["pictures"]["measured"] == 60
    assert options["like"]["pictures"]["drawn"] == 200
    assert options["lights"]["distribution"] == "log kernels"
    with Path("out/images.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    drawn: dict[str, int] = {}
    for entry in dataset.entries:
        drawn[entry.source] = drawn.get(entry.source, 0) + 1
    for entry, row in zip(dataset.entries, rows, strict=True):
        assert row["image"] == entry.image
        assert abs(drawn[entry.source] - 200 / 60 * float(row["weight"])) <= 1
    # A picture drawn several times is under another light each time, and shares its name, hence its fold.
    assert len({entry.lights for entry in dataset.entries}) > 190
    assert len({entry.source for entry in dataset.entries}) < 61


def test_the_same_command_gives_the_same_bytes(table: Lut) -> None:
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.75))
    for out, workers in (("a", "1"), ("b", "3")):
        assert main(("lut", out, *WISH, "--workers", workers, "--seed", "4")) == 0
    assert Path("a/SHA256SUMS").read_bytes() == Path("b/SHA256SUMS").read_bytes()


def test_size_and_exposure(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    values = real_numbers(table, 0.5) | {"exposure": np.linspace(0.2, 0.6, 100)}
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


def test_thumbnails_say_nothing_of_size(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    data = {"name": "small", "layout": "thumbnails", "place": "", "images": 100}
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.5), data=data)
    assert main(("lut", "out", *WISH)) == 0
    printed = capsys.readouterr().out
    assert "size: small is of thumbnails" in printed
    assert "exposure: that of small is not known without its saturation" in printed
    assert (recorded()["like"]["in"], "crop" in recorded()) == (["lights", "pictures", "exposure", "size"], False)


def test_what_other_options_say_is_not_followed(table: Lut) -> None:
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.5))
    wish = ("--sources", "pictures", "--no-preview", "--like", "s.json")
    assert main(("lut", "out", *wish, "--illuminations", "1,2", "--max-side", "20", "--exposure", "1")) == 0
    assert recorded()["like"]["in"] == ["pictures"]
    assert recorded()["lights"] == {"choice": "listed", "lights": [1, 2]}
    assert main(("lut", "lights", *wish, "--like-in", "lights")) == 0
    assert recorded("lights")["like"]["in"] == ["lights"]
    assert not Path("lights/images.csv").exists()


def test_lights_of_the_very_table_are_not_outside_by_what_a_file_rounds(
    table: Lut, capsys: pytest.CaptureFixture[str]
) -> None:
    rounded: npt.NDArray[np.float64] = np.round(table.ground_truth, 6)
    write_stats(Path("s.json"), rounded, real_numbers(table, 0.5))
    assert main(("lut", "out", *WISH, "--like-in", "lights")) == 0
    assert "lights: 0.0% of the 5 of real lie outside" in capsys.readouterr().out


def test_lights_outside_the_gamut_are_counted_and_others_drawn(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    far = np.array([[0.9, 0.05, 0.05], [0.89, 0.06, 0.05], [0.9, 0.06, 0.04], [0.88, 0.06, 0.06]])
    lights = np.concatenate([lights_of(table, 12), far])
    write_stats(Path("s.json"), lights, real_numbers(table, 0.5))
    assert main(("lut", "out", *WISH)) == 0
    assert "lights: 25.0% of the 16 of real lie outside what lut can make; others" in capsys.readouterr().out
    assert recorded()["like"]["lights"] == {"count": 16, "outside": 0.25}
    truths = np.array([entry.truth for entry in open_dataset("out").entries])
    nearest = [Gamut.of(table).match(truth, "nearest").angle for truth in truths]
    assert max(nearest) < 0.02
    write_stats(Path("s.json"), far, real_numbers(table, 0.5))
    assert main(("lut", "none", *WISH)) == 2
    assert "of the distribution lies within what" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--like-in", "lights,colours"), "--like-in has 'colours', expected some of lights,pictures,exposure,size"),
        (("--like-in", "lights", "--match", "s.json"), "--match says the lights, and so does --like"),
        (("--like-in", "exposure"), "s.json knows no exposure"),
        (("--like-in", "lights", "--draw", "5"), "--draw 5 is for pictures"),
        (("--like-in", "lights", "--black-point", "like"), "--black-point like draws pictures with the shadows of"),
    ],
)
def test_options_that_do_not_go_together(
    table: Lut, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], told: str
) -> None:
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.5))
    assert main(("lut", "out", "--sources", "pictures", "--like", "s.json", *options)) == 2
    assert told in capsys.readouterr().err
    assert main(("lut", "out", "--sources", "pictures", "--black-point", "like")) == 2
    assert "give --like STATS.json" in capsys.readouterr().err
    assert main(("lut", "out", "--sources", "pictures", "--draw", "5")) == 2
    assert "give --like STATS.json" in capsys.readouterr().err


def test_files_that_cannot_be_followed(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    def refused() -> str:
        assert main(("lut", "out", *WISH)) == 2
        assert not Path("out").exists()
        return capsys.readouterr().err

    assert "s.json cannot be read as statistics" in refused()
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.5), version=7)
    assert "version 7; expected crop.statistics, version 1" in refused()
    write_stats(Path("s.json"), [], real_numbers(table, 0.5))
    assert "lights of shape" in refused()
    write_stats(Path("s.json"), lights_of(table, 2), real_numbers(table, 0.5))
    assert "no density fits the 2 lights of s.json" in refused()
    write_stats(Path("s.json"), lights_of(table), {"grey_red": [0.1, 0.2, 0.3]})
    assert "s.json has luminance_1 of 0 images" in refused()


def test_an_encoded_and_a_small_real_set_are_told_of(table: Lut, capsys: pytest.CaptureFixture[str]) -> None:
    values: dict[str, npt.ArrayLike] = {name: np.asarray(given)[:5] for name, given in real_numbers(table, 0.5).items()}
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
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.5))
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
    write_stats(Path("s.json"), lights_of(table), real_numbers(table, 0.5, black_taken=0.5))
    wish = ("--sources", "pictures", "--no-preview", "--like", "s.json", "--like-in", "pictures", "--draw", "150")
    away: dict[str, float] = {}
    for black in ("compensate", "keep", "like"):
        assert main(("lut", black, *wish, "--black-point", black, "--random", "1")) == 0
        dataset = open_dataset(black)
        images = [(dataset.read_image(entry), entry.truth) for entry in dataset.entries]
        seen = [numbers_of_cells(cell_means(image, truth))[0]["luminance_1"] for image, truth in images]
        figure = recorded(black)["like"]["pictures"]["figures"]["luminance_1"]
        # What was promised is what the images are.
        assert np.median(seen) == pytest.approx(figure["after"], rel=0.1)
        away[black] = abs(np.log(np.median(seen) / figure["wanted"]))
    assert away["like"] < 0.05 < 0.15 < min(away["keep"], away["compensate"])
    with Path("like/images.csv").open() as stream:
        shares = np.array([float(row["black_taken"]) for row in csv.DictReader(stream)])
    assert np.median(shares) == pytest.approx(0.5, abs=0.16)
    assert recorded("like")["like"]["pictures"]["black_taken"] == pytest.approx(shares.mean(), rel=1e-4)
    assert "share of the print's black taken out: " in capsys.readouterr().out
