"""The contact sheet of a dataset: what it shows, in which order, within the page."""

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


def made_of(
    lut: Lut, out: Path, scenes: int, lights: Sequence[int] | LightChoice, size: tuple[int, int] = (24, 16)
) -> Dataset:
    options = DatasetOptions(previews=False, rendering="codes")
    return generate_dataset(lut, out, random_scenes(scenes, *size), lights, options=options)


def images_on(figure: Figure) -> int:
    """Return how many pictures a sheet shows, each of which and each text is within the page and beside the others."""
    pictures = [axes.get_position() for axes in figure.axes if axes.images]
    for axes in figure.axes:
        # Pictures are not stretched, and a light's dot is round.
        box, shown = axes.get_position(), np.asarray(axes.images[0].get_array() if axes.images else [[0]])
        width, height = figure.get_size_inches()
        assert (box.height * height) / (box.width * width) == pytest.approx(shown.shape[0] / shown.shape[1])
    for place, one in enumerate(pictures):
        assert not any(one.overlaps(other) for other in pictures[:place])
    for axes in figure.axes:
        box = axes.get_position()
        assert 0 < box.x0 < box.x1 < 1
        assert 0 < box.y0 < box.y1 < 1
    # Words begin where the first column does, or further to the right.
    left = min(box.x0 for box in pictures)
    for text in figure.texts:
        x, y = text.get_position()
        assert left - 1e-9 < x < 1
        assert 0 < y < 1
    return len(pictures)


def test_a_contact_sheet_shows_rows_of_sources(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    load = Dataset.read_image

    def read(self: Dataset, entry: Entry) -> npt.NDArray[np.uint16]:
        shown.append(entry.image)
        return load(self, entry)

    monkeypatch.setattr(Dataset, "read_image", read)
    made = made_of(make_lut(), tmp_path / "out", 5, [0, 1, 2, 3])
    whole = draw(made, MAX_ROWS, MAX_COLUMNS)
    assert len(shown) == images_on(whole) == 20
    assert len(whole.axes) == 20 + 4, "a dot for each light above its column"
    shown.clear()
    part = contact_sheet(made, max_rows=3, max_columns=2)
    assert shown == ["000000.png", "000003.png", "000008.png", "000011.png", "000016.png", "000019.png"]
    assert part.dtype == np.uint8
    width, height = np.round(whole.get_size_inches() * whole.dpi)
    assert part.shape[0] < height
    assert part.shape[1] < width


def test_of_many_lights_as_many_are_shown_as_are_recognised(make_lut: MakeLut, tmp_path: Path) -> None:
    lights = ListedLights(tuple(mixture_of({0: part, 1: 10 - part}) for part in range(1, 10)))
    made = made_of(make_lut(), tmp_path / "out", 1, lights)
    assert made.description.images == 9
    sheet = draw(made, MAX_ROWS, MAX_COLUMNS)
    assert images_on(sheet) == 8
    # A mixture has its chromaticity for a name, and for a colour what its lights' codes make together in linear light.
    assert made.entries[0].lights == ("0:0.1+1:0.9",)
    truth = made.entries[0].truths[0]
    words = [text.get_text() for text in sheet.texts]
    assert f"r {truth[0]:.2f} b {truth[2]:.2f}".replace(" 0.", " .") in words
    dot: Any = next(axes.patches[0] for axes in sheet.axes if axes.patches)
    # Their codes are 9, 8, 0 and 9, 8, 1, and a display's light goes with the power 2.2 of its codes.
    assert np.multiply(dot.get_facecolor()[:3], 255) == pytest.approx([9, 8, 0.9 ** (1 / 2.2)])


def test_images_of_one_light_a_picture_fill_a_grid(make_lut: MakeLut, tmp_path: Path) -> None:
    """Rows of one image each would be a narrow column with an empty page beside it."""
    made = made_of(make_lut(), tmp_path / "out", 30, RandomLights(1, 4, 0))
    whole = draw(made, MAX_ROWS, MAX_COLUMNS)
    words = [text.get_text() for text in whole.texts]
    width, height = whole.get_size_inches()
    assert images_on(whole) == 24
    assert 0.6 < height / width < 1.1
    assert any("24 of 30 pictures shown" in word for word in words)
    names = [entry.source for entry in made.entries]
    assert [word for word in words if word in names] == [
        names[place] for place in np.linspace(0, 29, 24).round().astype(int)
    ]
    few = draw(made, 2, 3)
    words = [text.get_text() for text in few.texts]
    assert few.get_size_inches()[1] < height
    assert any("4 of 30 pictures shown" in word for word in words)
    assert any("each exposed for itself" in word for word in words)
