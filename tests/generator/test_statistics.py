"""The numbers of an image, and the file of a real data set's statistics as the generator reads it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from foundation.errors import FormatError
from generator.lights.distributions import load_ground_truths
from generator.statistics import cell_means, numbers_of_cells, read_statistics
from tests.generator.stats_files import write_stats

LIGHTS = [[0.3, 0.4, 0.3], [0.4, 0.4, 0.2], [0.2, 0.5, 0.3]]


def test_what_a_file_says(tmp_path: Path) -> None:
    path = write_stats(tmp_path / "s.json", LIGHTS, {"grey_red": [0.1, float("nan"), -0.2]})
    # A number that is not known is written as null.
    path.write_text(path.read_text().replace("NaN", "null"))
    found = read_statistics(path)
    assert (found.name, found.cells, found.images, found.sizes) == ("real", 64, 3, ((60, 40, 3),))
    assert found.lights.tolist() == LIGHTS
    assert found.known("grey_red").tolist() == [0.1, -0.2]
    assert found.known("no such number").size == 0


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"version": 2}, "version 2; expected crop.statistics, version 1"),
        ({"format": "crop.dataset"}, "is of format crop.dataset"),
        ({"lights": []}, "lights of shape"),
        ({"lights": [[0.5, 0.0, 0.5]]}, "above 0"),
        ({"lights": [[0.5, float("nan"), 0.5]]}, "above 0"),
        ({"values": {"grey_red": [1.0]}}, "numbers of 3 images expected of grey_red"),
        ({"values": None}, "not as its format has it"),
        ({"data": {}}, "KeyError"),
    ],
)
def test_what_is_no_such_file(tmp_path: Path, change: dict[str, object], told: str) -> None:
    path = write_stats(tmp_path / "s.json", LIGHTS, {"grey_red": [0, 1, 2]}, **change)
    with pytest.raises(FormatError, match=told) as caught:
        read_statistics(path)
    assert str(path) in str(caught.value)
    assert "evaluate describe" in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", '"crop.statistics"', "\udcff".encode("utf-8", "surrogateescape")])
def test_damage(tmp_path: Path, text: str | bytes) -> None:
    path = tmp_path / "s.json"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(FormatError, match="evaluate describe"):
        read_statistics(path)
    with pytest.raises(FormatError, match="evaluate describe"):
        load_ground_truths(path)


def test_lights_of_a_file_are_ground_truths(tmp_path: Path) -> None:
    path = write_stats(tmp_path / "s.json", LIGHTS, {})
    assert load_ground_truths(path).tolist() == LIGHTS
    content = json.loads(path.read_text())
    del content["lights"]
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError, match="has no lights"):
        load_ground_truths(path)


def test_images_encoded_for_a_display_are_told_from_linear_ones(tmp_path: Path) -> None:
    linear = np.random.default_rng(2).lognormal(np.log(0.16), 0.6, 200)
    encoded = 1.055 * linear ** (1 / 2.4) - 0.055
    found = [
        read_statistics(write_stats(tmp_path / f"{name}.json", LIGHTS, {"luminance_50": values}))
        for name, values in (("linear", linear), ("encoded", encoded))
    ]
    assert [made.may_be_encoded for made in found] == [False, True]


def test_cells_of_a_picture_are_means_over_their_pixels() -> None:
    image = np.random.default_rng(1).integers(0, 60000, (70, 131, 3)).astype(np.uint16)
    cells = cell_means(image, [1.0, 2.0, 0.5], side=8)
    assert cells.shape == (8, 8, 3)
    rows, columns = np.arange(9) * 70 // 8, np.arange(9) * 131 // 8
    even = np.array([1.0, 2.0, 0.5]) / np.mean([1.0, 2.0, 0.5])
    wanted = image[rows[3] : rows[4], columns[7] : columns[8]].astype(float).mean(axis=(0, 1)) / even
    assert cells[3, 7] == pytest.approx(wanted)


def test_numbers_of_two_colours() -> None:
    """A quarter of the cells red of twice the blue and green, the rest grey of half the luminance."""
    cells = np.full((8, 8, 3), 0.5)
    cells[:4, :4] = (1.5, 0.75, 0.75)
    values, luminance, chroma = numbers_of_cells(cells)
    assert values["near_grey"] == 0.75
    assert values["luminance_50"] == pytest.approx(0.5)
    assert values["log_red_spread"] == pytest.approx(np.log(2) * np.sqrt(3) / 4)
    assert values["log_blue_spread"] == pytest.approx(0)
    mean = cells.mean(axis=(0, 1))
    assert values["grey_red"] == pytest.approx(np.log(mean[0] / mean[1]))
    assert luminance.sum() == pytest.approx(1)
    assert chroma.sum() == pytest.approx(1)


def test_a_cell_is_near_grey_up_to_three_degrees_from_white() -> None:
    # Away from white across it, by the tangent of the angle.
    across = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    tilted = [np.ones(3) / np.sqrt(3) + np.tan(np.radians(degrees)) * across for degrees in (0.0, 2.9, 3.1, 5.0)]
    values, _, _ = numbers_of_cells(np.array(tilted).reshape(2, 2, 3))
    assert values["near_grey"] == 0.5


def test_an_image_without_colour_has_no_numbers() -> None:
    values, luminance, chroma = numbers_of_cells(np.full((4, 4, 3), np.nan))
    assert all(np.isnan(value) for value in values.values())
    assert luminance.sum() == chroma.sum() == 0
