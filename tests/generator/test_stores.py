"""Object stores: equal data sets, resumption after failures, and secrets in addresses."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Generator, Iterator
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, get_args

import cv2
import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from fsspec.registry import register_implementation

from foundation.errors import FormatError, InputError, StorageError
from generator.dataset.making import generate_dataset, make_dataset, make_share, open_workplace
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.reader import file_faults, open_dataset
from generator.dataset.records import Layout
from generator.dataset.shards import make_shard_on_worker
from generator.lights.lighting import ListedLights
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import find_pictures
from generator.stores import LocalStore, RemoteStore, open_store
from tests.generator.conftest import MakeLut
from tests.generator.groups import grouped

if TYPE_CHECKING:
    from calibration.table.lut import Lut


class FolderedStore(MemoryFileSystem):
    """A store that needs existing folders, as FTP servers do."""

    protocol = "ftp"
    store: dict[str, object] = {}  # noqa: RUF012  as fsspec has it
    pseudo_dirs = [""]  # noqa: RUF012  as fsspec has it
    folders: set[str] = set()  # noqa: RUF012  of this test

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return f"/{path.removeprefix('ftp://').strip('/')}".rstrip("/")

    def makedirs(self, path: str, exist_ok: bool = False) -> None:
        del exist_ok
        self.folders.add(path.rstrip("/"))

    def _require(self, path: str) -> None:
        if path.rpartition("/")[0] not in self.folders:
            raise EOFError("550 No such file or directory")

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **kwargs: Any) -> None:
        self._require(path)
        super().pipe_file(path, value)

    def put_file(self, lpath: str, rpath: str, **kwargs: Any) -> None:
        self._require(rpath)
        super().pipe_file(rpath, Path(lpath).read_bytes())


@pytest.fixture
def ftp_store() -> Generator[FolderedStore]:
    original = import_module("fsspec").get_filesystem_class("ftp")
    register_implementation("ftp", FolderedStore, clobber=True)
    FolderedStore.folders.clear()
    yield FolderedStore()
    register_implementation("ftp", original, clobber=True)


def test_creates_parent_folders(table_and_picture: Path, ftp_store: FolderedStore) -> None:
    arguments = ["lut", "ftp://host/deep/out", "--sources", "cat.png", "--light", "0", "--workers", "1"]
    assert import_module("generator.cli").main(arguments) == 0
    assert "/host/deep/out/images" in ftp_store.folders
    assert import_module("generator.cli").main(["--verify", "ftp://host/deep/out"]) == 0


def test_reports_connection_error(monkeypatch: pytest.MonkeyPatch) -> None:
    import ftplib

    def refuse(url: str) -> None:
        raise ftplib.error_perm("530 Login incorrect.")

    monkeypatch.setattr("fsspec.core.url_to_fs", refuse)
    with pytest.raises(InputError, match=r"ftp://…@host/x.*530"):
        RemoteStore("ftp://u:p@host/x")


PASSWORD = "ftp-5ecret-word"


class GuardedStore(MemoryFileSystem):
    """A store with user and password in its address, as for ftp and sftp."""

    protocol = "guarded"
    store: dict[str, object] = {}  # noqa: RUF012  as fsspec has it
    pseudo_dirs = [""]  # noqa: RUF012  as fsspec has it

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return f"/{path.rpartition('@')[2].removeprefix('guarded://').strip('/')}".rstrip("/")


def command(module: str, *arguments: object) -> int:
    return int(import_module(module).main([*map(str, arguments)]))


def test_secrets_of_address_are_not_written(table_and_picture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    register_implementation("guarded", GuardedStore, clobber=True)
    address = f"guarded://lab:{PASSWORD}@store/"
    store = GuardedStore()
    store.pipe_file("/store/pictures/cat.png", (table_and_picture / "cat.png").read_bytes())
    arguments = ("--sources", address + "pictures", "--light", "0", "--light", "1", "--workers", 1)
    assert command("generator.cli", table_and_picture / "lut", address + "out", *arguments) == 0
    assert command("generator.cli", "--verify", address + "out") == 0
    assert command("generator.cli", table_and_picture / "lut", address + "out", *arguments) in (0, 2)
    assert command("generator.cli", "--verify", address + "nowhere") == 2
    output = "".join(capsys.readouterr())
    assert "guarded://…@store/out" in output
    assert PASSWORD not in output
    names = store.find("/store/out")
    assert len(names) > 6
    for name in names:
        assert PASSWORD.encode() not in store.cat_file(name), name


pytestmark = pytest.mark.slow

SCENES = random_scenes(4, 24, 16, 8)


class FailingFileSystem(MemoryFileSystem):
    """A store in memory that fails from write number `fails_at` on, or never."""

    protocol = "failing"
    store: dict[str, Any] = {}  # noqa: RUF012  as the class above has it
    fails_at: ClassVar[int | None] = None
    writes = 0

    def _count(self) -> None:
        FailingFileSystem.writes += 1
        if FailingFileSystem.fails_at is not None and FailingFileSystem.writes >= FailingFileSystem.fails_at:
            raise ConnectionResetError("the store hung up")

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **kwargs: Any) -> None:
        self._count()
        super().pipe_file(path, value, mode, **kwargs)

    def put_file(self, lpath: str, rpath: str, **kwargs: Any) -> None:
        self._count()
        super().put_file(lpath, rpath, **kwargs)


@pytest.fixture(autouse=True)
def empty_stores() -> Iterator[None]:
    """Empty the stores in memory, which otherwise persist between tests."""
    fsspec.register_implementation("failing", FailingFileSystem, clobber=True)
    FailingFileSystem.fails_at = None
    MemoryFileSystem.store.clear()
    FailingFileSystem.store.clear()
    yield
    MemoryFileSystem.store.clear()
    FailingFileSystem.store.clear()


def file_hashes(location: str | Path) -> dict[str, str]:
    """Return the hash of every file of a store."""
    store = open_store(location)
    return {name: hashlib.sha256(store.get(name)).hexdigest() for name in store.names()}


def make(lut: Lut, out: str | Path, **options: Any) -> None:
    keywords: dict[str, Any] = {"seed": 3, "shard_images": 3, "split": (0.5, 0.0, 0.5), "rendering": "codes"} | options
    generate_dataset(lut, out, SCENES, [2, 0], **grouped(**keywords))


@pytest.mark.parametrize("layout", get_args(Layout))
def test_store_and_disk_have_equal_data_sets(make_lut: MakeLut, tmp_path: Path, layout: str) -> None:
    lut = make_lut()
    make(lut, tmp_path / "out", layout=layout)
    make(lut, "memory://bucket/out", layout=layout, workers=3)
    assert file_hashes("memory://bucket/out") == file_hashes(tmp_path / "out")
    remote, local = open_dataset("memory://bucket/out"), open_dataset(tmp_path / "out")
    assert remote.entries == local.entries
    assert remote.sources == local.sources
    for entry in local.entries[::3]:
        np.testing.assert_array_equal(remote.read_image(entry), local.read_image(entry))
    assert list(file_faults("memory://bucket/out")) == []
    with pytest.raises(InputError, match="memory://bucket/out"):
        make(lut, "memory://bucket/out", layout=layout)


STRIDE = 3  # The store fails at every third write


@pytest.mark.parametrize("layout", get_args(Layout))
def test_resumes_after_failure_of_any_write(make_lut: MakeLut, tmp_path: Path, layout: str) -> None:
    lut = make_lut()
    make(lut, tmp_path / "out", layout=layout, previews=False)
    expected = file_hashes(tmp_path / "out")
    write = 1 - STRIDE
    failed = True
    while failed:
        write += STRIDE
        FailingFileSystem.store.clear()
        FailingFileSystem.writes, FailingFileSystem.fails_at = 0, write
        try:
            make(lut, "failing://bucket/out", layout=layout, previews=False)
        except StorageError as error:
            assert "ConnectionResetError: the store hung up; check the server" in str(error)  # noqa: PT017
            with pytest.raises(FormatError):
                open_dataset("failing://bucket/out")
        else:
            failed = False
        FailingFileSystem.fails_at = None
        if failed:
            make(lut, "failing://bucket/out", layout=layout, previews=False)
        assert file_hashes("failing://bucket/out") == expected, f"failed at write {write}"
    assert write > 8


def test_shares_in_a_store(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    plan = Plan(
        lut, SCENES, ListedLights((2, 0)), 3, DatasetOptions(rendering="codes", shard_images=3, split=(0.5, 0.0, 0.5))
    )
    make(lut, tmp_path / "out")
    assert make_share(plan, "memory://out", (1, 2)) == (1, 3)
    with pytest.raises(InputError, match=r"memory://out.*3.*4"):
        make(lut, "memory://out", seed=4)
    assert make_share(plan, "memory://out", (0, 2)) == (3, 3)
    make_dataset(plan, "memory://out")
    assert file_hashes("memory://out") == file_hashes(tmp_path / "out")


def test_sources_in_a_store(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    rng = np.random.default_rng(4)
    (tmp_path / "pictures").mkdir()
    for name in ("a.png", "b.png"):
        data = cv2.imencode(".png", rng.integers(0, 256, (9, 8, 3)).astype(np.uint8))[1].tobytes()
        (tmp_path / "pictures" / name).write_bytes(data)
        RemoteStore("memory://bucket/pictures").put(name, data)
    RemoteStore("memory://bucket/pictures").put("c.png", b"no picture")
    (tmp_path / "pictures" / "c.png").write_bytes(b"no picture")
    for location, out in (("memory://bucket/pictures", "there"), (str(tmp_path / "pictures"), "here")):
        generate_dataset(lut, tmp_path / out, find_pictures([location]), [0, 1])
    assert file_hashes(tmp_path / "there") == file_hashes(tmp_path / "here")
    assert len(open_dataset(tmp_path / "here").description.skipped) == 1


@pytest.mark.parametrize("remote", [True, False])
def test_ignores_late_worker_of_removed_plan(make_lut: MakeLut, tmp_path: Path, remote: bool) -> None:
    lut = make_lut()
    out = "memory://bucket/out" if remote else str(tmp_path / "out")
    old, new = (
        Plan(lut, SCENES, ListedLights((0, 2)), seed, DatasetOptions(rendering="codes", shard_images=3))
        for seed in (3, 4)
    )
    with open_workplace(out, old.identity()) as late_workplace:
        pass
    RemoteStore(out).remove("") if remote else shutil.rmtree(tmp_path / ".out.partial")
    make_share(new, out, (1, 2))
    with nullcontext() if remote else pytest.raises(StorageError):
        make_shard_on_worker(old.job(0), late_workplace)
    make_dataset(new, out)
    make_dataset(new, tmp_path / "undisturbed")
    assert file_hashes(out) == file_hashes(tmp_path / "undisturbed")


def test_unreachable_source_stops_the_work(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lut = make_lut()
    data = cv2.imencode(".png", np.zeros((9, 8, 3), np.uint8))[1].tobytes()
    for name in ("a.png", "b.png"):
        RemoteStore("failing://bucket/pictures").put(name, data)
    pictures = find_pictures(["failing://bucket/pictures"])

    def hang_up(*_: object, **__: object) -> None:
        raise ConnectionResetError("the store hung up")

    with monkeypatch.context() as outage:
        outage.setattr(FailingFileSystem, "get_file", hang_up)
        with pytest.raises(StorageError, match=r"failing://bucket/pictures/a\.png"):
            generate_dataset(lut, tmp_path / "out", pictures, [0])
    assert generate_dataset(lut, tmp_path / "out", pictures, [0]).description.sources == 2


@pytest.mark.parametrize("unmounted", ["gone", "empty"])
def test_distinguishes_unmounted_disk_from_missing_picture(make_lut: MakeLut, tmp_path: Path, unmounted: str) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    for name in ("a.png", "b.png"):
        (folder / name).write_bytes(cv2.imencode(".png", np.zeros((9, 8, 3), np.uint8))[1].tobytes())
    pictures = find_pictures([folder])
    (folder / "a.png").unlink()
    dataset = generate_dataset(make_lut(), tmp_path / "one", pictures, [0])
    assert (dataset.description.sources, [skipped.name for skipped in dataset.description.skipped]) == (1, ["a.png"])
    shutil.rmtree(folder)
    if unmounted == "empty":
        folder.mkdir()
    with pytest.raises(StorageError, match=r"a\.png"):
        generate_dataset(make_lut(name="again"), tmp_path / "none", pictures, [0])


def test_refuses_location_with_other_files(make_lut: MakeLut) -> None:
    RemoteStore("memory://bucket").put("out/mine.txt", b"mine")
    with pytest.raises(InputError, match="memory://bucket/out"):
        make(make_lut(), "memory://bucket/out")
    assert RemoteStore("memory://bucket").get("out/mine.txt") == b"mine"


def test_file_url_is_a_folder(make_lut: MakeLut, tmp_path: Path) -> None:
    make(make_lut(), f"file://{tmp_path}/out")
    assert open_dataset(f"file://{tmp_path}/out").store == LocalStore(tmp_path / "out")


def test_failed_block_writes_no_file(tmp_path: Path) -> None:
    def fail(store: LocalStore | RemoteStore) -> None:
        with store.create("a/b") as stream:
            stream.write(b"half")
            raise KeyError

    for store in (LocalStore(tmp_path), RemoteStore("memory://bucket")):
        with pytest.raises(KeyError):
            fail(store)
        assert not store.has("a/b")
        assert list(store.names()) == []


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_forked_process_synchronises_files(tmp_path: Path) -> None:
    # In a new process, because forking this one with its threads is not safe.
    program = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from generator.stores import LocalStore\n"
        "store = LocalStore(Path(sys.argv[1]))\n"
        "store.put('a', b'1'); store.sync(['a'])\n"
        "child = os.fork()\n"
        "if not child:\n"
        "    signal.alarm(60)\n"
        "    store.put('b', b'2'); store.sync(['b'])\n"
        "    os._exit(0)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr
    assert (tmp_path / "b").read_bytes() == b"2"
