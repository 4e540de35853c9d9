"""Files and folders that appear whole or not at all, on disks that fill up, close and break."""

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
    """Let no file grow beyond `limit` bytes: the kernel answers EFBIG where a full disk would answer ENOSPC."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


class TestWholeFile:
    def test_appears_at_the_end_and_whole(self, tmp_path: Path) -> None:
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

    def test_a_folder_that_is_gone_is_not_made_anew_where_it_must_be_there(self, tmp_path: Path) -> None:
        with pytest.raises(StorageError):  # noqa: SIM117
            with atomic_file(tmp_path / "disk" / "frame", make=False) as stream:
                stream.write(b"raw")
        assert names(tmp_path) == []

    @pytest.mark.parametrize("error", [ValueError("ours"), KeyboardInterrupt()])
    def test_a_block_that_fails_leaves_the_old_file_and_nothing_else(
        self, tmp_path: Path, error: BaseException
    ) -> None:
        path = tmp_path / "a.csv"
        write_atomic(path, "old")
        with pytest.raises(type(error)), atomic_file(path) as stream:  # noqa: PT012
            stream.write(b"new")
            raise error
        assert path.read_text() == "old"
        assert names(tmp_path) == ["a.csv"]

    def test_a_disk_that_takes_no_more_is_one_sentence_and_leaves_nothing(self, tmp_path: Path) -> None:
        path = tmp_path / "big.dng"
        with (
            pytest.raises(StorageError, match=r"big\.dng: .*so large"),
            small_disk(10_000),
            atomic_file(path) as stream,
        ):
            stream.write(bytes(50_000))
        assert names(tmp_path) == []

    @pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS])
    def test_each_fault_of_a_disk(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
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

    def test_a_disk_that_was_taken_away_is_not_taken_for_one_that_takes_no_files(self, tmp_path: Path) -> None:
        """The empty folder it was mounted on is there; what was written is not."""
        with pytest.raises(StorageError), atomic_file(tmp_path / "a.csv"):
            (tmp_path / ".a.csv.partial").unlink()

    def test_a_folder_whose_names_cannot_be_flushed_is_a_fault_where_the_disk_fails(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(number: int) -> None:
            def fsync(handle: int) -> None:
                raise OSError(number, os.strerror(number))

            monkeypatch.setattr(storage.os, "fsync", fsync)

        fail(errno.EIO)
        with pytest.raises(StorageError):
            storage.sync_folder(tmp_path)
        fail(errno.EINVAL)
        storage.sync_folder(tmp_path)

    def test_a_killed_writer_leaves_only_a_hidden_leftover(self, tmp_path: Path) -> None:
        write_atomic(tmp_path / "a", "old")
        program = (
            "import os, sys, pathlib; from foundation.files import atomic_file\n"
            "with atomic_file(pathlib.Path(sys.argv[1])) as stream:\n"
            "    stream.write(b'half'); stream.flush(); os.kill(os.getpid(), 9)\n"
        )
        done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "a")], check=False)
        assert done.returncode == -signal.SIGKILL
        assert (tmp_path / "a").read_text() == "old"
        assert [is_partial(name) for name in names(tmp_path)] == [True, False]
        write_atomic(tmp_path / "a", "new")
        assert names(tmp_path) == ["a"]


class TestWholeFolder:
    def test_appears_at_the_end_and_whole(self, tmp_path: Path) -> None:
        path = tmp_path / "deep" / "lut"
        with atomic_folder(path, "the table") as folder:
            (folder / "samples.npy").write_bytes(b"1")
            assert not path.exists()
            assert is_partial(folder.name)
        assert names(path) == ["samples.npy"]
        assert names(path.parent) == ["lut"]

    def test_takes_an_empty_folder(self, tmp_path: Path) -> None:
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

    def test_a_place_taken_meanwhile_is_left_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "lut"
        with pytest.raises(InputError), atomic_folder(path, "the table") as folder:  # noqa: PT012
            write_atomic(folder / "a", "ours")
            path.mkdir()
            write_atomic(path / "a", "theirs")
        assert (path / "a").read_text() == "theirs"
        assert names(tmp_path) == ["lut"]

    @pytest.mark.parametrize("error", [ValueError("ours"), KeyboardInterrupt()])
    def test_a_block_that_fails_leaves_nothing(self, tmp_path: Path, error: BaseException) -> None:
        with pytest.raises(type(error)), atomic_folder(tmp_path / "lut", "the table") as folder:  # noqa: PT012
            write_atomic(folder / "deep" / "a", "1")
            raise error
        assert names(tmp_path) == []

    def test_a_leftover_is_cleared(self, tmp_path: Path) -> None:
        leftover = partial_path(tmp_path / "lut")
        leftover.mkdir()
        write_atomic(leftover / "stale", "x")
        with atomic_folder(tmp_path / "lut", "the table") as folder:
            write_atomic(folder / "fresh", "x")
        assert names(tmp_path / "lut") == ["fresh"]


def test_an_empty_folder_is_no_free_file(tmp_path: Path) -> None:
    require_free_file(tmp_path / "new", "the lights")
    require_free_file(tmp_path / "no" / "such" / "new", "the lights")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for path in (tmp_path, tmp_path / "link"):
        with pytest.raises(InputError):
            require_free_file(path, "the lights")


@pytest.mark.parametrize("size", [0, 1, 70_000, 5 << 20])
def test_a_file_is_read_whole_and_cannot_be_written_through(tmp_path: Path, size: int) -> None:
    written = os.urandom(size)
    (tmp_path / "frame").write_bytes(written)
    data = read_buffer(tmp_path / "frame")
    assert data == written
    assert data.readonly
    assert bool(data) == bool(written)


@pytest.mark.parametrize("told", [0, 5, 20])
def test_a_file_of_another_size_than_the_system_told_is_read_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: int
) -> None:
    (tmp_path / "frame").write_bytes(b"ten bytes.")

    def fstat(handle: int) -> os.stat_result:
        del handle
        return os.stat_result((0,) * 6 + (told, 0, 0, 0))

    monkeypatch.setattr(storage.os, "fstat", fstat)
    assert read_buffer(tmp_path / "frame") == b"ten bytes."


def test_a_folder_that_is_there_and_not_there_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mkdir(*arguments: object, **options: object) -> None:
        raise FileExistsError(errno.EEXIST, "File exists")

    monkeypatch.setattr(Path, "mkdir", mkdir)
    with pytest.raises(StorageError):
        storage.make_folder(tmp_path / "x")


def test_a_table_is_read_whatever_its_mark_and_its_short_lines(tmp_path: Path) -> None:
    path = tmp_path / "some.csv"
    path.write_bytes(b'\xef\xbb\xbfimage,fold\r\n"a\nb",1\r\nc\r\n')
    assert read_csv(path, "mend it") == (
        ["image", "fold"],
        [{"image": "a\nb", "fold": "1"}, {"image": "c", "fold": ""}],
    )
    path.write_bytes(b"")
    assert read_csv(path, "mend it") == ([], [])


@pytest.mark.parametrize("content", [b"image\n\xff\0\n", b"image\n" + b"a" * 200_000 + b"\n", None])
def test_what_is_no_table_is_refused_with_what_helps(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "some.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FormatError, match=r"some\.csv: .*; mend it"):
        read_csv(path, "mend it")


@pytest.mark.parametrize(
    ("content", "told"),
    [("a\nglacé".encode("latin-1"), "line 2 has the byte 0xe9"), ("glacé".encode("utf-16"), "UTF-16")],
)
def test_a_text_in_another_encoding_is_to_be_saved_anew(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "some.csv"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=told) as caught:
        read_csv(path, "mend it")
    assert "UTF-8" in caught.value.remedy


@pytest.mark.parametrize(("number", "said"), [(errno.EROFS, "mount it for writing"), (errno.EACCES, "ask its owner")])
def test_a_place_that_cannot_be_written_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, said: str
) -> None:
    def refused(dir: Path) -> None:
        raise OSError(number, os.strerror(number), str(dir))

    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    with pytest.raises(StorageError, match=said):
        require_free_file(tmp_path / "no" / "model.npz", "the model")


BLOCK, MOST_HOLES = 1 << 16, 1 << 30


@pytest.mark.parametrize(
    ("blocks", "size"),
    [
        ([MOST_HOLES], MOST_HOLES + BLOCK),
        ([MOST_HOLES // 2, MOST_HOLES + BLOCK], MOST_HOLES + 2 * BLOCK),
        ([0], MOST_HOLES + BLOCK),
    ],
)
def test_a_file_may_have_holes_of_a_gibibyte_together(tmp_path: Path, blocks: list[int], size: int) -> None:
    """A few bytes can claim more than anybody can read."""
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
        pytest.raises(FormatError, match=f"claims {size + BLOCK} bytes and holds at most {len(blocks) * BLOCK};"),
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


def test_what_is_written_is_hashed_counted_and_passed_on() -> None:
    stream = io.BytesIO()
    writer = HashingWriter(stream)
    assert (writer.write(b"a"), writer.write(memoryview(b"bc"))) == (1, 2)
    assert (writer.tell(), writer.sha256, stream.getvalue()) == (3, ABC, b"abc")
