"""Pinned content of tar and Parquet shards."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path
from typing import Any

import pytest

from calibration.table.lut import Lut
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import LightChoice, RandomLights
from generator.masks.making import parse_masks
from generator.pictures.random_scenes import random_scenes
from generator.variation.variation import parse_exposure, variation_of
from tests.generator.dataset.known import plain_text, table_in
from tests.pinned import Pinned

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lut(tmp_path_factory: pytest.TempPathFactory) -> Lut:
    return table_in(tmp_path_factory.mktemp("described") / "lut")


def make_data_set(lut: Lut, out: Path, scenes: Any, lights: LightChoice | list[int], **options: Any) -> Dataset:
    keywords: dict[str, Any] = {"previews": False, "rendering": "codes", **options}
    return generate_dataset(lut, out, scenes, lights, seed=3, options=DatasetOptions(**keywords))


@pytest.mark.parametrize("layout", ["webdataset", "parquet"])
def test_pinned_members(layout: str, lut: Lut, tmp_path: Path, pinned: Pinned) -> None:
    masks = SimultaneousLights(RandomLights(2, 5, 1), 2, parse_masks("spots", 2, 1))
    options: dict[str, Any] = {"layout": layout, "shard_images": 2, "split": (0.4, 0.3, 0.3)}
    variation = variation_of(lut, parse_exposure("stops:low=-1,high=1"))
    make_data_set(
        lut, tmp_path / "out", random_scenes(5, 13, 11), masks, variation=variation, uncertainty=True, **options
    )
    content: dict[str, Any] = {}
    for path in sorted((tmp_path / "out").glob("*/*.*")):
        if path.suffix == ".tar":
            with tarfile.open(path) as tar:
                members = [(member, tar.extractfile(member)) for member in tar.getmembers()]
                content[f"{path.parent.name}/{path.name}"] = {
                    member.name: [member.mode, member.mtime, _content(member.name, data.read() if data else b"")]
                    for member, data in members
                }
        elif path.suffix == ".parquet":
            parquet = pytest.importorskip("pyarrow.parquet")
            table = parquet.read_table(path)
            content[f"{path.parent.name}/{path.name}"] = _plain_values(table.to_pylist())
        else:
            content[f"{path.parent.name}/{path.name}"] = path.read_text().split()
    pinned(f"members of {layout}", content)


def _content(name: str, data: bytes) -> Any:
    return json.loads(data) if name.endswith(".json") else _png_values(data)


def _png_values(data: bytes) -> Any:
    # Values are pinned instead of bytes, because maps are packed by a library with different versions.
    from generator.files import decode_png

    return decode_png(data).tobytes()


def _plain_values(value: Any) -> Any:
    match value:
        case bytes():
            return _png_values(value)
        case dict():
            return {key: _plain_values(member) for key, member in value.items()}
        case list():
            return [_plain_values(member) for member in value]
        case str():
            return plain_text(value)
        case _:
            return value
