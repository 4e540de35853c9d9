"""Published LUTs: a fetched LUT is identical to the published one, or it is refused."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from calibration.cli import main
from calibration.table.lut import Lut, Provenance, SourceFrame, open_lut
from calibration.table.writing import LutWriter
from calibration.table.zarr_store import SHARD_LIGHTS, fetch, publish
from drivers.presenter import Colour
from experiment.lights import Illuminant
from foundation.errors import FormatError, InputError, StorageError

pytestmark = pytest.mark.slow

LIGHTS = SHARD_LIGHTS + 3


@pytest.fixture
def lut(tmp_path: Path) -> Lut:
    """Return a LUT with more illuminants than one object holds."""
    folder = tmp_path / "lut"
    folder.mkdir()
    writer = LutWriter(folder, LIGHTS, 64, 25)
    rng = np.random.default_rng(3)
    for light in range(LIGHTS):
        writer.put(light, rng.poisson(500 + light, (64, 25, 3)).astype(np.uint16))
    lights = [Illuminant(light, "uniform", None, Colour(9, 8, light)) for light in range(LIGHTS)]
    white: npt.NDArray[np.float64] = 900.0 + np.arange(3.0 * LIGHTS).reshape(LIGHTS, 3)
    provenance = Provenance(
        camera="Šestica", bits=2, white_level=8000, session_sha256="1", chart_sha256="2", software="test 1"
    )
    writer.finish(lights, white, provenance, [SourceFrame("light", 0, "a.CR2", "3" * 64)])
    return open_lut(folder)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("address", ["{}/published", "memory://bucket/published"])
def test_fetches_published_lut(lut: Lut, tmp_path: Path, address: str) -> None:
    MemoryFileSystem.store.clear()
    url = address.format(tmp_path)
    steps: list[tuple[int, int]] = []
    publish(lut, url, lambda done, total: steps.append((done, total)))
    assert steps == [(SHARD_LIGHTS, LIGHTS), (LIGHTS, LIGHTS)]
    fetched = fetch(url, tmp_path / "back")
    assert files(tmp_path / "back") == files(lut.folder)
    assert fetched.sha256 == lut.sha256
    np.testing.assert_array_equal(fetched.samples, lut.samples)
    with pytest.raises(InputError):
        publish(lut, url)
    with pytest.raises(InputError):
        fetch(url, tmp_path / "back")


def test_stores_one_illuminant_per_chunk_and_32_per_object(lut: Lut, tmp_path: Path) -> None:
    publish(lut, str(tmp_path / "published"))
    metadata = json.loads((tmp_path / "published" / "zarr.json").read_text())
    assert (metadata["zarr_format"], metadata["data_type"], metadata["shape"]) == (3, "uint16", [LIGHTS, 64, 25, 3])
    assert metadata["chunk_grid"]["configuration"]["chunk_shape"] == [32, 64, 25, 3]
    (sharding,) = metadata["codecs"]
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


def test_replaces_unfinished_publication(lut: Lut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url = str(tmp_path / "published")

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish(lut, url, stop)
    with pytest.raises(FormatError):
        fetch(url, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    publish(lut, url)
    assert files(fetch(url, tmp_path / "back").folder) == files(lut.folder)


def test_refuses_to_overwrite_other_files(lut: Lut, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(InputError):
        publish(lut, str(tmp_path / "mine"))
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"


def test_refuses_changed_samples(lut: Lut, tmp_path: Path) -> None:
    url = str(tmp_path / "published")
    publish(lut, url)
    array = import_module("zarr").open_array(url, mode="r+")
    array[7, 5, 4, 1] = 12345
    with pytest.raises(FormatError, match="illuminant 7"):
        fetch(url, tmp_path / "back")
    (shard,) = (path for path in (tmp_path / "published" / "c" / "1").rglob("*") if path.is_file())
    data = bytearray(shard.read_bytes())
    data[100:200] = bytes(100)
    shard.write_bytes(bytes(data))
    array[7] = np.asarray(lut.samples[7])
    with pytest.raises(FormatError, match=rf"illuminant {SHARD_LIGHTS} of "):
        fetch(url, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_refuses_missing_store_or_library(lut: Lut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FormatError):
        fetch(str(tmp_path / "nowhere"), tmp_path / "back")
    with pytest.raises((InputError, StorageError), match="nosuch://bucket"):
        publish(lut, "nosuch://bucket/table")

    def find_spec(name: str) -> None:
        del name

    monkeypatch.setattr("calibration.table.zarr_store.find_spec", find_spec)
    with pytest.raises(InputError, match="pip install zarr"):
        publish(lut, str(tmp_path / "published"))


def edit(published: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = published / "zarr.json"
    metadata = json.loads(path.read_text())
    change(metadata)
    path.write_text(json.dumps(metadata))


def change_ground_truth(metadata: dict[str, Any]) -> None:
    files = metadata["attributes"]["files"]
    files["illuminations.csv"] = files["illuminations.csv"].replace("900.000000", "990.000000", 1)


def change_all_hashes(metadata: dict[str, Any]) -> None:
    """Change the ground truth and all hashes that depend on it: only a hash from elsewhere detects this."""
    files = metadata["attributes"]["files"]
    for changed_file in ("illuminations.csv", "lut.json"):
        old = hashlib.sha256(files[changed_file].encode()).hexdigest()
        if changed_file == "illuminations.csv":
            change_ground_truth(metadata)
        new = hashlib.sha256(files[changed_file].encode()).hexdigest()
        for name in ("lut.json", "SHA256SUMS"):
            old_text = files["lut.json"]
            files[name] = files[name].replace(old, new)
            if name == "lut.json" and changed_file == "illuminations.csv":
                files["SHA256SUMS"] = files["SHA256SUMS"].replace(
                    hashlib.sha256(old_text.encode()).hexdigest(), hashlib.sha256(files[name].encode()).hexdigest()
                )


def test_refuses_edited_ground_truth(lut: Lut, tmp_path: Path) -> None:
    publish(lut, str(tmp_path / "published"))
    edit(tmp_path / "published", change_ground_truth)
    with pytest.raises(FormatError, match=r"illuminations\.csv"):
        fetch(str(tmp_path / "published"), tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_compares_expected_hash(lut: Lut, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url = str(tmp_path / "published")
    assert main(["publish", str(lut.folder), url]) == 0
    assert f"{LIGHTS} illuminants" in capsys.readouterr().out
    assert main(["info", str(lut.folder)]) == 0
    assert f"LUT:             {lut.sha256}" in capsys.readouterr().out
    assert main(["fetch", url, str(tmp_path / "expected"), "--expect", lut.sha256]) == 0
    assert "it is the expected LUT" in capsys.readouterr().out
    assert main(["fetch", url, str(tmp_path / "unknown")]) == 0
    printed = capsys.readouterr().out
    assert f"Compare its hash, {lut.sha256}, with the expected hash" in printed
    assert "all files match the hashes in the LUT" in printed
    edit(tmp_path / "published", change_all_hashes)
    # All files are consistent: only a hash from elsewhere detects the change.
    assert main(["fetch", url, str(tmp_path / "other")]) == 0
    assert open_lut(tmp_path / "other").white[0, 0] == 990
    capsys.readouterr()
    assert main(["fetch", url, str(tmp_path / "refused"), "--expect", lut.sha256]) == 2
    assert "is another LUT" in capsys.readouterr().err
    assert not (tmp_path / "refused").exists()
    assert main(["fetch", url, str(tmp_path / "refused"), "--expect", lut.sha256[:12]]) == 2
    assert "is not the hash of a LUT" in capsys.readouterr().err


Change = Callable[[dict[str, Any]], object]

CLAIMS: list[tuple[Change, str]] = [
    (lambda data: data.update(shape=[10**6, 64, 25, 3]), "array of shape"),
    (lambda data: data.update(shape=[LIGHTS, 64, "25", 3]), "array of shape|cannot read|header of the samples"),
    (lambda data: data.update(data_type="float64"), "array of shape"),
    (lambda data: data["codecs"][0]["configuration"]["codecs"].append({"name": "numcodecs.bz2"}), "array of shape"),
    (lambda data: data["codecs"][0]["configuration"].update(chunk_shape=[LIGHTS, 64, 25, 3]), "array of shape"),
    (lambda data: data["attributes"].update(files=[1]), "has no files attribute"),
    (lambda data: data["attributes"]["files"].update({"../x": "y"}), "not a file of a LUT"),
    (lambda data: data["attributes"]["files"].pop("lut.json"), "lacks lut.json"),
    (lambda data: data["attributes"]["files"].pop("SHA256SUMS"), "lacks SHA256SUMS"),
    (lambda data: data["attributes"].update(head="AAAA"), "the header of the samples"),
    (lambda data: data["attributes"].update(whole="no"), "is not a complete LUT"),
    (lambda data: data["attributes"].update(version=[2]), r"has version \[2\]"),
]


@pytest.mark.parametrize(("change", "fault"), CLAIMS)
def test_refuses_inconsistent_metadata(lut: Lut, tmp_path: Path, change: Change, fault: str) -> None:
    publish(lut, str(tmp_path / "published"))
    edit(tmp_path / "published", change)
    with pytest.raises(FormatError, match=fault):
        fetch(str(tmp_path / "published"), tmp_path / "back")
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("lut", "published")] == []


def test_refuses_lut_that_does_not_fit_disk(lut: Lut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(lut, str(tmp_path / "published"))

    def nearly_full(place: Path) -> SimpleNamespace:
        return SimpleNamespace(free=lut.samples.nbytes)

    monkeypatch.setattr("calibration.table.zarr_store.shutil.disk_usage", nearly_full)
    with pytest.raises(StorageError):
        fetch(str(tmp_path / "published"), tmp_path / "back")


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_refuses_irregular_files_in_store(lut: Lut, tmp_path: Path, kind: str) -> None:
    publish(lut, str(tmp_path / "published"))
    shard = next(path for path in (tmp_path / "published" / "c").rglob("*") if path.is_file())
    shard.unlink()
    if kind == "pipe":
        os.mkfifo(shard)
    else:
        shard.symlink_to(lut.folder / "samples.npy")
    with pytest.raises(FormatError, match=f"{kind}, expected a regular file"):
        fetch(str(tmp_path / "published"), tmp_path / "back")


def test_does_not_publish_damaged_samples(lut: Lut, tmp_path: Path) -> None:
    with (lut.folder / "samples.npy").open("r+b") as stream:
        stream.seek(-1, 2)
        stream.write(b"\x7f")
    with pytest.raises(FormatError, match=f"illuminant {LIGHTS - 1} "):
        publish(open_lut(lut.folder), str(tmp_path / "published"))
    with pytest.raises(FormatError):
        fetch(str(tmp_path / "published"), tmp_path / "back")
