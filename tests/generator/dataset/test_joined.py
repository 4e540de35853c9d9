"""Members of shards in one file: names, times and values, as they were."""

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


def made(lut: Lut, out: Path, scenes: Any, lights: LightChoice | list[int], **options: Any) -> Dataset:
    given: dict[str, Any] = {"previews": False, "rendering": "codes", **options}
    return generate_dataset(lut, out, scenes, lights, seed=3, options=DatasetOptions(**given))


@pytest.mark.parametrize("layout", ["webdataset", "parquet"])
def test_members_of_joined_files(layout: str, lut: Lut, tmp_path: Path, pinned: Pinned) -> None:
    masks = SimultaneousLights(RandomLights(2, 5, 1), 2, parse_masks("spots", 2, 1))
    options: dict[str, Any] = {"layout": layout, "shard_images": 2, "split": (0.4, 0.3, 0.3)}
    variation = variation_of(lut, parse_exposure("stops:low=-1,high=1"))
    made(lut, tmp_path / "out", random_scenes(5, 13, 11), masks, variation=variation, uncertainty=True, **options)
    found: dict[str, Any] = {}
    for path in sorted((tmp_path / "out").glob("*/*.*")):
        if path.suffix == ".tar":
            with tarfile.open(path) as tar:
                members = [(one, tar.extractfile(one)) for one in tar.getmembers()]
                found[f"{path.parent.name}/{path.name}"] = {
                    one.name: [one.mode, one.mtime, _content(one.name, data.read() if data else b"")]
                    for one, data in members
                }
        elif path.suffix == ".parquet":
            parquet = pytest.importorskip("pyarrow.parquet")
            table = parquet.read_table(path)
            found[f"{path.parent.name}/{path.name}"] = _plain(table.to_pylist())
        else:
            found[f"{path.parent.name}/{path.name}"] = path.read_text().split()
    pinned(f"members of {layout}", found)


def _content(name: str, data: bytes) -> Any:
    return json.loads(data) if name.endswith(".json") else _of_values(data)


def _of_values(data: bytes) -> Any:
    """Return the values of a PNG: maps are packed by a library."""
    from generator.files import decode_png

    return decode_png(data).tobytes()


def _plain(value: Any) -> Any:
    match value:
        case bytes():
            return _of_values(value)
        case dict():
            return {key: _plain(one) for key, one in value.items()}
        case list():
            return [_plain(one) for one in value]
        case str():
            return plain_text(value)
        case _:
            return value
