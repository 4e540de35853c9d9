"""The contact sheet: selection and order of images, and their layout."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.table.lut import Lut
from generator.dataset.contact_sheet import MAX_COLUMNS, MAX_ROWS, contact_sheet
from generator.dataset.contact_sheet import _draw as draw
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset
from generator.dataset.records import Entry
from generator.lights.lighting import LightChoice, ListedLights, RandomLights, mixture_of
from generator.pictures.random_scenes import random_scenes
from tests.generator.conftest import MakeLut

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure


pytestmark = pytest.mark.slow


def make_data_set(
    lut: Lut, out: Path, scenes: int, lights: Sequence[int] | LightChoice, size: tuple[int, int] = (24, 16)
) -> Dataset:
    options = DatasetOptions(previews=False, rendering="codes")
    return generate_dataset(lut, out, random_scenes(scenes, *size), lights, options=options)


def images_on(figure: Figure) -> int:
    """Check that images and texts are inside the page and do not overlap; return the number of images."""
    pictures = [axes.get_position() for axes in figure.axes if axes.images]
    for axes in figure.axes:
        # Images keep their aspect ratio, and dots are round.
        box, displayed = axes.get_position(), np.asarray(axes.images[0].get_array() if axes.images else [[0]])
        width, height = figure.get_size_inches()
        assert (box.height * height) / (box.width * width) == pytest.approx(displayed.shape[0] / displayed.shape[1])
    for index, box in enumerate(pictures):
        assert not any(box.overlaps(earlier_box) for earlier_box in pictures[:index])
    for axes in figure.axes:
        box = axes.get_position()
        assert 0 < box.x0 < box.x1 < 1
        assert 0 < box.y0 < box.y1 < 1
    # Texts start at the first column or further right.
    smallest_x = min(box.x0 for box in pictures)
    for text in figure.texts:
        x, y = text.get_position()
        assert smallest_x - 1e-9 < x < 1
        assert 0 < y < 1
    return len(pictures)


def test_rows_of_sources(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    displayed: list[str] = []
    load = Dataset.read_image

    def read(self: Dataset, entry: Entry) -> npt.NDArray[np.uint16]:
        displayed.append(entry.image)
        return load(self, entry)

    monkeypatch.setattr(Dataset, "read_image", read)
    data_set = make_data_set(make_lut(), tmp_path / "out", 5, [0, 1, 2, 3])
    sheet = draw(data_set, MAX_ROWS, MAX_COLUMNS)
    assert len(displayed) == images_on(sheet) == 20
    assert len(sheet.axes) == 20 + 4, "a dot for each light above its column"
    displayed.clear()
    small_sheet = contact_sheet(data_set, max_rows=3, max_columns=2)
    assert displayed == ["000000.png", "000003.png", "000008.png", "000011.png", "000016.png", "000019.png"]
    assert small_sheet.dtype == np.uint8
    width, height = np.round(sheet.get_size_inches() * sheet.dpi)
    assert small_sheet.shape[0] < height
    assert small_sheet.shape[1] < width


def test_limits_number_of_lights(make_lut: MakeLut, tmp_path: Path) -> None:
    lights = ListedLights(tuple(mixture_of({0: weight, 1: 10 - weight}) for weight in range(1, 10)))
    data_set = make_data_set(make_lut(), tmp_path / "out", 1, lights)
    assert data_set.description.images == 9
    sheet = draw(data_set, MAX_ROWS, MAX_COLUMNS)
    assert images_on(sheet) == 8
    # The label of a mixture is its chromaticity, and its colour is the mixture of codes in linear light.
    assert data_set.entries[0].lights == ("0:0.1+1:0.9",)
    truth = data_set.entries[0].truths[0]
    texts = [text.get_text() for text in sheet.texts]
    assert f"r {truth[0]:.2f} b {truth[2]:.2f}" in texts
    dot: Any = next(axes.patches[0] for axes in sheet.axes if axes.patches)
    # The codes are 9, 8, 0 and 9, 8, 1; the display has a gamma of 2.2.
    assert np.multiply(dot.get_facecolor()[:3], 255) == pytest.approx([9, 8, 0.9 ** (1 / 2.2)])


def test_single_images_fill_a_grid(make_lut: MakeLut, tmp_path: Path) -> None:
    data_set = make_data_set(make_lut(), tmp_path / "out", 30, RandomLights(1, 4, 0))
    sheet = draw(data_set, MAX_ROWS, MAX_COLUMNS)
    texts = [text.get_text() for text in sheet.texts]
    width, height = sheet.get_size_inches()
    assert images_on(sheet) == 24
    assert 0.6 < height / width < 1.1
    assert any("24 of 30 pictures shown" in text for text in texts)
    names = [entry.source for entry in data_set.entries]
    assert [text for text in texts if text in names] == [
        names[index] for index in np.linspace(0, 29, 24).round().astype(int)
    ]
    small_sheet = draw(data_set, 2, 3)
    texts = [text.get_text() for text in small_sheet.texts]
    assert small_sheet.get_size_inches()[1] < height
    assert any("4 of 30 pictures shown" in text for text in texts)
    assert any("image by image" in text for text in texts)
