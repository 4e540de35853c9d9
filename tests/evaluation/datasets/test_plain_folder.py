"""Values of a user's own folder, computed by hand for a synthetic copy."""

from __future__ import annotations

import unicodedata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from PIL import Image

from evaluation.datasets import DataOptions, open_scenes
from evaluation.datasets.opening import check_black_level
from foundation.errors import FormatError, InputError
from tests.evaluation.datasets.made_up import image_of, plain_folder, write_png


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    plain_folder(tmp_path)
    return tmp_path


def write_table(folder: Path, *rows: str, header: str = "image,r,g,b") -> None:
    (folder / "gt.csv").write_text("\n".join([header, *rows]) + "\n")


def test_reads_levels_masks_and_folds(copy: Path) -> None:
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
    floats, no_mask = tiff.read()
    assert floats.dtype == np.float32
    assert floats[0, 0].tolist() == [4500, 50, 3500]
    assert (no_mask, tiff.saturation) == (None, None)
    halves, _ = array.read()
    assert halves.dtype == np.float32  # The black level is not a whole number.
    assert halves[0, 0].tolist() == [9000 - 100.5, 0, 7000 - 100.5]
    assert array.saturation == 4000 - 100.5
    assert array.truth.tolist() == [1, 2, 1]
    assert data.folds == (1, 0, 1)


def three_images(folder: Path) -> Path:
    """Write images of 200 to 4000 counts and their table."""
    folder.mkdir()
    for number in range(3):
        pixels = np.full((6, 6, 3), 200 + number, np.uint16)
        pixels[0] = 4000
        write_png(folder / f"{number}.png", pixels)
    write_table(folder, *(f"{number},1,2,1" for number in range(3)))
    return folder


def black_treatment(folder: Path, black: float | None = None) -> str:
    data = open_scenes(folder, options=DataOptions(black=black))
    return check_black_level(data, black).treatment["black level"]


def test_refuses_black_level_above_all_pixels(tmp_path: Path) -> None:
    folder = three_images(tmp_path / "own")
    assert black_treatment(folder, 3999).startswith("3999")
    with pytest.raises(InputError, match=r"60000.*3 images.*4000"):
        black_treatment(folder, 60000)


def test_warns_if_black_level_may_be_missing(tmp_path: Path) -> None:
    folder = three_images(tmp_path / "own")
    assert "3 inspected images is 200" in black_treatment(folder)
    # A given level is not questioned, and one dark pixel is sufficient.
    assert "inspected" not in black_treatment(folder, 0)
    pixels = np.full((6, 6, 3), 4000, np.uint16)
    pixels[2, 2, 1] = 7
    write_png(folder / "1.png", pixels)
    assert "inspected" not in black_treatment(folder)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_reads_table_as_spreadsheets_save_it(tmp_path: Path, separator: str, encoding: str) -> None:
    write_png(tmp_path / "Büro.png", image_of(6, 8))
    rows = (("image", "r", "g", "b"), ("Büro.png", "1", "2", "1"))
    (tmp_path / "gt.csv").write_bytes("\r\n".join(separator.join(row) for row in rows).encode(encoding))
    assert open_scenes(tmp_path).scenes[0].truth.tolist() == [1, 2, 1]


def test_refuses_table_in_another_encoding(tmp_path: Path) -> None:
    write_png(tmp_path / "Büro.png", image_of(6, 8))
    (tmp_path / "gt.csv").write_bytes("image,r,g,b\nBüro.png,1,2,1\n".encode("cp1252"))
    with pytest.raises(FormatError, match=r"gt\.csv: line 2 has the byte 0xfc"):
        open_scenes(tmp_path)


@pytest.mark.parametrize(("file_form", "table_form"), [("NFD", "NFC"), ("NFC", "NFD")])
def test_compares_names_in_normal_form(tmp_path: Path, file_form: Any, table_form: Any) -> None:
    # macOS programs write names in form D (UAX #15).
    name = unicodedata.normalize(file_form, "Büro")
    write_png(tmp_path / f"{name}.png", image_of(6, 8))
    np.save(tmp_path / f"{name}_mask.npy", np.ones((6, 8)))
    listed = unicodedata.normalize(table_form, "Büro")
    write_table(tmp_path, f"{listed},1,1,1,{name}_mask.npy", header="image,r,g,b,mask")
    mask = open_scenes(tmp_path).scenes[0].read()[1]
    assert mask is not None
    assert mask.all()


