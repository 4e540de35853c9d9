"""Files below one place: a folder of this machine, or any object store that fsspec reaches.

Rules that hold inside:

- A file is there whole or not at all. Two programs may write one name at once: the later file replaces the earlier.
- Only files that were synchronised (`Store.sync`) are sure to survive a loss of power. To synchronise many at once
  costs one wait, not many.
- An object store has no rename and needs none: an object appears when its last byte has arrived.

A place is a path or a URL as a user writes it; a name is a path below it, with forward slashes.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast

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
from foundation.secret_texts import masked

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem


DESCRIPTION: Final = "dataset.json"  # Name of the file that marks a place as a complete dataset; it is written last


def is_remote(place: str) -> bool:
    """Return whether `place` is a URL of a store and not a path of this machine (file:// is a path)."""
    scheme, found, _ = place.partition("://")
    return bool(found) and scheme not in ("file", "local")


def local_path(place: str | Path) -> Path:
    """Return the path of a place of this machine, of which file:// may be the first part; it ends in a name."""
    text = str(place)
    for scheme in ("file://", "local://"):
        text = text.removeprefix(scheme)
    path = Path(text)
    if text and path.name in ("", ".."):
        path = path.resolve()
    if not path.name:
        raise InputError(f"{str(place)!r} names no place; name a folder, such as dataset")
    return path


def filesystem(url: str) -> tuple[AbstractFileSystem, str]:
    """Return the store of a URL, by fsspec, and the path in it."""
    from fsspec.core import url_to_fs

    try:
        return url_to_fs(url)
    except Exception as error:
        # A store may connect here, and has errors of its own (ftplib's are no OSError).
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"cannot reach {url}: {reason}; name a store that fsspec knows, and install its library (s3://: s3fs, "
            "gs://: gcsfs, az://: adlfs)"
        ) from error


Pieces = Iterable[bytes | memoryview]  # A file's bytes in order; a piece is valid until the next is asked for

# Files synchronised at a time: a file system commits its journal once for all that wait, so that sixteen waits cost
# little more than one.
_SYNC_THREADS: Final = 16

# Bytes that are gathered before they are written; larger pieces are written as they are. Python asks the system twice
# for a size where none is given, and each question hands the interpreter's lock to another thread.
_BUFFER: Final = 1 << 16

# Stores by fsspec's names in which a file lies in a folder that has to be there; an object store might make a bucket
# of it.
_WITH_FOLDERS: Final = frozenset({"ftp", "sftp", "ssh", "smb", "webdav", "webdavs", "hdfs", "arrow_hdfs"})


@dataclass(frozen=True)
class LocalStore:
    """A folder of this machine. The folder itself is never made here: a dataset that was finished stays finished."""

    root: Path

    @property
    def place(self) -> str:
        """The folder, for messages and records."""
        return str(self.root)

    def put(self, name: str, data: bytes | Pieces) -> None:
        """Write a file; a StorageError says why it cannot be."""
        with self.create(name) as stream:
            for piece in (data,) if isinstance(data, bytes) else data:
                stream.write(piece)

    def append(self, name: str, data: bytes) -> None:
        """Add to the end of a file, made where it is missing; a kill or a full disk may cut what is added."""
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
        """Open a file to be written; it appears when the block ends well, and is on the disk once synchronised."""
        path = self.root / name
        # Named by chance, because two programs may be at the same shard; see `foundation.files.is_partial`.
        hidden = partial_path(path.with_name(f"{path.name}.{secrets.token_hex(8)}"))
        try:
            try:
                stream = hidden.open("wb", _BUFFER)
            except FileNotFoundError:
                self._make_folder(path.parent)
                stream = hidden.open("wb", _BUFFER)
            with stream:
                yield stream
            hidden.replace(path)
        except BaseException as error:
            with contextlib.suppress(OSError):
                hidden.unlink(missing_ok=True)
            if isinstance(error, OSError) and not isinstance(error, CropError):
                raise storage_error(path, error) from error
            raise

    def _make_folder(self, folder: Path) -> None:
        if not self.root.is_dir():
            raise StorageError(f"{self.root} is gone: the dataset was finished or removed meanwhile")
        folder.mkdir(parents=True, exist_ok=True)

    def sync(self, names: Iterable[str]) -> None:
        """Wait until these files and their names are on the disk."""
        paths = [self.root / name for name in names]
        list(_syncing().map(_sync_file, paths))
        for folder in {path.parent for path in paths}:
            sync_folder(folder)

    def get(self, name: str) -> bytes:
        """Return a file's bytes; a FormatError says why they cannot be read."""
        with self.open(name) as stream:
            return stream.read()

    @contextmanager
    def open(self, name: str) -> Generator[BinaryIO]:
        """Open a file to be read in order; a FormatError says why it cannot be."""
        try:
            # A dataset may be a stranger's, and its lists may name anything.
            with open_inside(self.root, name) as stream:
                yield stream
        except OSError as error:
            raise reading_error(self.root / name, error, "make the dataset again") from error

    def has(self, name: str) -> bool:
        """Return whether there is such a file."""
        try:
            return is_inside_name(name) and (self.root / name).is_file()
        except OSError as error:
            raise reading_error(self.root / name, error, "see that it may be read") from error

    def names(self, folder: str = "") -> Iterator[str]:
        """Return the names of all files below `folder`, in no order; writes that never finished are left out."""
        for path, _, files in os.walk(self.root / folder):
            below = Path(path).relative_to(self.root)
            yield from ((below / file).as_posix() for file in files if not is_partial(file))

    def remove(self, folder: str) -> None:
        """Remove a folder with all that is below it, if it is there."""
        shutil.rmtree(self.root / folder, ignore_errors=True)

    def sweep(self) -> None:
        """Remove writes that never finished; nobody else may be writing."""
        for path, _, files in os.walk(self.root):
            for file in files:
                if is_partial(file):
                    (Path(path) / file).unlink(missing_ok=True)


