"""The numbers of an image, against images whose numbers are known."""

from __future__ import annotations

import numpy as np
import pytest

from generator.statistics import cell_means, numbers_of_cells


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


def test_an_image_without_colour_has_no_numbers() -> None:
    values, luminance, chroma = numbers_of_cells(np.full((4, 4, 3), np.nan))
    assert all(np.isnan(value) for value in values.values())
    assert luminance.sum() == chroma.sum() == 0
