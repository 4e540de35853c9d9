"""Ground truths of other data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from foundation.errors import FormatError
from generator.lights.distributions import load_ground_truths
from tests.data_files import available

CUBEPLUS = [0.16238344, 0.45326359, 0.38435297]
NUS = [0.507292583011997, 0.809736795789161, 0.294924662865143]
REAL = {
    "gt/cubeplus_12_rows.csv": (12, CUBEPLUS),
    "gt/nus_18_rows.csv": (18, NUS),
    "gt/cubeplus_gt_1707.csv": (1707, CUBEPLUS),
    "gt/nus8_gt_1853.csv": (1853, NUS),
}
"""Number of lights and the first of them, by file."""


@pytest.mark.parametrize(
    "text",
    [
        "File,GT_R,GT_G,GT_B\na.png,1,2,3\n\nb.png,0.5,0,1e-3\n",
        'image,source,illumination,r,g,b\n0.png,"a,b",7,1,2,3\n1.png,c,8,0.5,0,0.001\n',
        "1 2 3\n0.5 0 0.001\n",
        "\ufeff 1,2,3\r\n0.5;0;0.001\r\n",
    ],
)
def test_ground_truths_of_every_layout(tmp_path: Path, text: str) -> None:
    path = tmp_path / "gt"
    path.write_bytes(text.encode())
    np.testing.assert_array_equal(load_ground_truths(path), [[1, 2, 3], [0.5, 0, 0.001]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("File,R,Green\na,1,2\n", "line 1: no columns GT_R,GT_G,GT_B or r,g,b; found file,r,green"),
        ("r,g,b\n", "holds no ground truth"),
        ("1 2 3\n4 5\n", "line 2: '4 5' is no ground truth: expected 3 numbers, found 2"),
        ("r,g,b\n1,2\n", "line 2: '1,2' is no ground truth"),
        ("1 2 3\n\n1 x 3\n", "line 3: '1 x 3' is no ground truth"),
        ("1 2 -3\n", "expected numbers from 0"),
        ("nan 2 3\n", "expected numbers from 0"),
        ("0 0 0\n", "sum above 0"),
    ],
)
def test_a_bad_ground_truth_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "gt.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        load_ground_truths(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"cannot read ground truths .*none\.csv"):
        load_ground_truths(tmp_path / "none.csv")


@pytest.mark.parametrize("path", available(*REAL), ids=lambda path: path.name)
def test_real_ground_truths_are_read(path: Path) -> None:
    lights = load_ground_truths(path)
    number, first = REAL[f"gt/{path.name}"]
    assert lights.shape == (number, 3)
    assert lights[0].tolist() == first
