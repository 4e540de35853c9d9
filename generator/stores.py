"""Files below one location: a folder of this machine, or an object store that fsspec supports.

A location is a path or a URL as the user writes it. A name is a path below it, with forward slashes. Contract:

- Writing is atomic: a file exists with all its bytes or not at all. If two programs write a name, the later file stays.
- A file survives a loss of power only after `Store.sync`. Synchronise many files in one call: they share one wait.
- An object store has no rename. An object appears when its last byte has arrived.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import secrets
import shutil
import tempfile
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, cast

from foundation.errors import CropError, FormatError, InputError, StorageError
from foundation.files import (
    is_inside_name,
    is_partial,
    open_inside,
    partial_path,
    reading_error,
    storage_error,
    sync_folder,
)
from foundation.remote import filesystem, is_remote, remote_error
from foundation.secret_texts import masked

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem


DESCRIPTION: Final = "dataset.json"  # Marks a complete data set, so it is written last


_URL_AS_PATH: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def local_path(location: str | Path) -> Path:
    """Return the path of a location of this machine, without file:// and with a name as last component."""
    text = str(location)
    for scheme in ("file://", "local://"):
        text = text.removeprefix(scheme)
    if isinstance(location, Path) and _URL_AS_PATH.match(text):
        raise InputError(f"{text} is a Path, which removes a slash of a URL; give the URL as text (str)")
    path = Path(text)
    if text and path.name in ("", ".."):
        path = path.resolve()
    if not path.name:
        raise InputError(f"{str(location)!r} is not a folder name, expected a name such as images; give one")
    return path


Pieces = Iterable[bytes | memoryview]  # The bytes of a file in order; each piece is valid until the next one

# Number of files synchronised in parallel. A file system commits its journal once for all waiting files, so 16 files
# take little longer than one file.
_SYNC_THREADS: Final = 16

# Buffer size in bytes; larger pieces are written directly. Without a size, Python makes two system calls to choose it,
# and each call may pass the interpreter lock to another thread.
_BUFFER: Final = 1 << 16

# Protocols of fsspec with real folders, which must exist before a file is written. In other stores no folder is
# created, because some stores would create a bucket.
_WITH_FOLDERS: Final = frozenset({"ftp", "sftp", "ssh", "smb", "webdav", "webdavs", "hdfs", "arrow_hdfs"})


@dataclass(frozen=True)
class LocalStore:
    """A folder of this machine, which must exist. Publishing a data set renames the folder, so later writes fail."""

    root: Path

    @property
    def location(self) -> str:
        """The folder, for messages."""
        return str(self.root)

    def put(self, name: str, data: bytes | Pieces) -> None:
        """Write a file; raises StorageError."""
        with self.create(name) as stream:
            for piece in (data,) if isinstance(data, bytes) else data:
                stream.write(piece)

    def append(self, name: str, data: bytes) -> None:
        """Append to a file, or create it; not atomic, so a kill or a full disk may truncate the addition."""
        path = self.root / name
        try:
            if not path.parent.is_dir():
                self._make_folder(path.parent)
            with path.open("ab", 0) as stream:
                stream.write(data)
        except OSError as error:
            raise storage_error(path, error) from error

    @contextmanager
    def create(self, name: str) -> Generator[BinaryIO]:
        """Open a new file for writing; it appears at the end of the block, unless the block raises."""
        path = self.root / name
        # The temporary name is random, because two programs may write the same shard (`foundation.files.is_partial`).
        unfinished = partial_path(path.with_name(f"{path.name}.{secrets.token_hex(8)}"))
        try:
            try:
                stream = unfinished.open("wb", _BUFFER)
            except FileNotFoundError:
                self._make_folder(path.parent)
                stream = unfinished.open("wb", _BUFFER)
            with stream:
                yield stream
            unfinished.replace(path)
        except BaseException as error:
            with contextlib.suppress(OSError):
                unfinished.unlink(missing_ok=True)
            if isinstance(error, OSError) and not isinstance(error, CropError):
                raise storage_error(path, error) from error
            raise

    def _make_folder(self, folder: Path) -> None:
        if not self.root.is_dir():
            raise StorageError(f"{self.root} was completed or removed by another program; run the same command again")
        folder.mkdir(parents=True, exist_ok=True)

    def sync(self, names: Iterable[str]) -> None:
        """Wait until these files and their folder entries are on the disk."""
        paths = [self.root / name for name in names]
        list(_sync_pool().map(_sync_file, paths))
        for folder in {path.parent for path in paths}:
            sync_folder(folder)

    def get(self, name: str) -> bytes:
        """Return the bytes of a file; raises FormatError."""
        with self.open(name) as stream:
            return stream.read()

    @contextmanager
    def open(self, name: str, scattered: bool = False) -> Generator[BinaryIO]:
        """Open a file for reading; raises FormatError. `scattered`: only some parts are read."""
        del scattered
        try:
            # Lists of a foreign data set may contain any name, so names outside the folder are refused.
            with open_inside(self.root, name) as stream:
                yield stream
        except OSError as error:
            raise reading_error(self.root / name, error, "make the data set again") from error

    def has(self, name: str) -> bool:
        """Return whether the file exists."""
        try:
            return is_inside_name(name) and (self.root / name).is_file()
        except OSError as error:
            raise reading_error(self.root / name, error, "check its permissions") from error

    def names(self, folder: str = "") -> Iterator[str]:
        """Yield the names of all complete files below `folder`, in any order."""
        for path, _, files in os.walk(self.root / folder):
            below = Path(path).relative_to(self.root)
            yield from ((below / file).as_posix() for file in files if not is_partial(file))

    def remove(self, folder: str) -> None:
        """Remove a folder and its content, if it exists."""
        shutil.rmtree(self.root / folder, ignore_errors=True)

    def sweep(self) -> None:
        """Remove incomplete files; no other program may write at the same time."""
        for path, _, files in os.walk(self.root):
            for file in files:
                if is_partial(file):
                    (Path(path) / file).unlink(missing_ok=True)


