"""Layouts: equal images in folders, tar and Parquet files, read by other programs."""

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
    """Return a function that makes data sets with two images of each scene, in shards of 5."""
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


def folder_of(data_set: Dataset) -> Path:
    return Path(data_set.store.location)


def test_every_layout_is_offered() -> None:
    offered = get_type_hints(ImageOptions)["layout"]
    assert LAYOUTS == get_args(offered) == tuple(layouts.LAYOUTS)


@pytest.mark.parametrize("form", ["png", "tiff", "exr", "jxl", "dng"])
def test_formats_are_equal_in_every_layout(make: Make, form: str) -> None:
    names = [layout for layout in LAYOUTS if layout != "c5" or form == "png"]
    folder, *other_layouts = (make(layout, form=form, scenes=4) for layout in names)
    assert [variant.entries for variant in other_layouts] == [folder.entries] * len(other_layouts)
    assert [entry.image for entry in folder.entries] == [f"{number:06d}.{form}" for number in range(8)]
    for entry in folder.entries[::3]:
        image = folder.read_image(entry)
        assert image.shape == ((12, 14, 3) if form == "dng" else (24, 28, 3))
        for variant in other_layouts:
            np.testing.assert_array_equal(variant.read_image(entry), image)
            assert variant.read_preview(entry) == folder.read_preview(entry) != None  # noqa: E711


@pytest.mark.parametrize("split", [None, (0.6, 0.0, 0.4)])
def test_adds_file_layout_by_one_entry(make: Make, monkeypatch: pytest.MonkeyPatch, split: Any) -> None:
    lights = SimultaneousLights(ListedLights((2, 0)), 2, parse_masks("half-plane", 2, 5))
    default = make("folder", lights, split=split)
    images = [
        (default.read_image(image_entry), default.read_weights(image_entry), default.read_preview(image_entry))
        for image_entry in default.entries
    ]
    entry = FileLayout(file_name=lambda kind, split_name, name, _camera: f"{split_name}/{kind}/{name}")
    monkeypatch.setitem(cast("dict[str, Any]", layouts.LAYOUTS), "folder", entry)
    variant = make("folder", lights, split=split)
    splits = {"train", "test"} if split else {"data"}
    assert {path.parts[-3] for path in folder_of(variant).rglob("*.png")} == splits
    assert list(file_faults(folder_of(variant))) == []
    for image_entry, (image, weights, preview) in zip(variant.entries, images, strict=True):
        np.testing.assert_array_equal(variant.read_image(image_entry), image)
        np.testing.assert_array_equal(variant.read_weights(image_entry), weights)
        assert variant.read_preview(image_entry) == preview
    card = (folder_of(variant) / "README.md").read_text()
    assert all(f"`{split_name}/images/NNNNNN.png`" in card for split_name in splits)
    assert (entry.folder("masks", ["train", "test"]), entry.folder("masks", ["test"])) == (None, "test/masks")


def test_c5_and_ccmnet_read_images(make: Make) -> None:
    """Follows src/dataset.py and `read_image` of src/ops.py of github.com/mahmoudnafifi/C5 and DY112/CCMNet."""
    with pytest.raises(InputError, match="--format png"):
        make("c5", form="tiff")
    data_set = make("c5", split=(0.6, 0.0, 0.4))
    splits = {split: folder_of(data_set) / split for split in ("train", "test")}
    entries = {(str(entry.split), entry.image[:6]): entry for entry in data_set.entries}
    for split, folder in splits.items():
        for file in [file for file in folder.iterdir() if file.name.endswith((".png", ".PNG"))]:
            entry = entries.pop((split, file.name[:6]))
            stored = cv2.imread(str(file), -1)
            assert stored is not None
            np.testing.assert_array_equal(stored[..., ::-1], data_set.read_image(entry))
            metadata = json.loads(Path(f"{file.with_suffix('')}_metadata.json").read_text())
            assert metadata["illuminant_color_raw"] == pytest.approx(entry.truth, abs=1e-9)
            # All images of a camera have the same text after "sensorname_".
            assert str(file.with_suffix("")).split("sensorname_")[-1] == "test_camera"
            for name in ("cm1", "cm2", "fm1", "fm2"):
                assert np.array(metadata[name]).reshape(9).shape == (9,)
            # DNG 1.7.1, chapter 6: ForwardMatrix converts white to the white D50.
            np.testing.assert_allclose(np.sum(metadata["fm2"], axis=1), [0.9642, 1, 0.8249], atol=4e-4)
    assert not entries


