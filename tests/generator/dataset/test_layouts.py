"""Layouts: the same images in folders, tar and Parquet files, read back by the programs that they are for."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast, get_args, get_type_hints

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import FormatError, InputError, StorageError
from generator.dataset import layouts
from generator.dataset.joined import JoinedLayout
from generator.dataset.layouts import FileLayout
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset, file_faults, open_dataset
from generator.dataset.records import COMPLETED_BY_HAND, Layout
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights
from generator.masks.making import parse_masks
from generator.options import ImageOptions
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import SourcePicture
from tests.generator.conftest import MakeLut
from tests.generator.groups import grouped

pytestmark = pytest.mark.slow

Make = Callable[..., Dataset]

SCENES = random_scenes(9, 28, 24, 8)
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
JOINED: tuple[Layout, ...] = tuple(name for name in LAYOUTS if isinstance(layouts.LAYOUTS[name], JoinedLayout))


@pytest.fixture
def make(make_lut: MakeLut, tmp_path: Path) -> Make:
    """Return a maker of datasets of two images of each scene, in shards of 5."""
    lut = make_lut()

    def call(layout: Layout, lights: Any = (2, 0), scenes: int = 9, **options: Any) -> Dataset:
        out = tmp_path / f"{layout}-{len(list(tmp_path.iterdir()))}"
        wishes: dict[str, Any] = {"seed": 3, "layout": layout, "shard_images": 5, "rendering": "codes", **options}
        return generate_dataset(lut, out, SCENES[:scenes], lights, **grouped(**wishes))

    return call


def decoded(data: bytes) -> npt.NDArray[np.uint16]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image[..., ::-1], dtype=np.uint16)


def place_of(made: Dataset) -> Path:
    return Path(made.store.place)


def test_every_layout_is_offered() -> None:
    offered = get_type_hints(ImageOptions)["layout"]
    assert LAYOUTS == get_args(offered) == tuple(layouts.LAYOUTS)


@pytest.mark.parametrize("form", ["png", "tiff", "exr", "jxl", "dng"])
def test_every_format_is_the_same_image_in_every_layout(make: Make, form: str) -> None:
    folder, *others = (make(layout, form=form, scenes=4) for layout in LAYOUTS)
    assert [other.entries for other in others] == [folder.entries] * len(others)
    assert [entry.image for entry in folder.entries] == [f"{number:06d}.{form}" for number in range(8)]
    for entry in folder.entries[::3]:
        image = folder.read_image(entry)
        assert image.shape == ((12, 14, 3) if form == "dng" else (24, 28, 3))
        for other in others:
            np.testing.assert_array_equal(other.read_image(entry), image)
            assert other.read_preview(entry) == folder.read_preview(entry) != None  # noqa: E711


@pytest.mark.parametrize("split", [None, (0.6, 0.0, 0.4)])
def test_another_layout_of_files_is_one_entry(make: Make, monkeypatch: pytest.MonkeyPatch, split: Any) -> None:
    lights = SimultaneousLights(ListedLights((2, 0)), 2, parse_masks("half-plane", 2, 5))
    usual = make("folder", lights, split=split)
    images = [(usual.read_image(one), usual.read_weights(one), usual.read_preview(one)) for one in usual.entries]
    entry = FileLayout(place=lambda kind, part, name: f"{part}/{kind}/{name}")
    monkeypatch.setitem(cast("dict[str, Any]", layouts.LAYOUTS), "folder", entry)
    other = make("folder", lights, split=split)
    parts = {"train", "test"} if split else {"data"}
    assert {path.parts[-3] for path in place_of(other).rglob("*.png")} == parts
    assert list(file_faults(place_of(other))) == []
    for one, (image, weights, preview) in zip(other.entries, images, strict=True):
        np.testing.assert_array_equal(other.read_image(one), image)
        np.testing.assert_array_equal(other.read_weights(one), weights)
        assert other.read_preview(one) == preview
    card = (place_of(other) / "README.md").read_text()
    assert all(f"`{part}/images/NNNNNN.png`" in card for part in parts)
    assert (entry.folder("masks", ["train", "test"]), entry.folder("masks", ["test"])) == (None, "test/masks")


READER = """
import hashlib, json, sys
# It does without PyTorch, whose import takes longer than all else.
sys.modules["torch"] = None
import webdataset
for sample in webdataset.WebDataset(sys.argv[1:], shardshuffle=False):
    digests = {key: hashlib.sha256(sample[key]).hexdigest() for key in ("png", "preview.jpg")}
    print(json.dumps([sample["__url__"], sample["__key__"], json.loads(sample["json"]), digests]))