@pytest.mark.parametrize("name", ["a.exr", "a.jxl", "a.fits", "a"])
def test_reports_types_that_are_not_read(tmp_path: Path, name: str) -> None:
    (tmp_path / Path(name).with_suffix(Path(name).suffix or ".exr")).touch()
    write_table(tmp_path, f"{name},1,2,1")
    with pytest.raises(FormatError, match=r"type \.\w+, which is not read; expected .*\.png"):
        open_scenes(tmp_path)


@pytest.mark.parametrize(
    ("columns", "rows", "message"),
    [
        ("", ["a.jpg,1,1,1"], r"gt\.csv.*2.*a\.jpg.*JPEG"),
        ("", ["a.CR2,1,1,1"], r"a\.CR2"),
        ("", ["a,1,1"], "line 2 has 3 fields, expected 4"),
        ("", ["a,1,1,-1"], "line 2.*1 1 -1"),
        ("", ["a,0,0,0"], "correct the line"),
        ("", [",1,1,1"], "line 2: no image name"),
        ("", ["none.png,1,1,1"], r"1.*1.*gt\.csv.*none\.png"),
        ("", ["a,1,1,1", "a,1,1,1"], r"3.*'a'"),
        # As two images they could be in two folds, so that a method is tested on a training image.
        ("", ["a,1,1,1", "./a.png,1,1,1"], r"/a\.png"),
        (",r", ["a,1,1,1,2"], "two columns 'r'"),
        (",black", ["a,1,1,1,-5"], "black is -5, expected 0 or more"),
        (",black,saturation", ["a,1,1,1,512,512"], "512.*512"),
        (",mask", ["a,1,1,1,lost.png"], r"lost\.png"),
        (",fold", ["a,1,1,1,first"], "'first'"),
        (",fold", ["a,1,1,1,0", "c,1,1,1,"], "some rows have a fold"),
    ],
)
def test_refuses_invalid_rows_and_columns(copy: Path, columns: str, rows: list[str], message: str) -> None:
    write_table(copy, *rows, header=f"image,r,g,b{columns}")
    with pytest.raises(FormatError, match=message):
        open_scenes(copy)


def test_counts_missing_images(copy: Path) -> None:
    write_table(copy, "a,1,1,1", "c,1,1,1", "z,1,1,1")
    with pytest.raises(FormatError, match=r"1.*3.*gt\.csv.*--read partial"):
        open_scenes(copy)
    data = open_scenes(copy, options=DataOptions(partial=True))
    assert data.treatment["images"] == (
        "2; 1 of gt.csv are missing and excluded; 1 more in other folders excluded (no row in gt.csv)"
    )


def test_requires_choice_of_table(copy: Path) -> None:
    (copy / "other.csv").write_text("image,r,g,b\nc,1,1,1\n")
    (copy / "notes.csv").write_text("who,what\n")
    with pytest.raises(InputError, match=r"gt\.csv.*other\.csv"):
        open_scenes(copy)
    data = open_scenes(copy / "other.csv")
    assert [scene.name for scene in data.scenes] == ["c"]
    assert data.treatment["images"].startswith("1; 1 more in the same folders excluded (no row in other.csv)")


def test_refuses_eight_bit_image_and_mask_of_wrong_size(copy: Path) -> None:
    write_png(copy / "eight.png", np.full((4, 4, 3), 9, np.uint8))
    write_png(copy / "small.png", image_of(4, 4))
    write_table(copy, "eight,1,1,1,", "small,1,1,1,a_mask.png", header="image,r,g,b,mask")
    eight, small = open_scenes(copy, options=DataOptions(partial=True)).scenes
    with pytest.raises(FormatError, match="8 bits per channel"):
        eight.read()
    with pytest.raises(FormatError, match=r"a_mask\.png.*10.*8.*4.*4"):
        small.read()


def test_refuses_ambiguous_name_without_ending(copy: Path) -> None:
    np.save(copy / "a.npy", image_of(4, 4))
    write_table(copy, "a,1,1,1")
    with pytest.raises(FormatError, match=r"a\.png and a\.npy|a\.npy and a\.png"):
        open_scenes(copy)