READER = """
import hashlib, json, sys
# The import of PyTorch is slow and not needed.
sys.modules["torch"] = None
import webdataset
for sample in webdataset.WebDataset(sys.argv[1:], shardshuffle=False):
    digests = {key: hashlib.sha256(sample[key]).hexdigest() for key in ("png", "preview.jpg")}
    print(json.dumps([sample["__url__"], sample["__key__"], json.loads(sample["json"]), digests]))
"""


def test_webdataset_reads_shards(make: Make) -> None:
    data_set = make("webdataset", split=(0.6, 0.0, 0.4))
    files = make("folder", split=(0.6, 0.0, 0.4))
    lines = (folder_of(files) / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in (line.split("  ") for line in lines)}
    entries = {entry.image: entry for entry in data_set.entries}
    urls = sorted(folder_of(data_set).glob("*/*.tar"))
    # In a separate process, because the package does not close its files.
    read = subprocess.run([sys.executable, "-c", READER, *urls], capture_output=True, text=True, check=True)
    for url, key, metadata, digests in map(json.loads, read.stdout.splitlines()):
        entry = entries.pop(f"{key}.png")
        assert digests == {"png": sums[f"images/{key}.png"], "preview.jpg": sums[f"previews/{key}.jpg"]}
        assert metadata["truth"] == pytest.approx(entry.truth, abs=1e-9)
        assert (metadata["source"], metadata["split"], metadata["width"]) == (entry.source, entry.split, 28)
        assert Path(url).parent.name == entry.split in ("train", "test")
    assert not entries


def test_tar_headers_are_constant(make: Make) -> None:
    data_set = make("webdataset")
    (first, *_) = sorted((folder_of(data_set) / "data").iterdir())
    with tarfile.open(first) as tar:
        headers = tar.getmembers()
    assert [header.name for header in headers[:3]] == ["000000.png", "000000.preview.jpg", "000000.json"]
    assert {(header.uid, header.gid, header.uname, header.mtime, header.mode) for header in headers} == {
        (0, 0, "", 0, 0o644)
    }