"""


def test_the_webdataset_package_reads_the_shards(make: Make) -> None:
    made = make("webdataset", split=(0.6, 0.0, 0.4))
    files = make("folder", split=(0.6, 0.0, 0.4))
    lines = (place_of(files) / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in (line.split("  ") for line in lines)}
    entries = {entry.image: entry for entry in made.entries}
    urls = sorted(place_of(made).glob("*/*.tar"))
    # In a program of its own, because the package leaves files open.
    read = subprocess.run([sys.executable, "-c", READER, *urls], capture_output=True, text=True, check=True)
    for url, key, metadata, digests in map(json.loads, read.stdout.splitlines()):
        entry = entries.pop(f"{key}.png")
        assert digests == {"png": sums[f"images/{key}.png"], "preview.jpg": sums[f"previews/{key}.jpg"]}
        assert metadata["truth"] == pytest.approx(entry.truth, abs=1e-9)
        assert (metadata["source"], metadata["split"], metadata["width"]) == (entry.source, entry.split, 28)
        assert Path(url).parent.name == entry.split in ("train", "test")
    assert not entries


def test_equal_tar_files_whoever_makes_them(make: Make) -> None:
    made = make("webdataset")
    (first, *_) = sorted((place_of(made) / "data").iterdir())
    with tarfile.open(first) as tar:
        headers = tar.getmembers()
    assert [header.name for header in headers[:3]] == ["000000.png", "000000.preview.jpg", "000000.json"]
    assert {(header.uid, header.gid, header.uname, header.mtime, header.mode) for header in headers} == {
        (0, 0, "", 0, 0o644)
    }


@pytest.fixture
def hugging_face(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the package `datasets`, without network and with its files in a folder of the test."""
    cache = tmp_path_factory.mktemp("hugging-face")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(cache))
    monkeypatch.setenv("HF_DATASETS_CACHE", str(cache / "datasets"))
    datasets = import_module("datasets")
    datasets.disable_progress_bars()
    return datasets


def test_hugging_face_reads_the_shards(make: Make, hugging_face: Any, tmp_path: Path) -> None:
    made = make("parquet", split=(0.6, 0.0, 0.4), rendering="colorimetric")
    files = {part: str(place_of(made) / part / "*.parquet") for part in ("train", "test")}
    loaded = hugging_face.load_dataset("parquet", data_files=files, cache_dir=str(tmp_path / "cache"))
    assert set(loaded) == {"train", "test"}
    entries = {entry.image: entry for entry in made.entries}
    for part, rows in loaded.items():
        assert type(rows.features["image"]).__name__ == "Image"
        for row in rows:
            entry = entries.pop(row["image"]["path"])
            np.testing.assert_array_equal(decoded(row["image"]["bytes"]), made.read_image(entry))
            assert row["preview"].size == (28, 24), "previews are decoded, as pictures"
            assert row["number"] == int(entry.image[:6])
            assert (row["source"], row["split"]) == (entry.source, part) == (entry.source, entry.split)
            assert row["truth"] == pytest.approx(entry.truth, abs=1e-9)
            assert [light["illumination"] for light in row["lights"]] == list(entry.lights)
            details = json.loads(row["details"])
            assert {name: f"{value:g}" if name != "cells" else value for name, value in details.items()} == (
                made.details[entry.image]
            )
    assert not entries


