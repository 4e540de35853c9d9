"""Which lights fall on which picture."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from drivers.errors import FormatError, InputError
from generator.illuminant import LightChoice, RandomLights, load_ground_truths, nearest_lights, parse_lights

if TYPE_CHECKING:
    from collections.abc import Callable

    from calibration.lut import Lut

GT = Path(__file__).parents[2].parent / "shared" / "data" / "gt"


def test_lists_and_ranges() -> None:
    assert parse_lights("0,5,12-14, 5 ,3 - 3", 15).lights == (0, 5, 12, 13, 14, 3)
    assert parse_lights("all", 3).lights == (0, 1, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,x", "'x' is no light"),
        ("", "'' is no light"),
        ("1,,2", "'' is no light"),
        ("-3", "'-3' is no light"),
        ("1.5", "'1.5' is no light"),
        ("3-1", "'3-1' runs backwards; write 1-3"),
        ("9", "there is no light 9; the table has lights 0 to 8"),
        ("2-707", "there is no light 707; the table has lights 0 to 8"),
    ],
)
def test_a_bad_list_names_its_bad_entry(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_lights(text, 9)


def test_random_lights_are_distinct_even_and_their_seeds() -> None:
    choice = RandomLights(3, 10, seed=1)
    drawn = [choice.lights_of(position) for position in range(4000)]
    assert all(len(set(lights)) == 3 for lights in drawn)
    counts = Counter(light for lights in drawn for light in lights)
    assert all(abs(counts[light] - 1200) < 6 * (1200 * 0.7) ** 0.5 for light in range(10))
    assert drawn != [RandomLights(3, 10, seed=2).lights_of(position) for position in range(4000)]
    assert isinstance(choice, LightChoice)


@pytest.mark.parametrize("count", [0, 11])
def test_more_random_lights_than_the_table_has_are_refused(count: int) -> None:
    with pytest.raises(InputError, match=f"{count} random lights a picture were asked for; the table has 10"):
        RandomLights(count, 10, 0)


def test_nearest_is_by_angle(make_lut: Callable[..., Lut]) -> None:
    lut = make_lut(lights=4)
    wanted = lut.white[[2, 0, 3]] * np.array([[1e-4], [7.0], [1.0]]) + [[0, 0, 1e-3]] * 3
    choice = nearest_lights(lut, wanted, "truths.csv")
    assert choice.lights == (2, 0, 3)
    assert max(choice.angles) < 0.2
    assert [choice.lights_of(position) for position in range(5)] == [(2,), (0,), (3,), (2,), (0,)]


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


def test_real_ground_truths_are_read() -> None:
    if not GT.is_dir():
        pytest.skip("the ground truths of Cube+ and NUS are not at hand")
    assert load_ground_truths(GT / "cubeplus_gt_1707.csv").shape == (1707, 3)
    assert load_ground_truths(GT / "nus8_gt_1853.csv")[0].tolist() == [
        0.507292583011997,
        0.809736795789161,
        0.294924662865143,
    ]