@pytest.fixture
def hugging_face(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the package `datasets`, without network and with a temporary cache."""
    cache = tmp_path_factory.mktemp("hugging-face")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(cache))
    monkeypatch.setenv("HF_DATASETS_CACHE", str(cache / "datasets"))
    datasets = import_module("datasets")
    datasets.disable_progress_bars()
    return datasets


def test_hugging_face_reads_shards(make: Make, hugging_face: Any, tmp_path: Path) -> None:
    data_set = make("parquet", split=(0.6, 0.0, 0.4), rendering="colorimetric")
    files = {split: str(folder_of(data_set) / split / "*.parquet") for split in ("train", "test")}
    loaded = hugging_face.load_dataset("parquet", data_files=files, cache_dir=str(tmp_path / "cache"))
    assert set(loaded) == {"train", "test"}
    entries = {entry.image: entry for entry in data_set.entries}
    for split, rows in loaded.items():
        assert type(rows.features["image"]).__name__ == "Image"
        for row in rows:
            entry = entries.pop(row["image"]["path"])
            np.testing.assert_array_equal(decoded(row["image"]["bytes"]), data_set.read_image(entry))
            assert row["preview"].size == (28, 24), "previews are decoded, as pictures"
            assert row["number"] == int(entry.image[:6])
            assert (row["source"], row["split"]) == (entry.source, split) == (entry.source, entry.split)
            assert row["truth"] == pytest.approx(entry.truth, abs=1e-9)
            assert [light["illumination"] for light in row["lights"]] == list(entry.lights)
            details = json.loads(row["details"])
            assert {name: f"{value:g}" if name != "cells" else value for name, value in details.items()} == (
                data_set.details[entry.image]
            )
    assert not entries


@dataclass(frozen=True)
class UnreachableSource:
    """A source on a disk that was removed."""

    name: str = "gone"

    def read(self) -> SourcePicture:
        raise StorageError("the disk is gone")

    def to_json(self) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_closes_incomplete_shard_without_warnings(
    make_lut: MakeLut, tmp_path: Path, layout: Layout, capfd: pytest.CaptureFixture[str]
) -> None:
    # A writer that completes its file when it is deleted would find the stream closed, and pytest would fail.
    with pytest.raises(StorageError):
        generate_dataset(
            make_lut(), tmp_path / "out", (*SCENES, UnreachableSource()), [0], options=DatasetOptions(layout=layout)
        )
    gc.collect()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if layouts.LAYOUTS[name].is_read_by_hugging_face])
def test_hugging_face_reads_splits_by_card(make: Make, hugging_face: Any, tmp_path: Path, layout: Layout) -> None:
    data_set = make(layout, split=(0.6, 0.0, 0.4), previews=False)
    loaded = hugging_face.load_dataset(str(folder_of(data_set)), cache_dir=str(tmp_path / "cache"))
    assert {split: rows.num_rows for split, rows in loaded.items()} == {
        split: images for split, images in data_set.description.splits.items() if images
    }
    assert not {"preview", "details", "masks", "ground_truth"} & set(loaded["train"].column_names)


def maps_in_folder(folder: Path) -> list[bytes]:
    names = ("masks/000003_0.png", "masks/000003_1.png", "ground_truth/000003.png")
    return [(folder / name).read_bytes() for name in names]


def maps_in_tar(folder: Path) -> list[bytes]:
    with tarfile.open(folder / "data" / "000000.tar") as tar:
        streams = [tar.extractfile(f"000003.{name}.png") for name in ("masks_0", "masks_1", "ground_truth")]
        return [stream.read() for stream in streams if stream is not None]


def maps_in_parquet(folder: Path) -> list[bytes]:
    row = import_module("pyarrow.parquet").read_table(folder / "data" / "000000.parquet").to_pylist()[3]
    return [file["bytes"] for file in (*row["masks"], row["ground_truth"])]


# Read both masks and the ground truth map of the fourth image without our reader.
MAPS_OF = {"folder": maps_in_folder, "c5": maps_in_folder, "webdataset": maps_in_tar, "parquet": maps_in_parquet}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_several_lights_in_every_layout(make: Make, make_lut: MakeLut, layout: Layout) -> None:
    choice = SimultaneousLights(ListedLights((2, 0)), 2, parse_masks("half-plane", 2, 5))
    data_set = make(layout, choice)
    entry = data_set.entries[3]
    assert entry.lights == ("2", "0")
    assert len(data_set.entries) == 9
    assert np.sum(entry.truth) == pytest.approx(1)
    text = (folder_of(data_set) / "ground_truth.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in text[7:9]] == ["000003.png", "000003.png"]
    first, second, truth = MAPS_OF[layout](folder_of(data_set))
    weights = np.stack([grey(first), grey(second)], axis=-1) / 65535
    truths = decoded(truth) / 65535
    assert weights.shape == (24, 28, 2)
    np.testing.assert_allclose(weights.sum(axis=2), 1, atol=1e-6)
    np.testing.assert_allclose(data_set.read_weights(entry), weights, atol=1e-7)
    np.testing.assert_allclose(data_set.read_ground_truth_map(entry), truths, atol=1e-7)
    single = make(layout, scenes=2, split=(0.5, 0.5, 0.0))
    for read in (single.read_weights, single.read_ground_truth_map):
        with pytest.raises(InputError, match=r"000002\.png"):
            read(single.entries[2])
    # Where one illuminant has weight 1, the map has its ground truth. The image has the mean over all pixels.
    is_single = weights[..., 0] == 1
    assert 0 < is_single.sum() < is_single.size
    np.testing.assert_allclose(truths[is_single], np.broadcast_to(entry.truths[0], (is_single.sum(), 3)), atol=2e-5)
    whites = np.array(
        [light.white for light in sorted(data_set.description.lights, key=lambda light: -light.illumination)]
    )
    mean = weights.mean(axis=(0, 1)) @ whites
    np.testing.assert_allclose(mean / mean.sum(), entry.truth, atol=1e-6)


def grey(data: bytes) -> npt.NDArray[np.uint16]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, dtype=np.uint16)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_verify_reports_changed_files(make: Make, layout: Layout) -> None:
    folder = folder_of(make(layout, split=(0.5, 0.2, 0.3)))
    verified: list[tuple[int, int]] = []
    assert list(file_faults(folder, lambda count, total: verified.append((count, total)), workers=3)) == []
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    files = len(names - {"SHA256SUMS", *COMPLETED_BY_HAND})
    assert verified == [(count + 1, files) for count in range(files)]
    victim = sorted(path for path in folder.rglob("00000*") if path.suffix != ".jpg")[0]
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(bytes(data))
    (folder / "gt.txt").unlink()
    (folder / "notes.txt").write_text("mine")
    # The authors complete the datasheet.
    (folder / "DATASHEET.md").write_text("answered")
    assert sorted(file_faults(folder)) == sorted(
        [
            f"{victim.relative_to(folder).as_posix()} has changed",
            "gt.txt is missing",
            "notes.txt is not listed in SHA256SUMS; remove it if you do not need it",
        ]
    )
    with pytest.raises(FormatError, match=r"dataset\.json"):
        list(file_faults(folder.parent))


@pytest.mark.parametrize("layout", JOINED)
def test_reports_damaged_shards(make: Make, layout: Layout) -> None:
    data_set = make(layout)
    (file,) = (folder_of(data_set) / "data").glob("000002.*")
    entry = data_set.entries[12]
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with pytest.raises(FormatError, match=rf"{file.name} (is damaged|lacks the listed file 000012)"):
        data_set.read_image(entry)
    file.unlink()
    with pytest.raises(FormatError, match=rf"{file.name}: No such"):
        data_set.read_image(entry)


@pytest.mark.parametrize("layout", ["webdataset", "parquet"])
def test_image_name_without_suffix(make: Make, layout: Layout) -> None:
    """A tar file stores the name, a Parquet file only the number."""
    data_set = make(layout)
    table = folder_of(data_set) / "ground_truth.csv"
    table.write_text(table.read_text().replace("000000.png", "000000"))
    opened = open_dataset(folder_of(data_set))
    if layout == "webdataset":
        with pytest.raises(FormatError, match="lacks the listed file 000000"):
            opened.read_image(opened.entries[0])
    else:
        np.testing.assert_array_equal(opened.read_image(opened.entries[0]), data_set.read_image(data_set.entries[0]))
    np.testing.assert_array_equal(opened.read_image(opened.entries[1]), data_set.read_image(data_set.entries[1]))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_refuses_invalid_image_names(make: Make, layout: Layout) -> None:
    table = folder_of(make(layout, scenes=2)) / "ground_truth.csv"
    text = table.read_text()
    for name in ("000000../outside/canary.png", "../000000.png", "٠٠٠٠٠٠.png", "0.0/0.png"):
        table.write_text(text.replace("000000.png", name), encoding="utf-8")
        with pytest.raises(FormatError):
            open_dataset(table.parent)
    table.write_text(text.replace("000000.png", "000000"), encoding="utf-8")
    assert open_dataset(table.parent).entries[0].image == "000000"


def test_refuses_invalid_image_numbers(make: Make) -> None:
    table = folder_of(make("folder", scenes=2)) / "ground_truth.csv"
    text = table.read_text()
    for name in ("0.png", "000000.tiff", "1" * 11 + ".png", "1" * 5000 + ".png"):
        table.write_text(text.replace("\n000001.png,", f"\n{name},"))
        with pytest.raises(FormatError):
            open_dataset(table.parent)


def test_parquet_reports_missing_library(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def find_spec(name: str) -> None:
        del name

    monkeypatch.setattr("generator.dataset.layouts.find_spec", find_spec)
    with pytest.raises(InputError, match=r"pip install pyarrow"):
        make("parquet")