@dataclass(frozen=True)
class Gone:
    """A source on a disk that is not there any more."""

    name: str = "gone"

    def read(self) -> SourcePicture:
        raise StorageError("the disk is gone")

    def to_json(self) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_shard_that_cannot_be_ended_is_given_up_quietly(
    make_lut: MakeLut, tmp_path: Path, layout: Layout, capfd: pytest.CaptureFixture[str]
) -> None:
    """A writer that ends its file when it is thrown away finds the file closed; pytest fails for that."""
    with pytest.raises(StorageError):
        generate_dataset(make_lut(), tmp_path / "out", (*SCENES, Gone()), [0], options=DatasetOptions(layout=layout))
    gc.collect()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if layouts.LAYOUTS[name].is_of_the_hub])
def test_hugging_face_finds_the_parts_by_the_card(
    make: Make, hugging_face: Any, tmp_path: Path, layout: Layout
) -> None:
    made = make(layout, split=(0.6, 0.0, 0.4), previews=False)
    loaded = hugging_face.load_dataset(str(place_of(made)), cache_dir=str(tmp_path / "cache"))
    assert {part: rows.num_rows for part, rows in loaded.items()} == {
        part: images for part, images in made.description.splits.items() if images
    }
    assert not {"preview", "details", "masks", "ground_truth"} & set(loaded["train"].column_names)


def maps_in_folder(place: Path) -> list[bytes]:
    names = ("masks/000003_0.png", "masks/000003_1.png", "ground_truth/000003.png")
    return [(place / name).read_bytes() for name in names]


def maps_in_tar(place: Path) -> list[bytes]:
    with tarfile.open(place / "data" / "000000.tar") as tar:
        streams = [tar.extractfile(f"000003.{name}.png") for name in ("masks_0", "masks_1", "ground_truth")]
        return [stream.read() for stream in streams if stream is not None]


def maps_in_parquet(place: Path) -> list[bytes]:
    row = import_module("pyarrow.parquet").read_table(place / "data" / "000000.parquet").to_pylist()[3]
    return [file["bytes"] for file in (*row["masks"], row["ground_truth"])]


MAPS_OF = {"folder": maps_in_folder, "webdataset": maps_in_tar, "parquet": maps_in_parquet}
"""Both masks of the fourth image and its ground truth, by other readers than ours."""


@pytest.mark.parametrize("layout", LAYOUTS)
def test_several_lights_in_an_image(make: Make, make_lut: MakeLut, layout: Layout) -> None:
    choice = SimultaneousLights(ListedLights((2, 0)), 2, parse_masks("half-plane", 2, 5))
    made = make(layout, choice)
    entry = made.entries[3]
    assert entry.lights == ("2", "0")
    assert len(made.entries) == 9
    assert np.sum(entry.truth) == pytest.approx(1)
    text = (place_of(made) / "ground_truth.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in text[7:9]] == ["000003.png", "000003.png"]
    first, second, truth = MAPS_OF[layout](place_of(made))
    weights = np.stack([grey(first), grey(second)], axis=-1) / 65535
    truths = decoded(truth) / 65535
    assert weights.shape == (24, 28, 2)
    np.testing.assert_allclose(weights.sum(axis=2), 1, atol=1e-6)
    np.testing.assert_allclose(made.read_weights(entry), weights, atol=1e-7)
    np.testing.assert_allclose(made.read_ground_truth_map(entry), truths, atol=1e-7)
    single = make(layout, scenes=2, split=(0.5, 0.5, 0.0))
    for read in (single.read_weights, single.read_ground_truth_map):
        with pytest.raises(InputError, match=r"000002\.png"):
            read(single.entries[2])
    # Where one light is alone, the map is that light; and the mean of the lights is that of their parts.
    alone = weights[..., 0] == 1
    assert 0 < alone.sum() < alone.size
    np.testing.assert_allclose(truths[alone], np.broadcast_to(entry.truths[0], (alone.sum(), 3)), atol=2e-5)
    whites = np.array([light.white for light in sorted(made.description.lights, key=lambda light: -light.illumination)])
    mean = weights.mean(axis=(0, 1)) @ whites
    np.testing.assert_allclose(mean / mean.sum(), entry.truth, atol=1e-6)


def grey(data: bytes) -> npt.NDArray[np.uint16]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, dtype=np.uint16)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_verifying_names_what_is_not_as_it_was_made(make: Make, layout: Layout) -> None:
    folder = place_of(make(layout, split=(0.5, 0.2, 0.3)))
    verified: list[tuple[int, int]] = []
    assert list(file_faults(folder, lambda done, total: verified.append((done, total)), workers=3)) == []
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    files = len(names - {"SHA256SUMS", *COMPLETED_BY_HAND})
    assert verified == [(done + 1, files) for done in range(files)]
    victim = sorted(path for path in folder.rglob("00000*") if path.suffix != ".jpg")[0]
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(bytes(data))
    (folder / "gt.txt").unlink()
    (folder / "notes.txt").write_text("mine")
    # Its makers answer the questions left open.
    (folder / "DATASHEET.md").write_text("answered")
    assert sorted(file_faults(folder)) == sorted(
        [
            f"{victim.relative_to(folder).as_posix()} has changed",
            "gt.txt is missing",
            "notes.txt is no part of the dataset",
        ]
    )
    with pytest.raises(FormatError, match=r"dataset\.json"):
        list(file_faults(folder.parent))


