"""Estimates of other programs: which names are taken for the same image, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.results.files import read_estimates
from foundation.errors import FormatError, InputError

IMAGES = ["a/one.png", "a/two.png", "three.v1.png"]


def given(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "other.csv"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        "image,r,g,b\na/two.png,4,5,6\na/one.png,1,2,3\nthree.v1.png,7,8,9\n",
        "a/one,1,2,3\na/two,4,5,6\nthree.v1,7,8,9",
        "\ufeffB;Image;note;R;G\r\n3;a/one.tiff;x;1;2\r\n6;a/two.tiff;;4;5\r\n\r\n9;three.v1.tiff;;7;8\r\n",
        "image,r,g,b\ra/two.png,4,5,6\ra/one.png,1,2,3\rthree.v1.png,7,8,9\r",
        'image\tr\tg\tb\n"a/one.png"\t1e0\t2\t3.0\na/two.png\t4\t5\t6\nthree.v1.png\t7\t8\t9\n',
    ],
)
def test_names_with_and_without_extension(tmp_path: Path, text: str) -> None:
    found = read_estimates(given(tmp_path, text), IMAGES)
    assert found.name == "other"
    assert {image: light.tolist() for image, light in found.lights.items()} == {
        "a/one.png": [1, 2, 3],
        "a/two.png": [4, 5, 6],
        "three.v1.png": [7, 8, 9],
    }


def test_what_is_no_light_is_kept_as_it_is(tmp_path: Path) -> None:
    found = read_estimates(given(tmp_path, "a/one,nan,1,1\na/two,0,0,0\nthree.v1,-1,1,1\n"), IMAGES)
    np.testing.assert_array_equal(found.lights["a/one.png"], [np.nan, 1, 1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image,r,g,b\na/one,1,1,1\n", r"2 images of the data set are missing \(a/two\.png, three\.v1\.png\)"),
        ("a/one,1,1,1\na/one.png,1,1,1\na/two,1,1,1\nthree.v1,1,1,1", r"1 image stands there twice \(a/one\.png\)"),
        ("a/one,1,1,1\na/two,1,1,1\nthree.v1,1,1,1\nfour,1,1,1", r"1 line is of no image of the data set \(four\)"),
    ],
)
def test_missing_unknown_and_double_images_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=f"{message}; expected one line for each of 3 images"):
        read_estimates(given(tmp_path, text), IMAGES)


def test_a_name_without_extension_that_two_images_have_is_neither(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"2 images of the data set are missing .* no image of the data set \(one\)"):
        read_estimates(given(tmp_path, "one,1,1,1\n"), ["one.png", "one.tiff"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "begins with ''; expected the columns image,r,g,b"),
        ("name,red,green,blue\na,1,1,1", "begins with 'name,red,green,blue'"),
        ("image,r,g,b\na/one,1,1\n", "line 2: 3 fields where the first line has 4"),
        ("image,r,g,b\na/one,1,one,1\n", "line 2"),
        ("image,r,g,b\na/one,0,68,0,85,0,22\n", "line 2: 7 fields where the first line has 4"),
        ("image,r,g,b,r,g,b\na/one,1,1,1,2,2,2\n", "columns of the same name"),
        ('image,r,g,b\n"a/one,1,2,3\n', "is no CSV text"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_estimates(given(tmp_path, text), IMAGES)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read .*none\.csv: No such file"):
        read_estimates(tmp_path / "none.csv", IMAGES)
