"""Where a dataset lies: a folder of this machine, or any object store that fsspec reaches.

Laws that hold inside:

- A file is there whole or not at all. Two programs may write one name at once; with equal bytes nobody can tell.
- Only what was settled is sure to outlast a loss of power. Settling many files at once costs one wait, not many.
- An object store has no rename and needs none: an object appears when its last byte has arrived.

A name is a path below the store's place, with forward slashes.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol, cast

from foundation.errors import CropError, FormatError, InputError, StorageError
from foundation.files import is_partial, partial_path, storage_error, sync_folder

Pieces = Iterable[bytes | memoryview]
"""A file's bytes in order; the memory of one piece may be that of the next."""

DESCRIPTION: Final = "dataset.json"
"""The file that is there where a data set is complete, and nowhere else."""

_WAITING: Final = 16

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem


class Store(Protocol):
    """Files below one place."""

    @property
    def place(self) -> str:
        """The place as a person would write it."""
        ...

    def put(self, name: str, data: bytes | Pieces) -> None:
        """Write a file; a StorageError says why it cannot be."""
        ...

    def create(self, name: str) -> contextlib.AbstractContextManager[BinaryIO]:
        """Open a file to be written in order; it appears when the block ends well."""
        ...

    def settle(self, names: Iterable[str]) -> None:
        """Wait until these files would outlast a loss of power."""
        ...

    def get(self, name: str) -> bytes:
        """Return a file's bytes; a FormatError says why they cannot be had."""
        ...

    def open(self, name: str) -> contextlib.AbstractContextManager[BinaryIO]:
        """Open a file to be read in order; a FormatError says why it cannot be."""
        ...

    def has(self, name: str) -> bool:
        """Return whether there is such a file."""
        ...

    def names(self, folder: str = "") -> Iterator[str]:
        """Return the names of all files below `folder`, in no order; writes that never finished are left out."""
        ...

    def remove(self, folder: str) -> None:
        """Remove a folder with all that is below it, if it is there."""
        ...


@dataclass(frozen=True)
class LocalStore:
    """A folder of this machine. The folder itself is never made here: a dataset that was finished stays finished."""

    root: Path

    @property
    def place(self) -> str:
        """The folder."""
        return str(self.root)

    def put(self, name: str, data: bytes | Pieces) -> None:
        """Write a file."""
        with self.create(name) as stream:
            for piece in (data,) if isinstance(data, bytes) else data:
                stream.write(piece)

    @contextmanager
    def create(self, name: str) -> Generator[BinaryIO]:
        """Open a file to be written; it appears when the block ends well, and is on the disk once settled."""
        path = self.root / name
        # Named by chance, because two programs may be at the same shard; see `foundation.files.is_partial`.
        hidden = partial_path(path.with_name(f"{path.name}.{secrets.token_hex(8)}"))
        try:
            try:
                stream = hidden.open("wb")
            except FileNotFoundError:
                self._make_folder(path.parent)
                stream = hidden.open("wb")
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

    def settle(self, names: Iterable[str]) -> None:
        """Wait until these files and their names are on the disk."""
        paths = [self.root / name for name in names]
        # A file system writes its journal once for all that wait together: sixteen waits cost little more than one.
        with ThreadPoolExecutor(_WAITING) as pool:
            list(pool.map(_settle_file, paths))
        for folder in {path.parent for path in paths}:
            sync_folder(folder)

    def get(self, name: str) -> bytes:
        """Return a file's bytes."""
        with self.open(name) as stream:
            return stream.read()

    @contextmanager
    def open(self, name: str) -> Generator[BinaryIO]:
        """Open a file to be read."""
        path = self.root / name
        try:
            with path.open("rb") as stream:
                yield stream
        except OSError as error:
            raise FormatError(f"cannot read {path}: {error.strerror or error}; make the dataset again") from error

    def has(self, name: str) -> bool:
        """Return whether there is such a file."""
        return (self.root / name).is_file()

    def names(self, folder: str = "") -> Iterator[str]:
        """Return the names of all files below `folder`."""
        for path, _, files in os.walk(self.root / folder):
            below = Path(path).relative_to(self.root)
            yield from ((below / file).as_posix() for file in files if not is_partial(Path(file)))

    def remove(self, folder: str) -> None:
        """Remove a folder with all that is below it, if it is there."""
        shutil.rmtree(self.root / folder, ignore_errors=True)

    def sweep(self) -> None:
        """Remove writes that never finished; nobody else may be writing."""
        for path, _, files in os.walk(self.root):
            for file in files:
                if is_partial(Path(file)):
                    (Path(path) / file).unlink(missing_ok=True)


