"""Files and folders that appear whole or not at all, and SHA-256 of what they hold (FIPS 180-4).

Everything that CroP writes under a final name goes through here: written beside its place under a hidden name,
flushed to the disk, then renamed. A crash leaves a hidden leftover, never a half file; nothing is ever overwritten
that the caller did not mean to replace.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import errno
import hashlib
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from io import BufferedRandom
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeGuard

from foundation.errors import RUN_AGAIN, FormatError, InputError, StorageError

_PARTIAL = ".partial"
_A_LINK = "it is a link to a place that is not there: make or mount that place, or name another"
_PART_IS_A_FILE = "a part of that path is a file, not a folder; name another"
_REMEDIES = {
    errno.EACCES: "ask its owner for permission, or name another place",
    errno.EPERM: "ask its owner for permission, or name another place",
    errno.EISDIR: "a folder is called so; name a file",
    errno.ENOTDIR: _PART_IS_A_FILE,
    errno.ENAMETOOLONG: "name it shorter",
    errno.ELOOP: "links there lead in a circle; name the place that is meant",
}
_GONE = f"the disk is gone: connect and mount it, {RUN_AGAIN}"
_SERVER = f"the server of that folder does not answer: see to the network and to the server, {RUN_AGAIN}"
_DISK_REMEDIES = {
    "ENOSPC": f"free space or choose another disk, {RUN_AGAIN}",
    "EDQUOT": f"what this user may use of the disk is used up: remove files there, or ask for more, {RUN_AGAIN}",
    "EFBIG": f"no file may be so large there (FAT32 ends at 4 GiB; ulimit -f): choose another disk, {RUN_AGAIN}",
    "EROFS": f"name another place, or mount it for writing (dmesg says if it was errors), {RUN_AGAIN}",
    "EIO": (
        "the disk fails: see what dmesg says, check its cable, copy what is on it to another while it can be read, "
        f"{RUN_AGAIN}"
    ),
    "ENODEV": _GONE,
    "ENXIO": _GONE,
    "ENOMEDIUM": _GONE,
    "ENOENT": f"its folder is gone: connect and mount the disk it was on, {RUN_AGAIN}",
    "ESTALE": f"the folder was taken away or mounted anew on its server: mount it again here, {RUN_AGAIN}",
    "ENOTCONN": _SERVER,
    "EREMOTEIO": _SERVER,
    "EHOSTDOWN": _SERVER,
    "EUCLEAN": f"the file system is damaged: unmount it and have it checked (fsck), {RUN_AGAIN}",
    "EMFILE": f"close other programs, or allow more open files (ulimit -n), {RUN_AGAIN}",
    "ENFILE": f"close other programs, {RUN_AGAIN}",
}
"""What helps against each fault of a disk, by the names of errno(3); not every system knows all of them."""
_DISK_FAULTS = {getattr(errno, name): remedy for name, remedy in _DISK_REMEDIES.items() if hasattr(errno, name)}
_NAMELESS = (_DISK_FAULTS.keys() | {errno.EACCES, errno.EPERM}) - {errno.ENOENT, errno.ENOTCONN}
"""Faults of a write to an open file, of which the system does not say which one: these cannot be a socket's, nor a
file's that somebody reads meanwhile."""


ATTEMPTS = 1000
"""How often a folder is made anew that another program takes away meanwhile: programs do so once or twice, special file
systems (/proc) for ever."""


def cache_folder() -> Path | None:
    r"""Return the user's folder for what can be computed again, or None if there is no home.

    `$XDG_CACHE_HOME/croplab` or `~/.cache/croplab` (XDG Base Directory Specification 0.8), on macOS
    `~/Library/Caches/croplab`, on Windows `%LOCALAPPDATA%\croplab\Cache`. A relative `XDG_CACHE_HOME` is ignored, as
    that specification says.
    """
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if given.is_absolute():
        return given / "croplab"
    local = os.environ.get("LOCALAPPDATA")
    if sys.platform == "win32" and local:
        return Path(local) / "croplab" / "Cache"
    try:
        home = Path.home()
    except RuntimeError:
        return None
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "croplab"


def partial_path(path: Path) -> Path:
    """Return the hidden name under which `path` is written before it is complete."""
    return path.with_name(f".{path.name}{_PARTIAL}")


def is_partial(name: str) -> bool:
    """Return whether a file or folder called `name` is a leftover of a write that never finished."""
    return name.startswith(".") and name.endswith(_PARTIAL)


def remedy_of(error: OSError) -> str | None:
    """Return what helps against a fault of the path that was named; None if the fault is another."""
    return _REMEDIES.get(error.errno or 0)


