"""Data sets, pictures and LUTs in S3: a server of moto answers the HTTP requests of s3fs.

Files in memory (memory://) have more methods than those of s3fs, and no cached listings.
"""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest

from calibration.table.lut import Lut, open_lut
from calibration.table.zarr_store import fetch, publish
from foundation.errors import InputError, StorageError
from generator.dataset.making import Workers, generate_dataset, make_dataset, make_share
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.reader import file_faults, open_dataset
from generator.dataset.records import Layout
from generator.lights.lighting import ListedLights
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import find_pictures
from generator.stores import open_store
from generator.training.crops import Crops
from generator.training.gallery import save_gallery
from tests.generator.conftest import lut_in

pytestmark = pytest.mark.slow

LAYOUTS = get_args(Layout)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Return the address of an S3 server in this process."""
    moto: Any = import_module("moto.server")
    running = moto.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    yield f"http://{host}:{port}"
    running.stop()


def use_server(address: str, patch: pytest.MonkeyPatch) -> None:
    """Set the address and the keys as users do."""
    patch.setenv("AWS_ENDPOINT_URL", address)
    patch.setenv("AWS_ACCESS_KEY_ID", "key")
    patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    patch.setenv("AWS_MAX_ATTEMPTS", "1")
    import_module("s3fs").S3FileSystem.clear_instance_cache()


@pytest.fixture
def bucket(server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the URL of an empty bucket."""
    use_server(server, monkeypatch)
    import_module("requests").post(f"{server}/moto-api/reset", timeout=60)
    import_module("s3fs").S3FileSystem().mkdir("bucket")
    return "s3://bucket"


@pytest.fixture
def lut(tmp_path: Path) -> Lut:
    return lut_in(tmp_path / "lut")


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Return a folder with five pictures."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    rng = np.random.default_rng(1)
    for number in range(5):
        cv2.imwrite(str(folder / f"{number}.png"), rng.integers(0, 256, (24, 32, 3)).astype(np.uint8))
    return folder


def upload(folder: Path, url: str) -> str:
    for path in folder.iterdir():
        open_store(url).put(path.name, path.read_bytes())
    return url


def hashes(location: str | Path) -> dict[str, str]:
    store = open_store(location)
    return {name: hashlib.sha256(store.get(name)).hexdigest() for name in store.names()}


def command(name: str, *arguments: object) -> int:
    return int(import_module(f"{name}.cli").main([*map(str, arguments)]))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_data_set_in_s3_is_equal_to_folder(
    bucket: str, lut: Lut, pictures: Path, tmp_path: Path, layout: Layout, capsys: pytest.CaptureFixture[str]
) -> None:
    options = DatasetOptions(layout=layout, shard_images=4, split=(0.5, 0.25, 0.25))
    local = generate_dataset(lut, tmp_path / "out", find_pictures(pictures), [0, 3], options=options)
    remote_pictures = find_pictures(upload(pictures, f"{bucket}/pictures"))
    remote = generate_dataset(lut, f"{bucket}/out", remote_pictures, [0, 3], options=options, workers=2)
    assert hashes(f"{bucket}/out") == hashes(tmp_path / "out")
    assert (remote.entries, remote.sources, remote.details) == (local.entries, local.sources, local.details)
    for entry in local.entries:
        np.testing.assert_array_equal(remote.read_image(entry), local.read_image(entry))
        assert remote.read_preview(entry) == local.read_preview(entry)
    assert command("generator", "--verify", f"{bucket}/out") == 0
    open_store(f"{bucket}/out").put("gt.txt", b"1 0 0\n")
    capsys.readouterr()
    assert command("generator", "--verify", f"{bucket}/out") == 4
    assert "gt.txt has changed" in capsys.readouterr().out


def test_commands_read_data_set_in_s3(bucket: str, lut: Lut, pictures: Path, tmp_path: Path) -> None:
    sources = upload(pictures, f"{bucket}/pictures")
    assert (
        command("generator", lut.folder, f"{bucket}/out", "--sources", sources, "--light", "0,1", "--workers", 2) == 0
    )
    assert (
        command("generator", lut.folder, tmp_path / "same", "--lights-of", f"{bucket}/out", "--sources", sources) == 0
    )
    again = open_dataset(tmp_path / "same").entries
    assert [entry.truth for entry in again] == [entry.truth for entry in open_dataset(f"{bucket}/out").entries]
    for place, folder in ((f"{bucket}/out", "remote"), (tmp_path / "same", "local")):
        assert command("evaluation", "run", place, "--out", tmp_path / folder, "--method", "gray-world") == 0
    assert (tmp_path / "remote" / "errors.csv").read_text() == (tmp_path / "local" / "errors.csv").read_text()
    assert command("evaluation", "cv", "constant-light", f"{bucket}/out", "--folds", 2) == 0
    sheet = tmp_path / "sheet.png"
    assert command("generator", "--verify", f"{bucket}/out", "--contact-sheet", sheet) == 0
    assert cv2.imread(str(sheet)) is not None


