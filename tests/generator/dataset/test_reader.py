"""Reading data sets: reports of damaged and inconsistent files."""

from __future__ import annotations

from pathlib import Path

import pytest

from foundation.errors import FormatError
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import open_dataset
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import LightChoice, ListedLights, RandomLights
from generator.masks.making import parse_masks
from generator.pictures.random_scenes import random_scenes
from tests.generator.conftest import MakeLut

pytestmark = pytest.mark.slow

BARE = DatasetOptions(rendering="codes", previews=False)


@pytest.fixture
def small(make_lut: MakeLut, tmp_path: Path) -> Path:
    """Return a data set of two random scenes under one illuminant, without previews."""
    generate_dataset(
        make_lut(),
        tmp_path / "small",
        random_scenes(2, 24, 16),
        [1],
        options=DatasetOptions(rendering="codes", form="tiff", previews=False),
    )
    return tmp_path / "small"


def test_reports_damaged_file(small: Path, tmp_path: Path) -> None:
    opened = open_dataset(small)
    (small / "images" / opened.entries[0].image).write_bytes(b"II*")
    with pytest.raises(FormatError, match=r"000000\.tiff"):
        opened.read_image(opened.entries[0])
    (small / "images" / opened.entries[1].image).unlink()
    with pytest.raises(FormatError, match=r"000001\.tiff"):
        opened.read_image(opened.entries[1])
    table = small / "ground_truth.csv"
    text = table.read_text()
    table.write_text("\n".join(text.splitlines()[:-1]))
    with pytest.raises(FormatError, match=r"rows of 1 .*expected 2 as in"):
        open_dataset(small)
    table.write_text(text.replace(",1,", ",one,"))
    with pytest.raises(FormatError, match=r"ground_truth\.csv.*2"):
        open_dataset(small)
    with pytest.raises(FormatError, match=r"dataset\.json"):
        open_dataset(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "lights",
    [
        [1, 0, "0:0.3333333333+3:0.6666666667", "3:0.6666666667+0:0.3333333333", "1:1"],
        RandomLights(3, 4, seed=7),
        SimultaneousLights(ListedLights((0, 3)), 2, parse_masks("half-plane", 2, 5)),
    ],
    ids=["listed", "drawn", "several at once"],
)
def test_generated_data_set_equals_opened_one(
    make_lut: MakeLut, tmp_path: Path, lights: list[int | str] | LightChoice
) -> None:
    data_set = generate_dataset(make_lut(), tmp_path / "out", random_scenes(2, 24, 16), lights, options=BARE)
    opened = open_dataset(tmp_path / "out")
    assert data_set == opened
    assert data_set.light_labels == opened.light_labels == {label for entry in opened.entries for label in entry.lights}
    assert data_set.entries == opened.entries


def test_generated_data_set_is_not_read_again(make_lut: MakeLut, tmp_path: Path) -> None:
    out = tmp_path / "out"
    data_set = generate_dataset(make_lut(), out, random_scenes(2, 24, 16), [1, 3], options=BARE)
    (out / "ground_truth.csv").unlink()
    assert data_set.light_labels == {"1", "3"}
    with pytest.raises(FormatError, match=r"ground_truth\.csv"):
        _ = data_set.entries


def lines_of(path: Path) -> list[str]:
    return path.read_text().splitlines()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ((3, 2, 1, 0), r"gt\.txt.*1.*000000\.png.*ground_truth\.csv"),
        ((0, 1, 2, 3, 0), r"gt\.txt.*5.*4.*ground_truth\.csv"),
        ((0, 1, 2), r"gt\.txt.*4.*000003\.png"),
        ((0, "nan 0.5 0.5", 2, 3), r"gt\.txt.*2.*0\.5.*0\.5"),
        ((0, "1.5 0 -0.5", 2, 3), r"gt\.txt.*2.*'1\.5.*0.*-0\.5"),
        ((0, "x" * 999, 2, 3), r"gt\.txt, line 2: 000001\.png has 'x{80}…', expected r g b"),
    ],
)
def test_reports_inconsistent_ground_truths(
    make_lut: MakeLut, tmp_path: Path, lines: tuple[int | str, ...], message: str
) -> None:
    out = tmp_path / "out"
    data_set = generate_dataset(make_lut(), out, random_scenes(1, 24, 16), [0, 1, 2, 3], options=BARE)
    truths = lines_of(out / "gt.txt")
    entries = data_set.entries
    (out / "gt.txt").write_text("\n".join([*truths, "", ""]))
    assert open_dataset(out).entries == entries
    (out / "gt.txt").write_text("\n".join(line if isinstance(line, str) else truths[line] for line in lines))
    with pytest.raises(FormatError, match=message):
        open_dataset(out)


def test_ground_truth_may_have_zero_channel(small: Path) -> None:
    table, truths = small / "ground_truth.csv", small / "gt.txt"
    head, first, second = lines_of(table)
    for blue in ("0.6", "0.6001", "0.5999"):
        table.write_text("\n".join([head, first, ",".join([*second.split(",")[:3], "0", "0.4", blue])]))
        truths.write_text("\n".join([lines_of(truths)[0], f"0 0.4 {blue}"]))
        if blue == "0.6":
            assert open_dataset(small).entries[1].truth == (0, 0.4, 0.6)
        else:
            with pytest.raises(FormatError, match=r"ground_truth\.csv, line 3"):
                open_dataset(small)


def test_reports_invalid_csv(small: Path) -> None:
    table = small / "ground_truth.csv"
    table.write_text(table.read_text() + '"' + "x" * 200_000)
    with pytest.raises(FormatError, match=r"ground_truth\.csv.*4.*CSV"):
        open_dataset(small)


def test_mean_must_lie_between_lights(make_lut: MakeLut, tmp_path: Path) -> None:
    choice = SimultaneousLights(ListedLights((0, 3)), 2, parse_masks("half-plane", 2, 5))
    out = tmp_path / "out"
    generate_dataset(make_lut(), out, random_scenes(2, 24, 16), choice, options=BARE)
    assert all(entry.truth not in entry.truths for entry in open_dataset(out).entries)
    first, _ = lines_of(out / "gt.txt")
    (out / "gt.txt").write_text(f"{first}\n0.1 0.1 0.8\n")
    with pytest.raises(FormatError, match=r"gt\.txt, line 2: .*000001\.png is 0\.1 0\.1 0\.8, expected"):
        open_dataset(out)
