"""The contact sheet of a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest
from matplotlib import text

from generator.dataset.contact_sheet import contact_sheet
from generator.dataset.layouts import Entry
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset
from generator.lights.lighting import RandomLights
from generator.pictures.sources import random_scenes

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from collections.abc import Callable

    from calibration.table.lut import Lut


def test_a_contact_sheet_shows_rows_of_sources(
    make_lut: Callable[..., Lut], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    load = Dataset.read_image

    def read(self: Dataset, entry: Entry) -> npt.NDArray[np.uint16]:
        shown.append(entry.image)
        return load(self, entry)

    monkeypatch.setattr(Dataset, "read_image", read)
    made = generate_dataset(
        make_lut(), tmp_path / "out", random_scenes(5, 24, 16), [0, 1, 2, 3], options=DatasetOptions(previews=False)
    )
    whole = contact_sheet(made)
    assert len(shown) == 20
    assert whole.dtype == np.uint8
    shown.clear()
    part = contact_sheet(made, max_rows=3, max_columns=2)
    assert shown == ["000000.png", "000003.png", "000008.png", "000011.png", "000016.png", "000019.png"]
    assert part.shape[0] < whole.shape[0]
    assert part.shape[1] < whole.shape[1]


def test_images_of_one_light_a_picture_fill_a_grid(
    make_lut: Callable[..., Lut], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of one image each would be a narrow column with an empty page beside it."""
    words: list[str] = []
    make = text.Text.set_text

    def noted(self: text.Text, s: Any) -> None:
        words.append(str(s))
        make(self, s)

    monkeypatch.setattr(text.Text, "set_text", noted)
    lut = make_lut()
    made = generate_dataset(lut, tmp_path / "out", random_scenes(30, 24, 16), RandomLights(1, 4, 0))
    whole = contact_sheet(made)
    assert 0.6 < whole.shape[0] / whole.shape[1] < 1.1
    assert any("24 of 30 pictures shown" in word for word in words)
    names = [entry.source for entry in made.entries]
    assert [word for word in words if word in names] == [
        names[place] for place in np.linspace(0, 29, 24).round().astype(int)
    ]
    words.clear()
    few = contact_sheet(made, max_rows=2, max_columns=3)
    assert few.shape[0] < whole.shape[0]
    assert any("4 of 30 pictures shown" in word for word in words)
    assert any("each exposed for itself" in word for word in words)
    words.clear()
    contact_sheet(generate_dataset(lut, tmp_path / "rows", random_scenes(5, 24, 16), [0, 1, 2]), 2, 2)
    assert any("; 4 of 15 images shown" in word for word in words)