def test_masks_and_crops_from_s3(bucket: str, lut: Lut, pictures: Path, tmp_path: Path) -> None:
    options = ("--light", "0,1", "--lights-per-image", 2, "--workers", 2)
    sources = upload(pictures, f"{bucket}/pictures")
    assert command("generator", lut.folder, f"{bucket}/mixed", "--sources", sources, *options) == 0
    assert command("generator", lut.folder, tmp_path / "mixed", "--sources", pictures, *options) == 0
    remote, local = open_dataset(f"{bucket}/mixed"), open_dataset(tmp_path / "mixed")
    for entry in local.entries:
        np.testing.assert_array_equal(remote.read_weights(entry), local.read_weights(entry))
        np.testing.assert_array_equal(remote.read_ground_truth_map(entry), local.read_ground_truth_map(entry))
    batches = [
        Crops(lut, save_gallery(find_pictures(place), tmp_path / name), (8, 8)).batch([0, 1])
        for name, place in (("remote", sources), ("local", str(pictures)))
    ]
    np.testing.assert_array_equal(batches[0].images, batches[1].images)


def test_dask_cluster_completes_share_in_s3(bucket: str, lut: Lut, pictures: Path, tmp_path: Path) -> None:
    """The workers write records after this process has listed those of an earlier share."""
    options = DatasetOptions(layout="webdataset", shard_images=4)
    plan = Plan(lut, find_pictures(upload(pictures, f"{bucket}/pictures")), ListedLights((0, 3)), 0, options)
    assert make_share(plan, f"{bucket}/out", (0, 3)) == (1, 3)
    make_dataset(plan, f"{bucket}/out", Workers("dask", 2))
    generate_dataset(lut, tmp_path / "out", find_pictures(pictures), [0, 3], options=options)
    assert hashes(f"{bucket}/out") == hashes(tmp_path / "out")


def test_published_lut_in_s3(bucket: str, lut: Lut, tmp_path: Path) -> None:
    publish(lut, f"{bucket}/lut")
    assert hashes(fetch(f"{bucket}/lut", tmp_path / "back").folder) == hashes(lut.folder)
    with pytest.raises(InputError, match="already has a LUT"):
        publish(lut, f"{bucket}/lut")
    with pytest.raises(InputError, match="build-lut fetch"):
        open_lut(Path(f"{bucket}/lut"))


@pytest.fixture(params=["bucket missing", "wrong key", "server gone"])
def fault(request: pytest.FixtureRequest, server: str, bucket: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return an address that cannot be used, and the remedies that a message must contain."""
    auth = f"{server}/moto-api/reset-auth"
    if request.param == "bucket missing":
        yield "s3://nowhere: address"
    elif request.param == "wrong key":
        import_module("requests").post(auth, data=b"0", timeout=60)
        yield f"{bucket}: AWS_ACCESS_KEY_ID"
        import_module("requests").post(auth, data=b"inf", timeout=60)
    else:
        with socket.socket() as unused:
            unused.bind(("127.0.0.1", 0))
            use_server(f"http://127.0.0.1:{unused.getsockname()[1]}", monkeypatch)
            yield f"{bucket}: AWS_ENDPOINT_URL"


def test_unusable_store_is_reported_with_remedy(
    fault: str, lut: Lut, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url, remedy = fault.split(": ")
    arguments = {
        "generator": (
            (lut.folder, f"{url}/out", "--sources", pictures, "--light", 0),
            (lut.folder, tmp_path / "out", "--sources", f"{url}/pictures"),
            (lut.folder, tmp_path / "out", "--sources", pictures, "--lights-of", f"{url}/out"),
            ("--verify", f"{url}/out"),
        ),
        "evaluation": (("run", f"{url}/out"),),
        "calibration": (("publish", lut.folder, f"{url}/lut"), ("fetch", f"{url}/lut", tmp_path / "back")),
    }
    for name, lines in arguments.items():
        for line in lines:
            assert command(name, *line) in (InputError.exit_code, StorageError.exit_code)
            (error,) = [text for text in capsys.readouterr().err.splitlines() if text.startswith("error: ")]
            assert remedy in error, error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("layout", ["webdataset", "parquet"])
def test_images_of_a_shard_are_read_once(
    bucket: str, lut: Lut, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By default, s3fs reads 50 MB ahead for each image."""
    options = DatasetOptions(layout=layout, previews=False)
    dataset = generate_dataset(lut, f"{bucket}/out", random_scenes(24, 200, 200), [0], options=options)
    files: Any = import_module("s3fs").core.S3File
    read, original = list[int](), files._fetch_range

    def fetch_range(file: object, start: int, end: int) -> bytes:
        read.append(end - start)
        return bytes(original(file, start, end))

    monkeypatch.setattr(files, "_fetch_range", fetch_range)
    for entry in dataset.entries:
        dataset.read_image(entry)
    size = len(open_store(f"{bucket}/out").get(f"data/000000.{'tar' if layout == 'webdataset' else 'parquet'}"))
    assert size / 2 < sum(read) < 1.3 * size
    # Another data set of the same name: no bytes of the first one are used.
    open_store(f"{bucket}/out").remove("")
    other = generate_dataset(lut, f"{bucket}/out", random_scenes(24, 200, 200, 5), [0], options=options)
    assert dataset.read_image(other.entries[0]).tobytes() == other.read_image(other.entries[0]).tobytes()
    assert list(file_faults(f"{bucket}/out")) == []


def test_server_that_fails_while_a_list_is_read(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store(bucket)
    store.put("list", b"line\n" * 10)

    def hang_up(*_: object) -> bytes:
        raise ConnectionResetError("the server hung up")

    monkeypatch.setattr(import_module("s3fs").core.S3File, "_fetch_range", hang_up)
    with store.open("list") as stream, pytest.raises(StorageError, match="AWS_ENDPOINT_URL"):
        stream.readline()