def test_uses_mask_beside_image_without_column(copy: Path) -> None:
    write_table(copy, "a,1,1,1", "c.npy,1,1,1")
    data = open_scenes(copy)
    with_mask, without = (scene.read()[1] for scene in data.scenes)
    assert with_mask is not None
    assert without is None
    assert with_mask.sum() == 6
    assert with_mask[5:, :2].all()
    assert data.treatment["mask"] == (
        "NAME_mask next to the image: pixels that are not 0; 1 of 2 images have one, with 6 masked pixels (7.5 %)"
    )


def test_prefers_mask_in_column_to_mask_beside_image(copy: Path) -> None:
    (copy / "masks").mkdir()
    assert cv2.imwrite(str(copy / "masks" / "all.png"), np.full((8, 10), 255, np.uint8))
    rows = ("a,1,1,1,masks/all.png", "c,1,1,1,")
    write_table(copy, *rows, header="image,r,g,b,mask")
    with pytest.raises(FormatError, match=r"1.*a_mask\.png"):
        open_scenes(copy)
    (copy / "a_mask.png").rename(copy / "c_mask.png")
    data = open_scenes(copy)
    sums = [0 if mask is None else mask.sum() for _, mask in (scene.read() for scene in data.scenes)]
    assert sums == [80, 6]
    assert data.treatment["mask"].startswith("column mask of gt.csv or NAME_mask next to the image: ")


def test_refuses_invalid_mask(copy: Path) -> None:
    (copy / "a_mask.png").rename(copy / "a_mask.jpg")
    write_table(copy, "a,1,1,1", "c,1,1,1")
    with pytest.raises(FormatError, match=r"2.*a_mask\.jpg.*PNG"):
        open_scenes(copy)
    (copy / "a_mask.jpg").rename(copy / "a_mask.png")
    write_table(copy, "a,1,1,1", "c,1,1,1", "a_mask,1,1,1")
    with pytest.raises(FormatError, match=r"a_mask\.png"):
        open_scenes(copy)


def test_images_without_row_require_partial(copy: Path) -> None:
    write_png(copy / "d.png", image_of(8, 10))
    write_png(copy / "d_mask.png", np.full((8, 10), 9, np.uint8))
    write_png(copy / "more" / "e.png", image_of(8, 10))
    with pytest.raises(FormatError, match=r"gt\.csv.*2.*d\.png.*more/e\.png.*--read partial"):
        open_scenes(copy)
    data = open_scenes(copy, options=DataOptions(partial=True))
    assert [scene.name for scene in data.scenes] == ["a.png", "more/b", "c"]
    assert data.treatment["images"] == "3; 2 more in the same folders excluded (no row in gt.csv)"


