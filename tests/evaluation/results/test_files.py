"""Reading of `errors.csv` and of estimates of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.results.files import read_errors, read_estimates
from foundation.errors import FormatError, InputError

HEAD = "image,method,estimate_r,estimate_g,estimate_b,truth_r,truth_g,truth_b,recovery,reproduction,guessed"


def write_errors(folder: Path, *lines: str, head: str = HEAD) -> Path:
    path = folder / "errors.csv"
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


def test_reads_columns_by_name(tmp_path: Path) -> None:
    head = "guessed,reproduction,image,note,method,truth_r,truth_g,truth_b,recovery"
    method_errors = read_errors(
        write_errors(tmp_path, "1,7,a.png,x,Mine,1,2,3,2", "0,7,b.png,x,Mine,1,2,3,2", head=head)
    )["Mine"]
    assert method_errors.truths.tolist() == [[1, 2, 3]] * 2
    assert (method_errors.errors["recovery"][0], method_errors.errors["reproduction"][0]) == (2, 7)
    assert method_errors.guessed.tolist() == [True, False]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a,Mine,1,1,1,1,1,1,x,2,0", "line 2: recovery is 'x'"),
        ("a,Mine,1,1,1,1,1,1,nan,2,0", "line 2: recovery is 'nan'"),
        ("a,Mine,1,1,1,1,1", "line 2: recovery is None"),
        ("a,Mine,1,1,1,1,1,1,1,2,0,1", "line 2 has more than 11 fields"),
        ("a,Mine,1,1,1,1,1,1,-1,2,0", "line 2: a has .*no value below 0"),
        ("a,Mine,1,1,1,0,0,0,1,2,0", "line 2: a has"),
        ("a,Mine,1,1,1,1,1,1,1,2,maybe", "guessed is 'maybe'"),
        ("a,Mine,1,1,1,1,1,1,1,2,0\na,Mine,1,1,1,1,1,1,1,2,0", "line 3 has Mine on a twice"),
        ("", "has no errors"),
    ],
)
def test_refuses_faulty_lines(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_errors(write_errors(tmp_path, line))


def test_refuses_other_files(tmp_path: Path) -> None:
    with pytest.raises(FormatError):
        read_errors(write_errors(tmp_path, head="image,method").rename(tmp_path / "x.csv"))
    with pytest.raises(InputError):
        read_errors(tmp_path)
    (tmp_path / "errors.csv").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(FormatError, match=r"expected.* UTF-8"):
        read_errors(tmp_path)


IMAGES = ["a/one.png", "a/two.png", "three.v1.png"]


def write_estimates(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "other.csv"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        "image,r,g,b\na/two.png,4,5,6\na/one.png,1,2,3\nthree.v1.png,7,8,9\n",
        "image,r,g,b\na/one,1,2,3\na/two,4,5,6\nthree.v1,7,8,9",
        "\ufeffB;Image;note;R;G\r\n3;a/one.tiff;x;1;2\r\n6;a/two.tiff;;4;5\r\n\r\n9;three.v1.tiff;;7;8\r\n",
        "image,r,g,b\ra/two.png,4,5,6\ra/one.png,1,2,3\rthree.v1.png,7,8,9\r",
        'image\tr\tg\tb\n"a/one.png"\t1e0\t2\t3.0\na/two.png\t4\t5\t6\nthree.v1.png\t7\t8\t9\n',
    ],
)
def test_matches_names_with_and_without_extension(tmp_path: Path, text: str) -> None:
    estimates = read_estimates(write_estimates(tmp_path, text), IMAGES)
    assert estimates.name == "other"
    assert {image: light.tolist() for image, light in estimates.lights.items()} == {
        "a/one.png": [1, 2, 3],
        "a/two.png": [4, 5, 6],
        "three.v1.png": [7, 8, 9],
    }


def test_keeps_invalid_estimates(tmp_path: Path) -> None:
    estimates = read_estimates(
        write_estimates(tmp_path, "image,r,g,b\na/one,nan,1,1\na/two,0,0,0\nthree.v1,-1,1,1\n"), IMAGES
    )
    np.testing.assert_array_equal(estimates.lights["a/one.png"], [np.nan, 1, 1])


def test_refuses_ambiguous_name_without_extension(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"2 images .*no line.*\(one\)"):
        read_estimates(write_estimates(tmp_path, "image,r,g,b\none,1,1,1\n"), ["one.png", "one.tiff"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "starts with '', expected image,r,g,b"),
        ("name,red,green,blue\na,1,1,1", "starts with 'name,red,green,blue'"),
        ("image,r,g,b\na/one,1,1\n", "line 2: 3 fields, the first line has 4"),
        ("image,r,g,b\na/one,0,68,0,85,0,22\n", "line 2: 7 fields, the first line has 4"),
        ("image,r,g,b,r,g,b\na/one,1,1,1,2,2,2\n", "each once"),
        ('image,r,g,b\n"a/one,1,2,3\n', "is not CSV text"),
    ],
)
def test_refuses_invalid_csv(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_estimates(write_estimates(tmp_path, text), IMAGES)


def test_refuses_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: No such"):
        read_estimates(tmp_path / "none.csv", IMAGES)