def disk_remedy_of(error: OSError) -> str | None:
    """Return what helps against a fault of the disk, not of the path; None if the fault is another."""
    return _DISK_FAULTS.get(error.errno or 0)


def storage_error(path: Path, error: OSError, what: str = "write") -> InputError | StorageError:
    """Return what went wrong at `path` as one sentence with its remedy; an InputError if the name is to blame."""
    remedy = remedy_of(error)
    by_name = remedy is not None and not isinstance(error, PermissionError)
    return (InputError if by_name else StorageError)(
        f"cannot {what} {path}: {error.strerror or error}; "
        f"{remedy or disk_remedy_of(error) or f'see to the disk, or choose another, {RUN_AGAIN}'}"
    )


def _making_error(path: Path, error: OSError) -> InputError | StorageError:
    """Return why `path` cannot be made: where its folder is there, no disk is gone that would have to be mounted."""
    made = error.filename if error.errno == errno.ENOENT and error.filename2 is None else None
    if isinstance(made, str | bytes) and Path(os.fsdecode(made)).parent.is_dir():
        return InputError(
            f"cannot write {path}: {error.strerror}; the system lets nobody make files there; name a place on an "
            "ordinary disk"
        )
    return storage_error(path, error)


def reading_error(path: Path, error: OSError, remedy: str, what: str = "") -> FormatError | StorageError:
    """Return why `path` cannot be read: the disk's fault with its own remedy, else the file's with `remedy`."""
    of_disk = disk_remedy_of(error) if error.errno != errno.ENOENT else None
    named = f"{what} {path}" if what else str(path)
    kind = StorageError if of_disk else FormatError
    return kind(f"cannot read {named}: {error.strerror or error}", remedy=of_disk or remedy)


def read_text(path: Path, remedy: str, what: str = "") -> str:
    """Return a file's text, UTF-8; else raise a FormatError, or a StorageError where the disk is to blame."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise reading_error(path, error, remedy, what) from error
    except UnicodeDecodeError as error:
        raise _not_utf_8(path, error, remedy) from error


def _not_utf_8(path: Path, error: UnicodeDecodeError, remedy: str) -> FormatError:
    """Return what to tell of a file that is a text in another encoding, or none."""
    begin, before = error.object[:4], error.object[: error.start]
    if begin.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        problem = "a text in UTF-16, UTF-8 was expected"
    elif b"\0" in error.object:
        return FormatError("no text", about=path, remedy=remedy)
    else:
        problem = (
            f"no text in UTF-8: line {before.count(10) + 1} has the byte 0x{error.object[error.start]:02x}, as letters "
            "with accents have in Latin-1 (Windows-1252)"
        )
    return FormatError(problem, about=path, remedy="save it as UTF-8, which editors offer at Save as")


def read_csv(path: Path, remedy: str, what: str = "") -> tuple[list[str], list[dict[str, str]]]:
    """Return the columns that the first line of a CSV file names, and its rows by them; errors as of `read_text`.

    Cells that a short line lacks are empty.
    """
    table = csv.DictReader(io.StringIO(read_text(path, remedy, what)), restval="")
    try:
        return list(table.fieldnames or ()), list(table)
    except csv.Error as error:
        raise FormatError(f"no CSV: {error}", about=path, remedy=remedy) from error


def _is_ours(error: BaseException, path: Path) -> TypeGuard[OSError]:
    """Return whether `error` is about writing `path`, rather than about something that the caller read meanwhile."""
    if not isinstance(error, OSError):
        return False
    if not isinstance(error.filename, str | bytes):
        return error.errno in _NAMELESS
    about, partial = Path(os.fsdecode(error.filename)), partial_path(path)
    return about in (path, partial, *path.parents) or partial in about.parents


def make_folder(folder: Path, of: Path | None = None) -> None:
    """Make a folder and those above it, where they are missing.

    `of`: what the folder is made for, named in the messages; the folder itself if None.
    """
    path = folder if of is None else of
    for _ in range(ATTEMPTS):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            # Another program may have taken it away between two calls.
            if os.path.lexists(folder) and not folder.is_dir():
                raise InputError(
                    f"cannot write {path}: {_A_LINK if folder.is_symlink() else _PART_IS_A_FILE}"
                ) from error
        except NotADirectoryError as error:
            raise InputError(f"cannot write {path}: {_PART_IS_A_FILE}") from error
        except OSError as error:
            raise _making_error(path, error) from error
        else:
            return
    raise StorageError(f"cannot write {path}: its folder is there and not there; name a place on an ordinary disk")


def sync_folder(folder: Path) -> None:
    """Make the names in `folder` durable; does nothing where the system cannot."""
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        # Systems that cannot flush a folder say EINVAL, ENOTSUP or EACCES.
        if disk_remedy_of(error):
            raise storage_error(folder, error) from error


@contextmanager
def whole_file(path: Path, final: Callable[[], Path] | None = None, *, make: bool = True) -> Generator[BufferedRandom]:
    """Open `path` for writing (and reading back) so that it appears complete, or not at all.

    An existing file of that name is replaced at the very end.
    """
    partial = partial_path(path)
    if make:
        make_folder(path.parent, path)
    try:
        with partial.open("w+b") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(final() if final else path)
        sync_folder(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        if _is_ours(error, path):
            raise _making_error(path, error) from error
        raise


def read_whole(path: Path) -> memoryview:
    """Return a large file's bytes, read only: for a `bytes` object the system clears each page of memory first."""
    import numpy as np

    with path.open("rb", buffering=0) as stream:
        # Large arrays are of large pages, a five-hundredth of the faults.
        room = np.empty(os.fstat(stream.fileno()).st_size, np.uint8).data
        filled = 0
        while filled < len(room) and (count := stream.readinto(room[filled:])):
            filled += count
        rest = stream.read()
    return memoryview(bytes(room[:filled]) + rest) if rest else room[:filled].toreadonly()