def _settle_file(path: Path) -> None:
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
    """A place of an object store.

    Raises
    ------
    InputError
        Its URL is of no kind that fsspec knows.
    """

    url: str

    def __post_init__(self) -> None:
        _ = self._root

    @property
    def place(self) -> str:
        """The URL."""
        return self.url.rstrip("/")

    @property
    def _files(self) -> AbstractFileSystem:
        # Asked for each time: fsspec keeps one for each URL, and what is sent to a worker must not hold one.
        return filesystem(self.url)[0]

    @property
    def _root(self) -> str:
        return filesystem(self.url)[1].rstrip("/")

    def put(self, name: str, data: bytes | Pieces) -> None:
        """Write an object."""
        whole = data if isinstance(data, bytes) else gathered(data)
        with self._said(name):
            self._files.pipe_file(self._path(name), whole)

    @contextmanager
    def create(self, name: str) -> Generator[BinaryIO]:
        """Open a temporary file to be written; it becomes the object when the block ends well."""
        # Objects are sent from a file of this machine, so that a block that fails sends nothing.
        with tempfile.NamedTemporaryFile(prefix="crop-") as stream:
            yield cast("BinaryIO", stream)
            stream.flush()
            with self._said(name):
                self._files.put_file(stream.name, self._path(name))

    def settle(self, names: Iterable[str]) -> None:
        """Return at once: an object that has been taken is the store's to keep."""
        del names

    def get(self, name: str) -> bytes:
        """Return an object's bytes."""
        with self._said(name, reading=True):
            return self._files.cat_file(self._path(name))

    @contextmanager
    def open(self, name: str) -> Generator[BinaryIO]:
        """Open an object to be read."""
        with self._said(name, reading=True):
            stream = self._files.open(self._path(name), "rb")
        with stream:
            yield stream

    def has(self, name: str) -> bool:
        """Return whether there is such an object."""
        with self._said(name, reading=True):
            return self._files.exists(self._path(name))

    def names(self, folder: str = "") -> Iterator[str]:
        """Return the names of all objects below `folder`."""
        with self._said(folder, reading=True):
            found = self._files.find(self._path(folder))
        return (path[len(self._root) :].lstrip("/") for path in found)

    def remove(self, folder: str) -> None:
        """Remove all objects below `folder`."""
        with self._said(folder):
            if self._files.exists(self._path(folder)):
                self._files.rm(self._path(folder), recursive=True)

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}" if name else self._root

    @contextmanager
    def _said(self, name: str, reading: bool = False) -> Generator[None]:
        """Translate what the library of a store may raise, whichever it is, into one sentence of ours."""
        try:
            yield
        except (CropError, MemoryError):
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            if reading:
                raise FormatError(
                    f"cannot read {self.place}/{name}: {reason}; check the address and that you may read there"
                ) from error
            raise StorageError(
                f"cannot write {self.place}/{name}: {reason}; check the address and that you may write there, then run "
                "the same command again"
            ) from error


def gathered(pieces: Pieces) -> bytes:
    """Return pieces as one."""
    return b"".join([bytes(piece) for piece in pieces])


def is_remote(place: str) -> bool:
    """Return whether `place` is a URL of a store and not a path of this machine (file:// is a path)."""
    scheme, found, _ = place.partition("://")
    return bool(found) and scheme not in ("file", "local")


def local_path(place: str | Path) -> Path:
    """Return the path of a place of this machine, of which file:// may be the first part; it ends in a name.

    Raises
    ------
    InputError
        The place is empty, or the root of all folders.
    """
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
    """Return the store of a URL, by fsspec, and the path in it.

    Raises
    ------
    InputError
        No such kind of store is known, or its library is not installed; the message has fsspec's reason.
    """
    from fsspec.core import url_to_fs

    try:
        return url_to_fs(url)
    except (ImportError, ValueError, OSError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"cannot reach {url}: {reason}; name a store that fsspec knows, and install its library (s3://: s3fs, "
            "gs://: gcsfs, az://: adlfs)"
        ) from error


def open_store(place: str | Path) -> Store:
    """Return the store at a path or URL; nothing is looked at yet."""
    if isinstance(place, str) and is_remote(place):
        return RemoteStore(place)
    return LocalStore(local_path(place))
