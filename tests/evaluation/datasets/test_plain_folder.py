"""A user's own folder: values computed by hand on a made-up copy."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from evaluation.datasets import DataOptions, open_scenes
from evaluation.datasets.opening import with_black_judged
from foundation.errors import FormatError, InputError
from tests.evaluation.datasets.made_up import image_of, plain_folder, write_png


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    plain_folder(tmp_path)
    return tmp_path


def write_table(folder: Path, *rows: str, head: str = "image,r,g,b") -> None:
    (folder / "gt.csv").write_text("\n".join([head, *rows]) + "\n")


def test_values(copy: Path) -> None:
    data = open_scenes(copy)
    assert [scene.name for scene in data.scenes] == ["a.png", "more/b", "c"]
    png, tiff, array = data.scenes
    image, mask = png.read()
    assert image.dtype == np.uint16
    assert image[0, 0].tolist() == [9000 - 512, 0, 7000 - 512]
    assert png.saturation == 8192 - 512
    assert mask is not None
    assert mask.sum() == 6
    assert mask[5:, :2].all()
    floats, none = tiff.read()
    assert floats.dtype == np.float32
    assert floats[0, 0].tolist() == [4500, 50, 3500]
    assert (none, tiff.saturation) == (None, None)
    halves, _ = array.read()
    assert halves.dtype == np.float32  # Black is no whole number.
    assert halves[0, 0].tolist() == [9000 - 100.5, 0, 7000 - 100.5]
    assert array.saturation == 4000 - 100.5
    assert array.truth.tolist() == [1, 2, 1]
    assert data.folds == (1, 0, 1)


def three_images(folder: Path, least: int) -> Path:
    """Fill a folder with images of 200 to 4000 counts over `least`, and the table of them."""
    folder.mkdir()
    for number in range(3):
        pixels = np.full((6, 6, 3), 200 + number, np.uint16)
        pixels[0] = 4000
        write_png(folder / f"{number}.png", pixels + least)
    write_table(folder, *(f"{number},1,2,1" for number in range(3)))
    return folder


def judged(folder: Path, black: float | None = None) -> str:
    """Return what is said of the black level."""
    data = open_scenes(folder, options=DataOptions(black=black))
    return with_black_judged(data, black).treatment["black level"]


def test_a_black_level_above_all_pixels_is_refused(tmp_path: Path) -> None:
    folder = three_images(tmp_path / "own", 0)
    assert judged(folder, 3999).startswith("3999, as the user gave it")
    with pytest.raises(InputError, match=r"60000 is above.*3 images.*4000"):
        judged(folder, 60000)


def test_a_black_level_that_may_be_missing_is_told(tmp_path: Path) -> None:
    folder = three_images(tmp_path / "own", 0)
    assert "no pixel of 3 images looked at is below 200" in judged(folder)
    # What was given is not doubted, and one dark pixel is enough.
    assert "missing" not in judged(folder, 0)
    pixels = np.full((6, 6, 3), 4000, np.uint16)
    pixels[2, 2, 1] = 7
    write_png(folder / "1.png", pixels)
    assert "missing" not in judged(folder)


def test_a_table_between_semicolons_is_told_by_its_columns(copy: Path) -> None:
    (copy / "gt.csv").write_text("image;r;g;b\na;1;2;1\n")
    with pytest.raises(FormatError, match=r"gt\.csv.*image,r,g,b \(found: image;r;g;b\)"):
        open_scenes(copy)


@pytest.mark.parametrize(
    ("more", "rows", "message"),
    [
        ("", ["a.jpg,1,1,1"], r"gt\.csv.*2.*a\.jpg.*JPEG"),
        ("", ["a.CR2,1,1,1"], r"a\.CR2"),
        ("", ["a,1,1"], "line 2 has 3 fields, expected 4"),
        ("", ["a,1,1,-1"], "line 2: 1 1 -1 is no light"),
        ("", ["a,0,0,0"], "correct the line"),
        ("", [",1,1,1"], "the image '' is no name"),
        ("", ["none.png,1,1,1"], r"1.*1.*gt\.csv.*none\.png"),
        ("", ["a,1,1,1", "a,1,1,1"], r"3.*'a'"),
        # As two images they would come to lie in two folds: tested on what was trained on.
        ("", ["a,1,1,1", "./a.png,1,1,1"], r"/a\.png"),
        (",r", ["a,1,1,1,2"], "two columns 'r'"),
        (",black", ["a,1,1,1,-5"], "black is -5, expected a number from 0"),
        (",black,saturation", ["a,1,1,1,512,512"], "512.*512"),
        (",mask", ["a,1,1,1,lost.png"], r"lost\.png"),
        (",fold", ["a,1,1,1,first"], "'first'"),
        (",fold", ["a,1,1,1,0", "c,1,1,1,"], "some rows have a fold and others none"),
    ],
)
def test_rows_and_columns_that_cannot_be_used_are_named(copy: Path, more: str, rows: list[str], message: str) -> None:
    write_table(copy, *rows, head=f"image,r,g,b{more}")
    with pytest.raises(FormatError, match=message):
        open_scenes(copy)


def test_a_copy_that_lacks_images(copy: Path) -> None:
    write_table(copy, "a,1,1,1", "c,1,1,1", "z,1,1,1")
    with pytest.raises(FormatError, match=r"1.*3.*gt\.csv.*--read partial"):
        open_scenes(copy)
    data = open_scenes(copy, options=DataOptions(partial=True))
    assert data.treatment["images"] == (
        "2; 1 more of gt.csv are not there; 1 in other folders there without a row in gt.csv left out"
    )


def test_several_tables_must_be_named(copy: Path) -> None:
    (copy / "other.csv").write_text("image,r,g,b\nc,1,1,1\n")
    (copy / "notes.csv").write_text("who,what\n")
    with pytest.raises(InputError, match=r"gt\.csv.*other\.csv"):
        open_scenes(copy)
    chosen = open_scenes(copy / "other.csv")
    assert [scene.name for scene in chosen.scenes] == ["c"]
    assert chosen.treatment["images"].startswith("1; 1 beside them without a row in other.csv left out")


def test_an_image_of_eight_bits_and_a_mask_of_another_size(copy: Path) -> None:
    write_png(copy / "eight.png", np.full((4, 4, 3), 9, np.uint8))
    write_png(copy / "small.png", image_of(4, 4))
    write_table(copy, "eight,1,1,1,", "small,1,1,1,a_mask.png", head="image,r,g,b,mask")
    eight, small = open_scenes(copy, options=DataOptions(partial=True)).scenes
    with pytest.raises(FormatError, match="8 bits a channel"):
        eight.read()
    with pytest.raises(FormatError, match=r"a_mask\.png.*10.*8.*4.*4"):
        small.read()


def test_an_image_with_an_ending_left_out_must_be_one(copy: Path) -> None:
    np.save(copy / "a.npy", image_of(4, 4))
    write_table(copy, "a,1,1,1")
    with pytest.raises(FormatError, match=r"a\.png and a\.npy|a\.npy and a\.png"):
        open_scenes(copy)


def test_a_mask_beside_its_image_is_used_without_a_column(copy: Path) -> None:
    # As the reference draws it; not used, the chart stays in the picture.
    write_table(copy, "a,1,1,1", "c.npy,1,1,1")
    data = open_scenes(copy)
    with_mask, without = (scene.read()[1] for scene in data.scenes)
    assert with_mask is not None
    assert without is None
    assert with_mask.sum() == 6
    assert with_mask[5:, :2].all()
    assert data.treatment["mask"] == ("NAME_mask beside the image: where the picture is not 0; 1 of 2 images have one")


def test_the_column_goes_before_the_mask_beside_and_that_is_not_lost(copy: Path) -> None:
    (copy / "masks").mkdir()
    whole = np.full((8, 10), 255, np.uint8)
    assert cv2.imwrite(str(copy / "masks" / "all.png"), whole)
    rows = ("a,1,1,1,masks/all.png", "c,1,1,1,")
    write_table(copy, *rows, head="image,r,g,b,mask")
    with pytest.raises(FormatError, match=r"1.*a_mask\.png"):
        open_scenes(copy)
    (copy / "a_mask.png").rename(copy / "c_mask.png")
    data = open_scenes(copy)
    sums = [0 if mask is None else mask.sum() for _, mask in (scene.read() for scene in data.scenes)]
    assert sums == [80, 6]
    assert data.treatment["mask"].startswith("column mask of gt.csv or NAME_mask beside the image: ")


def test_a_mask_that_cannot_be_one_is_named(copy: Path) -> None:
    (copy / "a_mask.png").rename(copy / "a_mask.jpg")
    write_table(copy, "a,1,1,1", "c,1,1,1")
    with pytest.raises(FormatError, match=r"2.*a_mask\.jpg.*PNG"):
        open_scenes(copy)
    (copy / "a_mask.jpg").rename(copy / "a_mask.png")
    write_table(copy, "a,1,1,1", "c,1,1,1", "a_mask,1,1,1")
    with pytest.raises(FormatError, match=r"a_mask\.png"):
        open_scenes(copy)


def test_an_image_without_a_row_is_refused_or_said_to_be_left_out(copy: Path) -> None:
    write_png(copy / "d.png", image_of(8, 10))
    write_png(copy / "d_mask.png", np.full((8, 10), 9, np.uint8))
    write_png(copy / "more" / "e.png", image_of(8, 10))
    with pytest.raises(FormatError, match=r"gt\.csv.*2.*d\.png.*more/e\.png.*--read partial"):
        open_scenes(copy)
    data = open_scenes(copy, options=DataOptions(partial=True))
    assert [scene.name for scene in data.scenes] == ["a.png", "more/b", "c"]
    assert data.treatment["images"] == "3; 2 beside them without a row in gt.csv left out"


def test_images_of_a_folder_that_the_table_does_not_name_are_counted(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_png(copy / "day2" / "e.png", image_of(8, 10))
    monkeypatch.chdir(copy)
    for place in (".", str(copy), "gt.csv"):
        assert open_scenes(place).treatment["images"] == "3; 1 in other folders there without a row in gt.csv left out"
