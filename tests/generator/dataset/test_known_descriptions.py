"""Contact sheets and members of known datasets, as they were before."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.table.lut import Lut
from generator.dataset.contact_sheet import _draw as draw  # before it is painted
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import LightChoice, ListedLights, RandomLights, mixture_of
from generator.masks.making import parse_masks
from generator.pictures.random_scenes import RandomScene, random_scenes
from generator.variation.variation import parse_exposure, varied_by
from tests.generator.dataset.known import plain_text, table_in
from tests.pinned import Pinned
from tests.pinned.drawn import drawn

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lut(tmp_path_factory: pytest.TempPathFactory) -> Lut:
    return table_in(tmp_path_factory.mktemp("described") / "lut")


def made(lut: Lut, out: Path, scenes: Any, lights: LightChoice | list[int], **options: Any) -> Dataset:
    given: dict[str, Any] = {"previews": False, "rendering": "codes", **options}
    return generate_dataset(lut, out, scenes, lights, seed=3, options=DatasetOptions(**given))


SHEETS: dict[str, tuple[Any, Any, tuple[int, int]]] = {
    "of one": (random_scenes(1, 24, 16), [1], (6, 5)),
    "in a grid": (random_scenes(11, 24, 16), RandomLights(1, 5, 2), (4, 5)),
    "in a grid, one light": (random_scenes(7, 16, 24), [4], (8, 3)),
    "in rows, lights in common": (random_scenes(4, 24, 16), ListedLights((0, 3, mixture_of({1: 1, 2: 3}))), (3, 2)),
    "in rows, lights of their own": (random_scenes(3, 16, 24), RandomLights(2, 5, 5), (6, 5)),
    "of sizes that differ": ((RandomScene(0, 40, 10, 0), RandomScene(1, 9, 30, 0)), RandomLights(1, 5, 3), (6, 5)),
    "of two lights": (
        random_scenes(2, 24, 16),
        SimultaneousLights(RandomLights(4, 5, 1), 2, parse_masks("half-plane", 2, 1)),
        (6, 5),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SHEETS)
def test_contact_sheets(name: str, lut: Lut, tmp_path: Path, pinned: Pinned) -> None:
    scenes, lights, (rows, columns) = SHEETS[name]
    sheet = draw(made(lut, tmp_path / "out", scenes, lights), rows, columns)
    places = np.array([axes.get_position().bounds for axes in sheet.axes])
    shown = drawn(sheet)
    colours = [patch.get_facecolor() for axes in sheet.axes for patch in axes.patches]
    # A preview's code may be off by one where another processor rounds a power otherwise.
    found = {"size": shown["size"], "places": places, "pictures": shown.get("AxesImage", []), "colours": colours}
    pinned(f"contact sheet {name}", found, same=1e-4)


@pytest.mark.parametrize("layout", ["webdataset", "parquet"])
def test_members_of_joined_files(layout: str, lut: Lut, tmp_path: Path, pinned: Pinned) -> None:
    masks = SimultaneousLights(RandomLights(2, 5, 1), 2, parse_masks("spots", 2, 1))
    options: dict[str, Any] = {"layout": layout, "shard_images": 2, "split": (0.4, 0.3, 0.3)}
    variation = varied_by(lut, parse_exposure("stops:low=-1,high=1"))
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


def test_lists_of_datasets_are_read(lut: Lut, tmp_path: Path, pinned: Pinned) -> None:
    dataset = made(lut, tmp_path / "out", random_scenes(3, 9, 8), [0, 3], split=(0.5, 0.25, 0.25))
    pinned("lists of a dataset", [dataset.entries, dataset.sources, dataset.details])
