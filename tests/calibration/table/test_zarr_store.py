"""Published tables: what was fetched is what was published, byte by byte, or is refused."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from acquisition.lights.illuminations import Illumination
from calibration.table.lut import Lut, open_lut
from calibration.table.provenance import Provenance
from calibration.table.source_frames import SourceFrame
from calibration.table.writer import LutWriter
from calibration.table.zarr_store import SHARD_LIGHTS, fetch, publish
from drivers.presenter import Colour
from foundation.errors import FormatError, InputError, StorageError

LIGHTS = SHARD_LIGHTS + 3


@pytest.fixture
def lut(tmp_path: Path) -> Lut:
    """Return a table with more lights than one object holds."""
    folder = tmp_path / "lut"
    folder.mkdir()
    writer = LutWriter(folder, LIGHTS, 64, 25)
    rng = np.random.default_rng(3)
    for light in range(LIGHTS):
        writer.put(light, rng.poisson(500 + light, (64, 25, 3)).astype(np.uint16))
    lights = [Illumination(light, "uniform", None, Colour(9, 8, light)) for light in range(LIGHTS)]
    white: npt.NDArray[np.float64] = 900.0 + np.arange(3.0 * LIGHTS).reshape(LIGHTS, 3)
    known = Provenance(
        camera="Šestica", bits=2, white_level=8000, session_sha256="1", chart_sha256="2", software="test 1"
    )
    writer.finish(lights, white, known, [SourceFrame("light", 0, "a.CR2", "3" * 64)])
    return open_lut(folder)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("place", ["{}/published", "memory://bucket/published"])
def test_there_and_back(lut: Lut, tmp_path: Path, place: str) -> None:
    MemoryFileSystem.store.clear()
    url = place.format(tmp_path)
    steps: list[tuple[int, int]] = []
    publish(lut, url, lambda done, total: steps.append((done, total)))
    assert steps == [(SHARD_LIGHTS, LIGHTS), (LIGHTS, LIGHTS)]
    back = fetch(url, tmp_path / "back")
    assert files(tmp_path / "back") == files(lut.folder)
    assert back.sha256 == lut.sha256
    np.testing.assert_array_equal(back.samples, lut.samples)
    with pytest.raises(InputError, match="already holds a table; name another place"):
        publish(lut, url)
    with pytest.raises(InputError, match="back already exists; name another place for the table"):
        fetch(url, tmp_path / "back")


def test_one_light_a_chunk_and_32_an_object(lut: Lut, tmp_path: Path) -> None:
    publish(lut, str(tmp_path / "published"))
    described = json.loads((tmp_path / "published" / "zarr.json").read_text())
    assert (described["zarr_format"], described["data_type"], described["shape"]) == (3, "uint16", [LIGHTS, 64, 25, 3])
    assert described["chunk_grid"]["configuration"]["chunk_shape"] == [32, 64, 25, 3]
    (sharding,) = described["codecs"]
    assert sharding["name"] == "sharding_indexed"
    assert sharding["configuration"]["chunk_shape"] == [1, 64, 25, 3]
    blosc = sharding["configuration"]["codecs"][-1]
    assert (blosc["name"], blosc["configuration"]["cname"], blosc["configuration"]["shuffle"]) == (
        "blosc",
        "zstd",
        "bitshuffle",
    )
    objects = [path for path in (tmp_path / "published" / "c").rglob("*") if path.is_file()]
    assert len(objects) == 2


def test_what_was_never_finished_is_published_anew(lut: Lut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url = str(tmp_path / "published")

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish(lut, url, stop)
    with pytest.raises(FormatError, match="holds no table, or one that was never finished"):
        fetch(url, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    publish(lut, url)
    assert files(fetch(url, tmp_path / "back").folder) == files(lut.folder)


def test_nothing_else_is_overwritten(lut: Lut, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="mine already holds something else; name another place"):
        publish(lut, str(tmp_path / "mine"))
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"


def test_what_changed_on_the_way_is_refused(lut: Lut, tmp_path: Path) -> None:
    url = str(tmp_path / "published")
    publish(lut, url)
    array = import_module("zarr").open_array(url, mode="r+")
    array[7, 5, 4, 1] = 12345
    with pytest.raises(FormatError, match=r"the samples of light 7 from .* are not those that were measured"):
        fetch(url, tmp_path / "back")
    (shard,) = (path for path in (tmp_path / "published" / "c" / "1").rglob("*") if path.is_file())
    data = bytearray(shard.read_bytes())
    data[100:200] = bytes(100)
    shard.write_bytes(bytes(data))
    array[7] = np.asarray(lut.samples[7])
    with pytest.raises(FormatError, match=rf"(light {SHARD_LIGHTS} of|of light {SHARD_LIGHTS} from) "):
        fetch(url, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_what_is_not_there_or_not_installed(lut: Lut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FormatError, match="nowhere holds no table"):
        fetch(str(tmp_path / "nowhere"), tmp_path / "back")
    with pytest.raises((InputError, StorageError), match="nosuch://bucket"):
        publish(lut, "nosuch://bucket/table")

    def find_spec(name: str) -> None:
        del name

    monkeypatch.setattr("calibration.table.zarr_store.find_spec", find_spec)
    with pytest.raises(InputError, match=r"need zarr; install it with: pip install zarr"):
        publish(lut, str(tmp_path / "published"))