def test_counts_images_in_unlisted_folders(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_png(copy / "day2" / "e.png", image_of(8, 10))
    monkeypatch.chdir(copy)
    for location in (".", str(copy), "gt.csv"):
        assert open_scenes(location).treatment["images"] == "3; 1 more in other folders excluded (no row in gt.csv)"


def masked_right_half(shape: tuple[int, ...], dtype: type[np.generic], value: float) -> npt.NDArray[Any]:
    """Return a picture whose right half has a value and whose left half is 0."""
    picture = np.zeros(shape, dtype)
    picture[:, shape[1] // 2 :] = value
    return picture


def write_mask(path: Path, kind: str) -> None:
    """Write a mask of 6×8 px, whose right half is masked, as a program of users may write it."""
    grey = masked_right_half((6, 8), np.uint8, 255)
    match kind:
        case "16-bit labels":
            Image.fromarray(masked_right_half((6, 8), np.uint16, 1)).save(path)
        case "dark colours":
            Image.fromarray(
                masked_right_half((6, 8, 3), np.uint8, 0) | (grey[..., None] & [0, 0, 1]).astype(np.uint8)
            ).save(path)
        case "opaque":
            Image.fromarray(np.dstack([grey, grey, grey, np.full_like(grey, 255)])).save(path)
        case "transparent white":
            Image.fromarray(np.dstack([np.full((6, 8, 3), 255, np.uint8), grey])).save(path)
        case "palette":
            picture = Image.fromarray(grey // 255).convert("P")
            picture.putpalette([0, 0, 0, 128, 0, 0])
            picture.save(path)
        case "one bit":
            Image.fromarray(grey > 0).save(path)
        case "one bit, black is 1":
            tifffile.imwrite(path, grey == 0, photometric="miniswhite")
        case "turned":
            # The tag Orientation is ignored, as in images.
            tifffile.imwrite(path, grey, photometric="minisblack", extratags=[(274, "H", 1, 3, True)])
        case "LZW":
            tifffile.imwrite(path, grey, photometric="minisblack", compression="lzw")
        case _:
            tifffile.imwrite(path, masked_right_half((6, 8), np.dtype(kind).type, 1), photometric="minisblack")


@pytest.mark.parametrize(
    ("kind", "ending"),
    [
        *(
            (kind, "png")
            for kind in ("16-bit labels", "dark colours", "opaque", "transparent white", "palette", "one bit")
        ),
        *((kind, "tif") for kind in ("one bit", "one bit, black is 1", "turned", "LZW", "int32", "float32", "bool")),
        *(("one bit", "bmp"), ("one bit", "pbm")),
    ],
)
def test_mask_is_what_is_not_zero(tmp_path: Path, kind: str, ending: str) -> None:
    write_png(tmp_path / "a.png", image_of(6, 8))
    write_mask(tmp_path / f"m.{ending}", kind)
    write_table(tmp_path, f"a,1,1,1,m.{ending}", header="image,r,g,b,mask")
    data = open_scenes(tmp_path)
    mask = data.scenes[0].read()[1]
    np.testing.assert_array_equal(mask, masked_right_half((6, 8), np.bool_, True))
    assert data.treatment["mask"].endswith("1 of 1 images have one, with 24 masked pixels (50 %)")


def test_reports_empty_mask(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", image_of(6, 8))
    np.save(tmp_path / "m.npy", np.zeros((6, 8)))
    write_table(tmp_path, "a,1,1,1,m.npy", header="image,r,g,b,mask")
    assert "0 masked pixels (0 %); 1 masks are empty (a)" in open_scenes(tmp_path).treatment["mask"]


@pytest.mark.parametrize("ending", ["jpg", "webp", "tif"])
def test_refuses_lossy_mask(tmp_path: Path, ending: str) -> None:
    write_png(tmp_path / "a.png", image_of(6, 8))
    mask = Image.fromarray(masked_right_half((6, 8), np.uint8, 255))
    mask.save(tmp_path / f"m.{ending}", **({"compression": "jpeg"} if ending == "tif" else {}))
    write_table(tmp_path, f"a,1,1,1,m.{ending}", header="image,r,g,b,mask")
    with pytest.raises(FormatError, match="lossy"):
        open_scenes(tmp_path)


@pytest.mark.parametrize("dtype", [">u2", "<u2", ">f4", ">f8"])
def test_array_in_any_byte_order(tmp_path: Path, dtype: str) -> None:
    image = image_of(6, 8)
    np.save(tmp_path / "a.npy", np.asfortranarray(image.astype(dtype)))
    write_table(tmp_path, "a,1,1,1,100", header="image,r,g,b,black")
    values, _ = open_scenes(tmp_path).scenes[0].read()
    assert values.dtype.isnative
    np.testing.assert_array_equal(values, np.maximum(image.astype(float) - 100, 0))


def test_reads_named_ground_truths_as_text(tmp_path: Path) -> None:
    # numpy.savetxt is the program that writes the file.
    names = ["b 2.png", "a.png", "10.png"]
    lights = np.array([[0.2, 0.5, 0.3], [0.25, 0.5, 0.25], [0.1, 0.6, 0.3]])
    for name in names:
        write_png(tmp_path / name, image_of(4, 5))
    np.savetxt(tmp_path / "gt.txt", np.column_stack([names, lights.astype(str)]), fmt="%s", header="name r g b")
    for location in (tmp_path, tmp_path / "gt.txt"):
        scenes = open_scenes(location, "folder" if location.is_dir() else None).scenes
        assert {scene.name: scene.truth.tolist() for scene in scenes} == dict(zip(names, lights.tolist(), strict=True))
    (tmp_path / "gt.txt").write_text("a.png 0.25 0.5 0.25\nb 2.png 0.2 0.5\n")
    with pytest.raises(FormatError, match="line 2"):
        open_scenes(tmp_path / "gt.txt")
