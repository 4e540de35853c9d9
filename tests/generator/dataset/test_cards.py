"""Card and datasheet: what the Hub reads, and what is left to the makers."""

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

SECTIONS = (
    "Motivation",
    "Composition",
    "Collection process",
    "Preprocessing, cleaning, labelling",
    "Uses",
    "Distribution",
    "Maintenance",
)
"""The sections of Gebru et al., 2021, in their order."""

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
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("cards")
    return dataset_in(folder / "out", lut_in(folder / "lut"), request.param)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("plain")
    return dataset_in(folder / "out", lut_in(folder / "lut"), "folder")


def place_of(made: Dataset) -> Path:
    return Path(made.store.place)


def with_origin(made: Dataset, origin: OriginRecord | None, **table: object) -> Description:
    known = made.description.table.model_copy(update={"origin": origin, **table})
    return made.description.model_copy(update={"table": known})


@pytest.mark.slow
def test_the_card_is_what_the_hub_reads(made: Dataset) -> None:
    # The Hub's own client reads the front matter and refuses what it cannot use.
    hub = import_module("huggingface_hub")
    read = hub.DatasetCard((place_of(made) / "README.md").read_text())
    assert read.data.license == "unknown"
    assert read.data.size_categories == ["n<1K"]
    assert "color-constancy" in read.data.tags
    files = [entry for config in read.data.to_dict()["configs"] for entry in config["data_files"]]
    splits = made.description.splits
    named: set[Split] = {part for part, images in splits.items() if images}  # pyrefly: ignore[bad-assignment]
    assert {entry["split"] for entry in files} == (named if LAYOUTS[made.layout].is_of_the_hub else {"train"})
    for entry in files:
        assert list(place_of(made).glob(entry["path"])), entry


@pytest.mark.slow
def test_the_data_set_of_a_folder_loads_by_its_card(plain: Dataset, tmp_path: Path) -> None:
    load = import_module("datasets").load_dataset
    rows = load(str(place_of(plain)), split="train", cache_dir=str(tmp_path / "cache"))
    assert [row["image"] for row in rows] == [entry.image for entry in plain.entries]


@pytest.mark.slow
def test_the_datasheet_has_its_sections_and_marks_what_is_open(made: Dataset) -> None:
    text = datasheet(made.description)
    assert tuple(re.findall(r"^## (.+)$", text, re.MULTILINE)) == SECTIONS
    assert "${" not in text
    said = re.search(r"(\d+) questions are marked", text)
    assert said is not None
    assert int(said[1]) == text.count(OPEN)
    # Each question has an answer or the mark.
    for question, answer in re.findall(r"^\*\*([^*\n]+\?)\*\*\n\n(.+?)(?=\n\n|\Z)", text, re.MULTILINE | re.DOTALL):
        assert answer.strip(), question
    assert text == (place_of(made) / "DATASHEET.md").read_text()


def test_what_a_table_says_is_carried_and_breaks_no_line(plain: Dataset) -> None:
    described = with_origin(plain, ORIGIN)
    for text in (card(described), datasheet(described)):
        assert "| Lens | EF50mm \\| f/1.8 &lt;II> |" in text
        assert "| Note | one line --- and another |" in text
        assert "author = {Family, Given}" in text
    assert "The table: CC-BY-4.0." in datasheet(described)
    # The front matter is closed once, whatever the table says.
    assert card(described).count("\n---\n") == 1


def test_a_computed_table_has_neither_frames_nor_report_but_a_known_gain(plain: Dataset) -> None:
    body = {"electrons_per_dn": 1.8, "read_noise_dn": 6.0, "sensor_noise_e": 2.8}
    computed = {"by": "sim table", "body": body, "exposure": {"iso": 200}}
    text = datasheet(with_origin(plain, None, computed=computed))
    assert "The table's report has the verdict" not in text
    assert "The table's frames" not in text
    assert "a count is 0.9 electrons at its ISO 200" in text
    assert "read noise of a photosite 6 counts, of which 2.8" in text
    assert "The table's report has the verdict" in datasheet(plain.description)
    # A table that others computed need not say it.
    assert "does not state gain" in card(with_origin(plain, None, computed={"by": "others"}))