@lru_cache(maxsize=1)
def _syncing() -> ThreadPoolExecutor:
    """Return the threads that synchronise files: to start them for a few files takes as long as the files do."""
    return ThreadPoolExecutor(_SYNC_THREADS, "sync")


if hasattr(os, "register_at_fork"):
    # A program that is forked has none of them.
    os.register_at_fork(after_in_child=_syncing.cache_clear)


def _sync_file(path: Path) -> None:
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise storage_error(path, error) from error


@dataclass(frozen=True)
class RemoteStore:
    """A place of an object store."""

    url: str

    def __post_init__(self) -> None:
        _ = self._root

    @property
    def place(self) -> str:
        """The URL, for people: user, password and other secrets in it are masked."""
        return masked(self.url.rstrip("/"))

    @property
    def _files(self) -> AbstractFileSystem:
        # Asked for each time: fsspec keeps one for each URL, and what is sent to a worker must not hold one.
        return filesystem(self.url)[0]

    @property
    def _root(self) -> str:
        return filesystem(self.url)[1].rstrip("/")

    def put(self, name: str, data: bytes | Pieces) -> None:
        """Write an object."""
        whole = data if isinstance(data, bytes) else joined(data)
        with self._translated_errors(name):
            self._write(name, lambda files, path: files.pipe_file(path, whole))

    @contextmanager
    def create(self, name: str) -> Generator[BinaryIO]:
        """Open a temporary file to be written; it becomes the object when the block ends well."""
        # Objects are sent from a file of this machine, so that a block that fails sends nothing.
        with tempfile.NamedTemporaryFile(prefix="crop-") as stream:
            yield cast("BinaryIO", stream)
            stream.flush()
            with self._translated_errors(name):
                self._write(name, lambda files, path: files.put_file(stream.name, path))

    def sync(self, names: Iterable[str]) -> None:
        """Return at once: a store that accepted an object keeps it."""
        del names

    def get(self, name: str) -> bytes:
        """Return an object's bytes."""
        _require_inside(self.place, name)
        with self._translated_errors(name, reading=True):
            return self._files.cat_file(self._path(name))

    @contextmanager
    def open(self, name: str) -> Generator[BinaryIO]:
        """Open an object to be read."""
        _require_inside(self.place, name)
        with self._translated_errors(name, reading=True):
            stream = self._files.open(self._path(name), "rb")
        with stream:
            yield stream

    def has(self, name: str) -> bool:
        """Return whether there is such an object."""
        with self._translated_errors(name, reading=True):
            return self._files.exists(self._path(name))

    def names(self, folder: str = "") -> Iterator[str]:
        """Return the names of all objects below `folder`."""
        with self._translated_errors(folder, reading=True):
            found = self._files.find(self._path(folder))
        return (path[len(self._root) :].lstrip("/") for path in found)

    def remove(self, folder: str) -> None:
        """Remove all objects below `folder`."""
        with self._translated_errors(folder):
            if self._files.exists(self._path(folder)):
                self._files.rm(self._path(folder), recursive=True)

    def _write(self, name: str, write: Callable[[AbstractFileSystem, str], object]) -> None:
        """Write an object; where a store has folders, those above it are made when they are missing."""
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
    def _translated_errors(self, name: str, reading: bool = False) -> Generator[None]:
        try:
            yield
        except (CropError, MemoryError):
            raise
        except Exception as error:
            reason = masked(" ".join(f"{type(error).__name__}: {error}".split()))
            if reading:
                raise FormatError(
                    f"cannot read {self.place}/{name}: {reason}; check the address and that you may read there"
                ) from error
            raise StorageError(
                f"cannot write {self.place}/{name}: {reason}; check the address and that you may write there, then run "
                "the same command again"
            ) from error


def _require_inside(place: str, name: str) -> None:
    if not is_inside_name(name):
        raise FormatError(
            f"{place}: {name!r} is no name of a file inside the dataset; it is damaged, or not to be trusted"
        )


Store = LocalStore | RemoteStore  # Files below one place


def read_bounded(store: Store, name: str, most_bytes: int) -> bytes:
    """Return the bytes of a file; a FormatError says why they cannot be read, or that there are more than expected."""
    with store.open(name) as stream:
        data = stream.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise FormatError(
            f"{store.place}/{name} has more than {most_bytes} bytes, which no dataset's has; it is damaged"
        )
    return data


def joined(pieces: Pieces) -> bytes:
    """Return pieces of a file as one."""
    return b"".join([bytes(piece) for piece in pieces])


def open_store(place: str | Path) -> Store:
    """Return the store at a path or URL; nothing is looked at yet."""
    if isinstance(place, str) and is_remote(place):
        return RemoteStore(place)
    return LocalStore(local_path(place))