@pytest.mark.parametrize("layout", JOINED)
def test_damaged_shards_are_named(make: Make, layout: Layout) -> None:
    made = make(layout)
    (file,) = (place_of(made) / "data").glob("000002.*")
    entry = made.entries[12]
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with pytest.raises(FormatError, match=rf"{file.name} (is damaged|holds no 000012)"):
        made.read_image(entry)
    file.unlink()
    with pytest.raises(FormatError, match=rf"{file.name}: No such"):
        made.read_image(entry)


@pytest.mark.parametrize("layout", ["webdataset", "parquet"])
def test_an_image_whose_name_lost_its_ending_is_read_or_refused(make: Make, layout: Layout) -> None:
    """A tar file has it under its whole name, a Parquet file under its number."""
    made = make(layout)
    table = place_of(made) / "ground_truth.csv"
    table.write_text(table.read_text().replace("000000.png", "000000"))
    found = open_dataset(place_of(made))
    if layout == "webdataset":
        with pytest.raises(FormatError, match="holds no 000000"):
            found.read_image(found.entries[0])
    else:
        np.testing.assert_array_equal(found.read_image(found.entries[0]), made.read_image(made.entries[0]))
    np.testing.assert_array_equal(found.read_image(found.entries[1]), made.read_image(made.entries[1]))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_image_is_a_number_with_an_ending_and_no_path(make: Make, layout: Layout) -> None:
    table = place_of(make(layout, scenes=2)) / "ground_truth.csv"
    text = table.read_text()
    for name in ("000000../outside/canary.png", "../000000.png", "٠٠٠٠٠٠.png", "0.0/0.png"):
        table.write_text(text.replace("000000.png", name), encoding="utf-8")
        with pytest.raises(FormatError):
            open_dataset(table.parent)
    table.write_text(text.replace("000000.png", "000000"), encoding="utf-8")
    assert open_dataset(table.parent).entries[0].image == "000000"


def test_a_number_comes_once_and_has_few_digits(make: Make) -> None:
    table = place_of(make("folder", scenes=2)) / "ground_truth.csv"
    text = table.read_text()
    for name in ("0.png", "000000.tiff", "1" * 11 + ".png", "1" * 5000 + ".png"):
        table.write_text(text.replace("\n000001.png,", f"\n{name},"))
        with pytest.raises(FormatError):
            open_dataset(table.parent)


def test_the_layout_parquet_says_what_it_needs(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def find_spec(name: str) -> None:
        del name

    monkeypatch.setattr("generator.dataset.layouts.find_spec", find_spec)
    with pytest.raises(InputError, match=r"pip install pyarrow"):
        make("parquet")