@lru_cache(maxsize=1)
def _sync_pool() -> ThreadPoolExecutor:
    # The threads are kept, because starting them takes as long as synchronising a few files.
    return ThreadPoolExecutor(_SYNC_THREADS, "sync")


if hasattr(os, "register_at_fork"):
    # A forked process does not inherit the threads.
    os.register_at_fork(after_in_child=_sync_pool.cache_clear)


def _sync_file(path: Path) -> None:
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise storage_error(path, error) from error


# Blocks of remote objects that are kept in memory, 256 MB in total. By default s3fs reads 50 MB ahead, so reading one
# image would fetch the whole tar file.
_BLOCK: Final = 1 << 18
_MOST_BLOCKS: Final = 1 << 10
_LARGEST_KEPT_READ: Final = 1 << 23  # Larger reads, bytes, are not kept; a group of a Parquet file is smaller
_blocks: Final[dict[tuple[str, int], bytes]] = {}
_blocks_lock: Final = threading.Lock()


@lru_cache(maxsize=1)
def _shared_blocks() -> str:
    """Register a cache of fsspec that all open objects share, and return its name."""
    from fsspec.caching import BaseCache, register_cache

    class SharedBlocks(BaseCache):
        name = "crop-blocks"

        def __init__(self, blocksize: int, fetcher: Callable[[int, int], bytes], size: int, key: str) -> None:
            super().__init__(blocksize, fetcher, size)
            self._key = key

        def _fetch(self, start: int | None, stop: int | None) -> bytes:
            first, last = start or 0, self.size if stop is None else min(stop, self.size)
            if last - first > _LARGEST_KEPT_READ:
                return self.fetcher(first, last)
            keys = [(self._key, number) for number in range(first // _BLOCK, -(-last // _BLOCK))]
            with _blocks_lock:
                found = {key: _blocks.pop(key) for key in keys if key in _blocks}
            missing = [key for key in keys if key not in found]
            if missing:
                begin, end = missing[0][1] * _BLOCK, (missing[-1][1] + 1) * _BLOCK
                data = self.fetcher(begin, min(end, self.size))
                for number in range(missing[0][1], missing[-1][1] + 1):
                    found[self._key, number] = data[number * _BLOCK - begin :][:_BLOCK]
            with _blocks_lock:
                _blocks.update(found)
                while len(_blocks) > _MOST_BLOCKS:
                    del _blocks[next(iter(_blocks))]
            return b"".join(found[key] for key in keys)[first % _BLOCK :][: max(0, last - first)]

    register_cache(SharedBlocks, clobber=True)
    return SharedBlocks.name


class _RemoteFile(io.RawIOBase):
    """An open object for `io.BufferedReader`, because streams of fsspec take no size in `readline`."""

    def __init__(self, stream: Any, translated_errors: Callable[[], AbstractContextManager[None]]) -> None:
        self._stream, self._translated_errors = stream, translated_errors

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        with self._translated_errors():
            data = self._stream.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return int(self._stream.seek(offset, whence))

    def tell(self) -> int:
        return int(self._stream.tell())

    def close(self) -> None:
        self._stream.close()
        super().close()


@dataclass(frozen=True)
class RemoteStore:
    """A location in an object store."""

    url: str

    def __post_init__(self) -> None:
        _ = self._root

    @property
    def location(self) -> str:
        """The URL for messages; passwords and other secrets are masked."""
        return masked(self.url.rstrip("/"))

    @property
    def _files(self) -> AbstractFileSystem:
        # The file system is not an attribute, because this object is sent to workers. fsspec caches file systems.
        return filesystem(self.url)[0]

    @property
    def _root(self) -> str:
        return filesystem(self.url)[1].rstrip("/")

    def put(self, name: str, data: bytes | Pieces) -> None:
        """Write an object."""
        content = data if isinstance(data, bytes) else join_pieces(data)
        with self._translated_errors(name):
            self._write(name, lambda files, path: files.pipe_file(path, content))

    @contextmanager
    def create(self, name: str) -> Generator[BinaryIO]:
        """Open a new object for writing; it is sent at the end of the block, unless the block raises."""
        # A temporary file of this machine holds the bytes, so that a failed block sends nothing.
        with tempfile.NamedTemporaryFile(prefix="crop-") as stream:
            yield cast("BinaryIO", stream)
            stream.flush()
            with self._translated_errors(name):
                self._write(name, lambda files, path: files.put_file(stream.name, path))

    def sync(self, names: Iterable[str]) -> None:
        """Do nothing: a store keeps every object that it has accepted."""
        del names

    def get(self, name: str) -> bytes:
        """Return the bytes of an object; raises FormatError."""
        _require_inside(self.location, name)
        with self._translated_errors(name, "read"):
            return self._files.cat_file(self._path(name))

    @contextmanager
    def open(self, name: str, scattered: bool = False) -> Generator[BinaryIO]:
        """Open an object for reading; raises FormatError. `scattered`: only some parts are read, perhaps repeatedly."""
        _require_inside(self.location, name)
        with self._translated_errors(name, "read"):
            files, path = self._files, self._path(name)
            options: dict[str, Any] = {}
            if scattered:
                # The key has the version that the store reports, so that blocks of a replaced object are not used.
                key = f"{self.url} {name} {files.info(path)}"
                options = {"block_size": _BLOCK, "cache_type": _shared_blocks(), "cache_options": {"key": key}}
            stream = files.open(path, "rb", **options)
        with io.BufferedReader(_RemoteFile(stream, lambda: self._translated_errors(name, "read")), _BUFFER) as file:
            yield file

    def has(self, name: str) -> bool:
        """Return whether the object exists."""
        with self._translated_errors(name, "read"):
            return self._files.exists(self._path(name))

    def names(self, folder: str = "") -> Iterator[str]:
        """Return the names of all objects below `folder`."""
        with self._translated_errors(folder, "read"):
            paths = self._files.find(self._path(folder))
        return (path[len(self._root) :].lstrip("/") for path in paths)

    def remove(self, folder: str) -> None:
        """Remove all objects below `folder`."""
        with self._translated_errors(folder):
            if self._files.exists(self._path(folder)):
                self._files.rm(self._path(folder), recursive=True)

    def _write(self, name: str, write: Callable[[AbstractFileSystem, str], object]) -> None:
        files, path = self._files, self._path(name)
        try:
            write(files, path)
        except Exception:
            protocols = {files.protocol} if isinstance(files.protocol, str) else set(files.protocol)
            if not protocols & _WITH_FOLDERS:
                raise
            files.makedirs(path.rpartition("/")[0], exist_ok=True)
            write(files, path)

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}" if name else self._root

    @contextmanager
    def _translated_errors(self, name: str, action: str = "write") -> Generator[None]:
        try:
            yield
        except (CropError, MemoryError):
            raise
        except Exception as error:
            raise remote_error(error, action, f"{self.location}/{name}".rstrip("/")) from error


def _require_inside(location: str, name: str) -> None:
    if not is_inside_name(name):
        raise FormatError(
            f"{location}: {name!r} is not a file name inside the data set; get it again from a trusted source"
        )


Store = LocalStore | RemoteStore  # Files below one location


def read_bounded(store: Store, name: str, most_bytes: int) -> bytes:
    """Return the bytes of a file; raises FormatError if it cannot be read or is larger than `most_bytes`."""
    with store.open(name) as stream:
        data = stream.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise FormatError(f"{store.location}/{name} is damaged: it has more than {most_bytes} bytes; copy it again")
    return data


def join_pieces(pieces: Pieces) -> bytes:
    """Return the pieces of a file as one object."""
    return b"".join([bytes(piece) for piece in pieces])


def open_store(location: str | Path) -> Store:
    """Return the store of a path or URL without accessing it."""
    if isinstance(location, str) and is_remote(location):
        return RemoteStore(location)
    return LocalStore(local_path(location))