def write_whole(path: Path, data: bytes | str) -> None:
    """Write `data` (text as UTF-8) to `path`, complete or not at all; see `whole_file`."""
    with whole_file(path) as stream:
        stream.write(data.encode() if isinstance(data, str) else data)


def require_free(path: Path, what: str) -> None:
    """Refuse when `path` exists and is not an empty folder."""
    try:
        empty = path.is_dir() and not any(path.iterdir())
    except OSError as error:
        if disk_remedy_of(error) is None:
            raise
        raise storage_error(path, error, "look into") from error
    if not empty:
        require_free_file(path, what)


def require_free_file(path: Path, what: str) -> None:
    """Refuse when `path` exists, be it an empty folder, or nothing can be written there."""
    try:
        taken = path.exists() or path.is_symlink()
        folder = next(above for above in path.absolute().parents if above.exists())
        probed = not taken and folder.is_dir()
    except OSError as error:
        if disk_remedy_of(error) is None:
            raise
        raise storage_error(path, error, "look at") from error
    if taken:
        raise InputError(f"{path} already exists; name another place for {what}, or remove what is there")
    if probed:
        try:
            # What permissions and mounts say is not always so: only a file that was made says that one can be.
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise storage_error(path, error) from error


def publish_folder(folder: Path, path: Path, what: str) -> None:
    """Give a folder that is complete its final name, durably.

    `path`: the final name; must be free, or an empty folder.
    """
    require_free(path, what)
    try:
        folder.replace(path)
    except OSError as error:
        raise storage_error(path, error) from error
    sync_folder(path.parent)


@contextmanager
def whole_folder(path: Path, what: str) -> Generator[Path]:
    """Build a folder under a hidden name and give it its final name when the block ends well.

    `path`: the final name; must be free, or an empty folder.
    """
    require_free(path, what)
    partial = partial_path(path)
    make_folder(path.parent, path)
    try:
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir()
        yield partial
        publish_folder(partial, path, what)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if _is_ours(error, path):
            raise storage_error(path, error) from error
        raise


_BLOCK: Final = 1 << 20
"""Bytes read at a time: a block stays in the processor's second cache."""


def sha256_of(data: Any) -> str:
    """Return the SHA-256 of `data`: bytes, or an object with a contiguous buffer such as a C-ordered array."""
    return hashlib.sha256(data).hexdigest()


def stream_sha256(stream: BinaryIO) -> str:
    """Return the SHA-256 of what is left to read of an open file."""
    digest = hashlib.sha256()
    while block := stream.read(_BLOCK):
        digest.update(block)
    return digest.hexdigest()


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return stream_sha256(stream)


class HashingWriter(io.RawIOBase):
    """A stream that is written in order, hashed and counted meanwhile.

    `stream`: takes all bytes of every write, as a buffered file does; it is not closed by this one.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._digest = hashlib.sha256()
        self._written = 0

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, data: Any) -> int:
        """Write bytes, or an object with a contiguous buffer; return the number of bytes."""
        size = memoryview(data).nbytes
        self._digest.update(data)
        self._stream.write(data)
        self._written += size
        return size

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._written

    @property
    def sha256(self) -> str:
        """Hash of all that was written so far."""
        return self._digest.hexdigest()
