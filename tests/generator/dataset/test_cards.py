"""The card for the Hugging Face Hub, and the datasheet."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import pytest

from calibration.citation import OriginRecord
from generator.dataset.cards import OPEN, card, datasheet
from generator.dataset.layouts import LAYOUTS
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.records import Description, Layout, Split
from generator.pictures.random_scenes import random_scenes
from tests.generator.conftest import lut_in

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.dataset.reader import Dataset

# Sections of Gebru et al., 2021, in their order.
SECTIONS = (
    "Motivation",
    "Composition",
    "Collection process",
    "Preprocessing, cleaning, labelling",
    "Uses",
    "Distribution",
    "Maintenance",
)

ORIGIN = OriginRecord(
    rig="lab",
    camera_serial="00ff",
    camera_serial_is="hash",
    lens="EF50mm | f/1.8 <II>",
    iso=100,
    aperture=8.0,
    shutter_s=0.5,
    exposure_by="raw files",
    first_frame="2026-03-01T21:30:00+00:00",
    last_frame="2026-03-02T04:00:00+00:00",
    authors=["Family, Given"],
    licence="CC-BY-4.0",
    note="one line\n---\nand another",
)


def dataset_in(out: Path, lut: Lut, layout: Layout) -> Dataset:
    options = DatasetOptions(layout=layout, shard_images=4, split=(0.6, 0.2, 0.2), previews=False)
    return generate_dataset(lut, out, random_scenes(4, 24, 16, 8), [1, 0], seed=3, options=options)


@pytest.fixture(scope="module", params=get_args(Layout))
def data_set(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("cards")
    return dataset_in(folder / "out", lut_in(folder / "lut"), request.param)


@pytest.fixture(scope="module")
def folder_data_set(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("plain")
    return dataset_in(folder / "out", lut_in(folder / "lut"), "folder")


def folder_of(data_set: Dataset) -> Path:
    return Path(data_set.store.location)


def with_origin(data_set: Dataset, origin: OriginRecord | None, **table: object) -> Description:
    record = data_set.description.table.model_copy(update={"origin": origin, **table})
    return data_set.description.model_copy(update={"table": record})


@pytest.mark.slow
def test_hub_client_reads_card(data_set: Dataset) -> None:
    # The client of the Hub refuses an invalid front matter.
    hub = import_module("huggingface_hub")
    card_file = hub.DatasetCard((folder_of(data_set) / "README.md").read_text())
    assert card_file.data.license == "unknown"
    assert card_file.data.size_categories == ["n<1K"]
    assert "color-constancy" in card_file.data.tags
    files = [entry for config in card_file.data.to_dict()["configs"] for entry in config["data_files"]]
    splits = data_set.description.splits
    split_names: set[Split] = {split for split, images in splits.items() if images}  # pyrefly: ignore[bad-assignment]
    assert {entry["split"] for entry in files} == (
        split_names if LAYOUTS[data_set.layout].is_read_by_hugging_face else {"train"}
    )
    for entry in files:
        assert list(folder_of(data_set).glob(entry["path"])), entry


@pytest.mark.slow
def test_hub_loads_folder_by_card(folder_data_set: Dataset, tmp_path: Path) -> None:
    load = import_module("datasets").load_dataset
    rows = load(str(folder_of(folder_data_set)), split="train", cache_dir=str(tmp_path / "cache"))
    assert [row["image"] for row in rows] == [entry.image for entry in folder_data_set.entries]


@pytest.mark.slow
def test_datasheet_sections_and_open_questions(data_set: Dataset) -> None:
    text = datasheet(data_set.description)
    assert tuple(re.findall(r"^## (.+)$", text, re.MULTILINE)) == SECTIONS
    assert "${" not in text
    count = re.search(r"(\d+) questions are marked", text)
    assert count is not None
    assert int(count[1]) == text.count(OPEN)
    # Each question has an answer or the mark.
    for question, answer in re.findall(r"^\*\*([^*\n]+\?)\*\*\n\n(.+?)(?=\n\n|\Z)", text, re.MULTILINE | re.DOTALL):
        assert answer.strip(), question
    assert text == (folder_of(data_set) / "DATASHEET.md").read_text()


def test_escapes_origin_of_lut(folder_data_set: Dataset) -> None:
    description = with_origin(folder_data_set, ORIGIN)
    for text in (card(description), datasheet(description)):
        assert "| Lens | EF50mm \\| f/1.8 &lt;II> |" in text
        assert "| Note | one line --- and another |" in text
        assert "author = {Family, Given}" in text
    assert "The LUT: CC-BY-4.0." in datasheet(description)
    # Text of the LUT must not end the front matter.
    assert card(description).count("\n---\n") == 1


def test_texts_of_computed_lut(folder_data_set: Dataset) -> None:
    body = {"electrons_per_dn": 1.8, "read_noise_dn": 6.0, "sensor_noise_e": 2.8}
    computed = {"by": "sim table", "body": body, "exposure": {"iso": 200}}
    text = datasheet(with_origin(folder_data_set, None, computed=computed))
    assert "The report of the LUT has the verdict" not in text
    assert "The frames of the LUT" not in text
    assert "one count is 0.9 electrons at its ISO 200" in text
    assert "read noise of a photosite is 6 counts. The part of it that arises before the amplifier is 2.8" in text
    assert "The report of the LUT has the verdict" in datasheet(folder_data_set.description)
    # A LUT computed by others may lack these values.
    assert "does not record gain" in card(with_origin(folder_data_set, None, computed={"by": "others"}))
