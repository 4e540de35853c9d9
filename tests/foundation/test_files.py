"""Atomic files and folders, on disks that are full, closed or broken."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import signal
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from foundation import files as storage
from foundation.errors import FormatError, InputError, StorageError
from foundation.files import (
    HashingWriter,
    atomic_file,
    file_sha256,
    is_partial,
    open_inside,
    partial_path,
    read_buffer,
    read_csv,
    write_atomic,
)
from foundation.folders import atomic_folder, require_free_file


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@contextmanager
def small_disk(limit: int) -> Generator[None]:
    """Limit the size of files: the kernel raises EFBIG, as a full disk raises ENOSPC."""
    resource = pytest.importorskip("resource")
    previous = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, previous[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, previous)
        signal.signal(signal.SIGXFSZ, handler)


class TestAtomicFile:
    def test_appears_when_complete(self, tmp_path: Path) -> None:
        path = tmp_path / "new" / "frame.dng"
        with atomic_file(path) as stream:
            stream.write(b"first half, ")
            stream.flush()
            assert names(path.parent) == [".frame.dng.partial"]
            stream.write(b"second half")
        assert path.read_bytes() == b"first half, second half"
        assert names(path.parent) == ["frame.dng"]

    def test_can_be_read_back_before_it_is_named(self, tmp_path: Path) -> None:
        def named() -> Path:
            assert partial_path(tmp_path / "frame").read_bytes() == b"raw"
            return tmp_path / "frame.CR2"

        with atomic_file(tmp_path / "frame", named) as stream:
            stream.write(b"raw")
            assert stream.tell() == 3
            stream.seek(0)
            assert stream.read() == b"raw"
        assert names(tmp_path) == ["frame.CR2"]

    def test_replaces_only_at_the_end(self, tmp_path: Path) -> None:
        path = tmp_path / "frames.csv"
        write_atomic(path, "old")
        with atomic_file(path) as stream:
            stream.write(b"new")
            stream.flush()
            assert path.read_text() == "old"
        assert path.read_text() == "new"

    def test_missing_parent_is_not_made_if_required(self, tmp_path: Path) -> None:
        with pytest.raises(StorageError):  # noqa: SIM117
            with atomic_file(tmp_path / "disk" / "frame", make_parents=False) as stream:
                stream.write(b"raw")
        assert names(tmp_path) == []

    @pytest.mark.parametrize("error", [ValueError("ours"), KeyboardInterrupt()])
    def test_failed_block_keeps_the_old_file(self, tmp_path: Path, error: BaseException) -> None:
        path = tmp_path / "a.csv"
        write_atomic(path, "old")
        with pytest.raises(type(error)), atomic_file(path) as stream:  # noqa: PT012
            stream.write(b"new")
            raise error
        assert path.read_text() == "old"
        assert names(tmp_path) == ["a.csv"]

    def test_full_disk_leaves_no_file(self, tmp_path: Path) -> None:
        path = tmp_path / "big.dng"
        with (
            pytest.raises(StorageError, match=r"big\.dng: .*too large there"),
            small_disk(10_000),
            atomic_file(path) as stream,
        ):
            stream.write(bytes(50_000))
        assert names(tmp_path) == []

    @pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS])
    def test_reports_each_disk_error(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
        def fail(handle: int) -> None:
            raise OSError(number, os.strerror(number))

        path = tmp_path / "a.csv"
        write_atomic(path, "old")
        monkeypatch.setattr(storage.os, "fsync", fail)
        with pytest.raises(StorageError, match=os.strerror(number)) as caught:
            write_atomic(path, "new")
        assert isinstance(caught.value.__cause__, OSError)
        assert path.read_text() == "old"
        assert names(tmp_path) == ["a.csv"]

    def test_reports_a_disconnected_disk(self, tmp_path: Path) -> None:
        """The empty mount point remains; the file does not."""
        with pytest.raises(StorageError), atomic_file(tmp_path / "a.csv"):
            (tmp_path / ".a.csv.partial").unlink()

    def test_reports_failed_folder_flush(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(number: int) -> None:
            def fsync(handle: int) -> None:
                raise OSError(number, os.strerror(number))

            monkeypatch.setattr(storage.os, "fsync", fsync)

        fail(errno.EIO)
        with pytest.raises(StorageError):
            storage.sync_folder(tmp_path)
        fail(errno.EINVAL)
        storage.sync_folder(tmp_path)

    def test_killed_writer_leaves_a_partial_file(self, tmp_path: Path) -> None:
        write_atomic(tmp_path / "a", "old")
        program = (
            "import os, sys, pathlib; from foundation.files import atomic_file\n"
            "with atomic_file(pathlib.Path(sys.argv[1])) as stream:\n"
            "    stream.write(b'half'); stream.flush(); os.kill(os.getpid(), 9)\n"
        )
        result = subprocess.run([sys.executable, "-c", program, str(tmp_path / "a")], check=False)
        assert result.returncode == -signal.SIGKILL
        assert (tmp_path / "a").read_text() == "old"
        assert [is_partial(name) for name in names(tmp_path)] == [True, False]
        write_atomic(tmp_path / "a", "new")
        assert names(tmp_path) == ["a"]


class TestAtomicFolder:
    def test_appears_when_complete(self, tmp_path: Path) -> None:
        path = tmp_path / "deep" / "lut"
        with atomic_folder(path, "the table") as folder:
            (folder / "samples.npy").write_bytes(b"1")
            assert not path.exists()
            assert is_partial(folder.name)
        assert names(path) == ["samples.npy"]
        assert names(path.parent) == ["lut"]

    def test_accepts_an_empty_folder(self, tmp_path: Path) -> None:
        (tmp_path / "lut").mkdir()
        with atomic_folder(tmp_path / "lut", "the table") as folder:
            write_atomic(folder / "a", "1")
        assert names(tmp_path / "lut") == ["a"]

    def test_never_overwrites(self, tmp_path: Path) -> None:
        (tmp_path / "full").mkdir()
        write_atomic(tmp_path / "full" / "mine", "precious")
        write_atomic(tmp_path / "file", "precious")
        (tmp_path / "link").symlink_to(tmp_path / "nowhere")
        for name in ("full", "file", "link"):
            with pytest.raises(InputError, match=f"{name} already exists"):  # noqa: SIM117
                with atomic_folder(tmp_path / name, "the table"):
                    pytest.fail("the block must not begin")
        assert (tmp_path / "full" / "mine").read_text() == "precious"

    def test_keeps_a_folder_made_by_another_program(self, tmp_path: Path) -> None:
        path = tmp_path / "lut"
        with pytest.raises(InputError), atomic_folder(path, "the table") as folder:  # noqa: PT012
            write_atomic(folder / "a", "ours")
            path.mkdir()
            write_atomic(path / "a", "theirs")
        assert (path / "a").read_text() == "theirs"
        assert names(tmp_path) == ["lut"]

    @pytest.mark.parametrize("error", [ValueError("ours"), KeyboardInterrupt()])
    def test_failed_block_leaves_no_folder(self, tmp_path: Path, error: BaseException) -> None:
        with pytest.raises(type(error)), atomic_folder(tmp_path / "lut", "the table") as folder:  # noqa: PT012
            write_atomic(folder / "deep" / "a", "1")
            raise error
        assert names(tmp_path) == []

    def test_removes_an_old_partial_folder(self, tmp_path: Path) -> None:
        leftover = partial_path(tmp_path / "lut")
        leftover.mkdir()
        write_atomic(leftover / "stale", "x")
        with atomic_folder(tmp_path / "lut", "the table") as folder:
            write_atomic(folder / "fresh", "x")
        assert names(tmp_path / "lut") == ["fresh"]


def test_empty_folder_is_not_free_for_a_file(tmp_path: Path) -> None:
    require_free_file(tmp_path / "new", "the lights")
    require_free_file(tmp_path / "no" / "such" / "new", "the lights")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for path in (tmp_path, tmp_path / "link"):
        with pytest.raises(InputError):
            require_free_file(path, "the lights")


@pytest.mark.parametrize("size", [0, 1, 70_000, 5 << 20])
def test_reads_a_file_into_a_read_only_buffer(tmp_path: Path, size: int) -> None:
    written = os.urandom(size)
    (tmp_path / "frame").write_bytes(written)
    data = read_buffer(tmp_path / "frame")
    assert data == written
    assert data.readonly
    assert bool(data) == bool(written)


@pytest.mark.parametrize("reported", [0, 5, 20])
def test_reads_to_the_end_if_the_reported_size_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reported: int
) -> None:
    (tmp_path / "frame").write_bytes(b"ten bytes.")

    def fstat(handle: int) -> os.stat_result:
        del handle
        return os.stat_result((0,) * 6 + (reported, 0, 0, 0))

    monkeypatch.setattr(storage.os, "fstat", fstat)
    assert read_buffer(tmp_path / "frame") == b"ten bytes."


def test_gives_up_on_a_folder_that_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def mkdir(*arguments: object, **options: object) -> None:
        raise FileExistsError(errno.EEXIST, "File exists")

    monkeypatch.setattr(Path, "mkdir", mkdir)
    with pytest.raises(StorageError):
        storage.make_folder(tmp_path / "x")


def test_reads_csv_with_byte_order_mark_and_short_lines(tmp_path: Path) -> None:
    path = tmp_path / "some.csv"
    path.write_bytes(b'\xef\xbb\xbfimage,fold\r\n"a\nb",1\r\nc\r\n')
    assert read_csv(path, "mend it") == (
        ["image", "fold"],
        [{"image": "a\nb", "fold": "1"}, {"image": "c", "fold": ""}],
    )
    path.write_bytes(b"")
    assert read_csv(path, "mend it") == ([], [])


@pytest.mark.parametrize("content", [b"image\n\xff\0\n", b"image\n" + b"a" * 200_000 + b"\n", None])
def test_refuses_bad_csv_with_remedy(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "some.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FormatError, match=r"some\.csv: .*; mend it"):
        read_csv(path, "mend it")


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        ("a\nglacé".encode("latin-1"), "line 2 has the byte 0xe9"),
        (b"a\xff\0", "binary data"),
        (b"\xff\xfe\x80", "binary"),
    ],
)
def test_reports_other_encodings(tmp_path: Path, content: bytes, reported: str) -> None:
    path = tmp_path / "some.csv"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=f"{reported}.*expected text in UTF-8"):
        read_csv(path, "mend it")


def test_reads_unicode_text_of_spreadsheets(tmp_path: Path) -> None:
    # Excel: "Unicode text" is UTF-16 with a byte order mark, "CSV UTF-8" has a byte order mark too.
    path = tmp_path / "some.csv"
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        path.write_bytes("name,n\r\nBüro,1\r\n".encode(encoding))
        assert read_csv(path, "mend it") == (["name", "n"], [{"name": "Büro", "n": "1"}])


@pytest.mark.parametrize("name", ["x" * 250, "x" * 255, 84 * "图"])
def test_longest_names_can_be_written(tmp_path: Path, name: str) -> None:
    write_atomic(tmp_path / name, b"content")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert is_partial(partial_path(tmp_path / name).name)


@pytest.mark.parametrize(("number", "remedy"), [(errno.EROFS, "mount it for writing"), (errno.EACCES, "ask its owner")])
def test_detects_an_unwritable_path_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, remedy: str
) -> None:
    def refused(dir: Path) -> None:
        raise OSError(number, os.strerror(number), str(dir))

    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    with pytest.raises(StorageError, match=remedy):
        require_free_file(tmp_path / "no" / "model.npz", "the model")


BLOCK, MAX_HOLES = 1 << 16, 1 << 30


@pytest.mark.parametrize(
    ("blocks", "size"),
    [
        ([MAX_HOLES], MAX_HOLES + BLOCK),
        ([MAX_HOLES // 2, MAX_HOLES + BLOCK], MAX_HOLES + 2 * BLOCK),
        ([0], MAX_HOLES + BLOCK),
    ],
)
def test_refuses_files_with_holes_above_one_gibibyte(tmp_path: Path, blocks: list[int], size: int) -> None:
    path = tmp_path / "samples.npy"
    with path.open("wb") as stream:
        for block in blocks:
            stream.seek(block)
            stream.write(bytes([7]) * BLOCK)
        stream.truncate(size)
        if path.stat().st_blocks * 512 >= size:
            pytest.skip("the file system makes no holes")
    with open_inside(tmp_path, path.name) as opened:
        assert opened.tell() == 0
    os.truncate(path, size + BLOCK)
    with (
        pytest.raises(FormatError, match=f"a size of {size + BLOCK} bytes, of which {len(blocks) * BLOCK} are data;"),
        open_inside(tmp_path, path.name),
    ):
        pass


ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
"""Of the bytes abc (FIPS 180-4, NIST's example values)."""
NOTHING = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_a_file_of_several_blocks(tmp_path: Path) -> None:
    data = bytes(range(256)) * 10_000
    (tmp_path / "a").write_bytes(data)
    assert file_sha256(tmp_path / "a") == hashlib.sha256(data).hexdigest()
    (tmp_path / "b").touch()
    assert file_sha256(tmp_path / "b") == NOTHING
    with pytest.raises(FileNotFoundError):
        file_sha256(tmp_path / "c")


def test_writer_hashes_and_counts_bytes() -> None:
    stream = io.BytesIO()
    writer = HashingWriter(stream)
    assert (writer.write(b"a"), writer.write(memoryview(b"bc"))) == (1, 2)
    assert (writer.tell(), writer.sha256, stream.getvalue()) == (3, ABC, b"abc")
