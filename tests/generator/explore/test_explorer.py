"""What the page of a table is told: lights, pixels, noise, and a command that makes the very image that is shown."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest

from foundation.errors import FormatError, InputError
from generator.cli import main
from generator.dataset.reader import open_dataset
from generator.explore.explorer import Explorer, sample_folder
from generator.lights.gamut import black_body, rb_of
from generator.pictures.sources import Preparation, find_pictures, read_picture
from generator.rendering import Rendering
from tests.generator.conftest import MakeLut
from tests.generator.explore.conftest import png
from tests.generator.rendering.conftest import MakeTable
from tests.pinned import Pinned

SIDE = 60


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def explorer(make_table: MakeTable, tmp_path: Path) -> Explorer:
    """Return an explorer of a print under three black bodies, with two pictures in a folder with blanks."""
    lut = make_table()
    folder = tmp_path / "my pictures"
    folder.mkdir()
    for number in range(2):
        (folder / f"it's {number}.png").write_bytes(png(number))
    return Explorer("lut", lut, find_pictures([str(folder)], Preparation(max_side=SIDE)), SIDE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "rendering"),
    [("1:.3+2:.7", "colorimetric"), ("r=.25,b=.3", "codes")],
)
def test_the_command_makes_the_image_that_is_shown(explorer: Explorer, light: str, rendering: Rendering) -> None:
    shown = explorer.show(1, light)
    image = explorer.counts(1, light, rendering).copy()
    assert image.shape == (round(SIDE * 5 / 9), SIDE, 3)
    words = shlex.split(shown["commands"][rendering])
    assert words[0] == "generate"
    assert words[words.index("--sources") + 1] == "my pictures/it's 1.png", "as it is called from here"
    assert main(words[1:]) == 0
    made = open_dataset("dataset")
    assert (made.read_image(made.entries[0]) == image).all()
    assert made.entries[0].truth == pytest.approx(shown["truth"], abs=1e-9)
    assert [made.entries[0].lights[0], len(made.entries)] == [shown["light"], 1]


@pytest.mark.slow
def test_the_command_of_a_picture_that_was_sent_is_run_beside_the_picture(explorer: Explorer, tmp_path: Path) -> None:
    number = explorer.add("/somewhere/-far .png", png(7))
    image = explorer.counts(number, "0", "codes").copy()
    assert not explorer.show(number, "0")["is_here"]
    (tmp_path / "-far .png").write_bytes(png(7))
    assert main(shlex.split(explorer.show(number, "0")["commands"]["codes"])[1:]) == 0
    made = open_dataset("dataset")
    assert (made.read_image(made.entries[0]) == image).all()


def test_a_table_called_as_the_command_is_named_otherwise(make_table: MakeTable, tmp_path: Path) -> None:
    (tmp_path / "cat.png").write_bytes(png(1))
    explorer = Explorer("explore", make_table(name="explore"), find_pictures("cat.png"), SIDE)
    assert main(shlex.split(explorer.show(0, "0")["commands"]["codes"])[1:]) == 0


def test_the_table_is_described(explorer: Explorer) -> None:
    told = explorer.describe()
    lut = explorer.lut
    assert [light["label"] for light in told["lights"]] == ["2000 K", "5600 K", "10000 K"]
    assert np.array([light["rb"] for light in told["lights"]]) == pytest.approx(rb_of(lut.white))
    assert {tuple(place) for place in told["hull"]} == {tuple(light["rb"]) for light in told["lights"]}
    assert told["first"] == 1, "the black body nearest to 5600 K"
    bodies = np.array(told["black_bodies"])
    assert bodies[[0, -1], 0].tolist() == [2000, 10000]
    assert bodies[[0, -1], 1:] == pytest.approx(rb_of(lut.white[[0, 2]]))
    assert bodies[9, 1:] == pytest.approx(rb_of(black_body(lut, bodies[9, 0]).white(lut)))


def test_two_lights_have_a_line_for_a_gamut_and_one_body_no_curve(make_lut: MakeLut) -> None:
    lut = make_lut(lights=2)
    told = Explorer("lut", lut, ()).describe()
    assert np.sort(told["hull"], axis=0) == pytest.approx(np.sort(rb_of(lut.white), axis=0))
    assert told["black_bodies"] == []


def test_one_light_is_all_that_it_can_make(make_lut: MakeLut) -> None:
    explorer = Explorer("lut", make_lut(lights=1), ())
    assert explorer.describe()["hull"] == [explorer.describe()["lights"][0]["rb"]]


def test_what_the_table_cannot_make_becomes_the_nearest_light(explorer: Explorer) -> None:
    shown = explorer.show(0, "r=.9,b=.05")
    assert shown["light"] == "0"
    with pytest.raises(InputError, match="is no light"):
        explorer.show(0, "sunny")


def test_noise_of_a_pixel_is_that_of_the_table(explorer: Explorer) -> None:
    picture = read_picture(Path("my pictures") / "it's 0.png", SIDE)
    told = explorer.pixel(0, "1", "codes", 3, 20)
    assert told["codes"] == picture[20, 3].tolist()
    bits = [int(code) >> 5 for code in picture[20, 3]]
    cell = np.asarray(explorer.lut.samples[1, bits[0] << 6 | bits[1] << 3 | bits[2]], np.float64)
    # Means of 256 draws are off by a sixteenth of the deviation; four of these are exceeded once in ten thousand.
    assert np.abs(np.array(told["mean"]) - cell.mean(axis=0)).max() < (cell.std(axis=0) / 4).max()
    assert np.array(told["deviation"]) == pytest.approx(cell.std(axis=0), rel=0.25)
    with pytest.raises(InputError, match="no pixel 60, 3"):
        explorer.pixel(0, "1", "codes", 60, 3)


def test_pictures_that_cannot_be_read_are_named(explorer: Explorer) -> None:
    with pytest.raises(FormatError, match=r"^cannot read letter\.txt"):
        explorer.add("letter.txt", b"Dear Sir")
    with pytest.raises(InputError, match="no picture 99"):
        explorer.show(99, "0")


def test_a_small_file_that_claims_a_large_picture_is_refused(
    explorer: Explorer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("generator.explore.explorer.MOST_DROPPED_PIXELS", 90 * 50 - 1)
    with pytest.raises(FormatError, match="90x50"):
        explorer.add("large.png", png(1))


@pytest.mark.slow
def test_sample_pictures_are_made_once_and_what_they_are_said_to_be(tmp_path: Path, pinned: Pinned) -> None:
    samples = sample_folder(tmp_path)
    before = {path.name: path.stat().st_mtime_ns for path in samples.iterdir()}
    assert len(before) == 3
    assert sample_folder(tmp_path) == samples
    assert before == {path.name: path.stat().st_mtime_ns for path in samples.iterdir()}
    codes = read_picture(samples / "balls.png").astype(np.int64)
    assert codes.shape == (600, 900, 3)
    squares = codes.reshape(20, 30, 30, 30, 3).sum(axis=(1, 3))
    # They are shaded with powers, of which another processor may round a code in a million otherwise.
    pinned("sample pictures", [codes, *squares.transpose(2, 0, 1)], same=2e-5)
    # The red ball: its surface in the middle, brighter towards the lamp on the upper left than away from it.
    x, y, radius = 160, 395, 130
    middle, near, far = (codes[y + part * radius // 2, x + part * radius // 2] for part in (0, -1, 1))
    assert middle.argmax() == 0
    assert near.sum() > middle.sum() > far.sum()
    # Reflected like a mirror does half way between the lamp and the viewer, the lamp's own white.
    lamp = np.array([-0.5, -0.65, 0.57]) / np.linalg.norm([-0.5, -0.65, 0.57])
    half = lamp + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    shiny = codes[round(y + half[1] * radius), round(x + half[0] * radius)]
    assert shiny.min() > 180
    patches = read_picture(samples / "patches.png")[75::150, 75::150].astype(np.int64)
    *hues, greys = patches
    # sRGB codes of i / 5 to the power of 2.2.
    assert greys.tolist() == [[code] * 3 for code in (0, 48, 102, 154, 205, 255)]
    # Red, yellow, green, cyan, blue, magenta; from row to row less saturated.
    for row in hues:
        assert [(patch > patch.mean()).tolist() for patch in row] == [
            [hue in (0, 1, 5), hue in (1, 2, 3), hue in (3, 4, 5)] for hue in range(6)
        ]
    assert (np.diff([np.ptp(row, axis=1) for row in hues], axis=0) < 0).all()
    blocks = read_picture(samples / "random.png").reshape(60, 10, 90, 10, 3)
    assert (blocks == blocks[:, :1, :, :1]).all()
    assert np.unique(blocks).size == 256
