"""Atomic writing of files, and safe reading of files and folders from other people.

A file is written under a hidden name in its final folder, flushed to the disk, then renamed. After a crash, an
incomplete file may remain under the hidden name, but never under the final name. Hashes are SHA-256 (FIPS 180-4).

Functions for folders from other people raise a `FormatError` if a file breaks one of these rules:

- A file name that was read from a file must lead to a file inside the folder, without ``..`` and absolute paths.
- Only regular files are opened. The data of a device or pipe may never end, and some devices change when they are read.
- A file that is read as a whole has a size limit. A file that is read line by line has a limit for each line.

A folder is checked once, when it is opened. Later checks would not help, because a person who can change the folder can
also change the content of its files.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import errno
import hashlib
import io
import os
import stat
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from io import BufferedRandom
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeGuard, cast

from foundation.errors import RUN_AGAIN, FormatError, InputError, StorageError

_PARTIAL = ".partial"
_MAX_COMPONENT_BYTES = 255  # NAME_MAX of the usual file systems
_BROKEN_LINK = "it is a link to a place that does not exist: create or mount that place, or choose another path"
_PART_IS_A_FILE = "a part of that path is a file, not a folder; choose another path"
# Remedies for errors of a path, by errno
_REMEDIES = {
    errno.EACCES: "ask its owner for permission, or choose another path",
    errno.EPERM: "ask its owner for permission, or choose another path",
    errno.EISDIR: "it is a folder; give a file",
    errno.ENOTDIR: _PART_IS_A_FILE,
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "its links form a circle; give the path without links",
}
_DISCONNECTED = f"the disk is disconnected: connect and mount it, {RUN_AGAIN}"
_SERVER = f"the server of that folder does not answer: check the network and the server, {RUN_AGAIN}"
# Remedies for errors of a disk, by names of errno(3). Some systems do not define all these names.
_DISK_REMEDIES = {
    "ENOSPC": f"free space or choose another disk, {RUN_AGAIN}",
    "EDQUOT": f"this user's quota on the disk is used up: remove files there, or ask for a larger quota, {RUN_AGAIN}",
    "EFBIG": f"the file is too large there (FAT32 allows 4 GiB; ulimit -f): choose another disk, {RUN_AGAIN}",
    "EROFS": f"choose another path, or mount it for writing (dmesg lists disk errors), {RUN_AGAIN}",
    "EIO": (
        "the disk fails: read the output of dmesg, check its cable, copy its files to another disk while they can "
        f"be read, {RUN_AGAIN}"
    ),
    "ENODEV": _DISCONNECTED,
    "ENXIO": _DISCONNECTED,
    "ENOMEDIUM": _DISCONNECTED,
    "ENOENT": f"its folder is missing: connect and mount its disk, {RUN_AGAIN}",
    "ESTALE": f"the folder was removed or mounted again on its server: mount it again here, {RUN_AGAIN}",
    "ENOTCONN": _SERVER,
    "EREMOTEIO": _SERVER,
    "EHOSTDOWN": _SERVER,
    "EUCLEAN": f"the file system is damaged: unmount it and have it checked (fsck), {RUN_AGAIN}",
    "EMFILE": f"close other programs, or allow more open files (ulimit -n), {RUN_AGAIN}",
    "ENFILE": f"close other programs, {RUN_AGAIN}",
}
_DISK_FAULTS = {getattr(errno, name): remedy for name, remedy in _DISK_REMEDIES.items() if hasattr(errno, name)}
# An error of a write to an open file has no file name. It is recognised by its code. Codes that errors of sockets or
# reads may also have are excluded.
_NAMELESS_WRITE_ERRORS = (_DISK_FAULTS.keys() | {errno.EACCES, errno.EPERM}) - {errno.ENOENT, errno.ENOTCONN}

FOLDER_ATTEMPTS = 1000  # Attempts to make a folder, because another program may remove it at the same time


def partial_path(path: Path) -> Path:
    """Return the hidden name of `path` while it is incomplete."""
    name = f".{path.name}{_PARTIAL}"
    if len(os.fsencode(name)) > _MAX_COMPONENT_BYTES >= len(os.fsencode(path.name)):
        # `path` has an allowed length, but the hidden name would be too long. So it contains a hash of the name.
        name = f".{sha256_of(os.fsencode(path.name))}{_PARTIAL}"
    return path.with_name(name)


def is_partial(name: str) -> bool:
    """Return whether a file or folder with this name remains from an unfinished write."""
    return name.startswith(".") and name.endswith(_PARTIAL)


def path_remedy(error: OSError) -> str | None:
    """Return the remedy for an error caused by the path; None for other errors."""
    return _REMEDIES.get(error.errno or 0)


def disk_remedy(error: OSError) -> str | None:
    """Return the remedy for an error caused by the disk; None for other errors."""
    return _DISK_FAULTS.get(error.errno or 0)


def storage_error(path: Path, error: OSError, action: str = "write") -> InputError | StorageError:
    """Return the error for a failed `action` on `path`, with a remedy; an InputError if the path is the cause."""
    remedy = path_remedy(error)
    is_path_fault = remedy is not None and not isinstance(error, PermissionError)
    return (InputError if is_path_fault else StorageError)(
        f"cannot {action} {path}: {error.strerror or error}; "
        f"{remedy or disk_remedy(error) or f'check the disk, or choose another, {RUN_AGAIN}'}"
    )


def _write_error(path: Path, error: OSError) -> InputError | StorageError:
    # If a file is missing although its folder exists, the file system allows no new files there, as in /proc.
    missing_name = error.filename if error.errno == errno.ENOENT and error.filename2 is None else None
    if isinstance(missing_name, str | bytes) and Path(os.fsdecode(missing_name)).parent.is_dir():
        return InputError(
            f"cannot write {path}: {error.strerror}, the system allows no new files there; choose a path on an "
            "ordinary disk"
        )
    return storage_error(path, error)


def reading_error(path: Path, error: OSError, remedy: str, description: str = "") -> FormatError | StorageError:
    """Return the error for a file that cannot be read: a StorageError if the disk is the cause, else a FormatError.

    `remedy` is used if the disk is not the cause. `description` precedes the path in the message.
    """
    remedy_for_disk = disk_remedy(error) if error.errno != errno.ENOENT else None
    file = f"{description} {path}" if description else str(path)
    error_class = StorageError if remedy_for_disk else FormatError
    return error_class(f"cannot read {file}: {error.strerror or error}", remedy=remedy_for_disk or remedy)


def read_text(path: Path, remedy: str, description: str = "", is_table: bool = False) -> str:
    """Return the text of a file in UTF-8; errors as in `reading_error`.

    A table may also be in UTF-16 with a byte order mark, because spreadsheet programs write this format.
    """
    try:
        data = path.read_bytes()
        text = data.decode(table_encoding(data) if is_table else "utf-8-sig")
    except OSError as error:
        raise reading_error(path, error, remedy, description) from error
    except UnicodeDecodeError as error:
        raise _not_utf_8(path, error, remedy) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def table_encoding(start: bytes) -> str:
    """Return the encoding of a table from its first bytes: UTF-16 with a byte order mark, else UTF-8."""
    return "utf-16" if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"


def _not_utf_8(path: Path, error: UnicodeDecodeError, remedy: str) -> FormatError:
    valid = error.object[: error.start]
    if table_encoding(error.object) == "utf-16" and error.encoding == "utf-8":
        problem = "text in UTF-16, expected UTF-8"
    elif b"\0" in error.object or error.encoding != "utf-8":
        return FormatError("binary data, expected text in UTF-8", about=path, remedy=remedy)
    else:
        problem = (
            f"line {valid.count(10) + 1} has the byte 0x{error.object[error.start]:02x}, expected text in UTF-8; the "
            "file may be in Latin-1 (Windows-1252)"
        )
    return FormatError(problem, about=path, remedy="save it as UTF-8 (Save as in most editors)")


def read_csv(path: Path, remedy: str, description: str = "") -> tuple[list[str], list[dict[str, str]]]:
    """Return the column names of a CSV file and its rows; missing cells are empty. Errors as in `read_text`."""
    table = csv.DictReader(io.StringIO(read_text(path, remedy, description, is_table=True)), restval="")
    try:
        return list(table.fieldnames or ()), list(table)
    except csv.Error as error:
        raise FormatError(f"not a CSV file: {error}", about=path, remedy=remedy) from error


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV text (RFC 4180, lines end with LF); None becomes an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def is_write_error(error: BaseException, path: Path) -> TypeGuard[OSError]:
    """Return whether `error` comes from writing `path`, not from another action of the caller."""
    if not isinstance(error, OSError):
        return False
    if not isinstance(error.filename, str | bytes):
        return error.errno in _NAMELESS_WRITE_ERRORS
    file, partial = Path(os.fsdecode(error.filename)), partial_path(path)
    return file in (path, partial, *path.parents) or partial in file.parents


def make_folder(folder: Path, target: Path | None = None) -> None:
    """Make a folder and its missing parents; error messages name `target`, by default the folder."""
    path = folder if target is None else target
    for _ in range(FOLDER_ATTEMPTS):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            # If the path is free now, another program has removed the file in the meantime; try again.
            if os.path.lexists(folder) and not folder.is_dir():
                raise InputError(
                    f"cannot write {path}: {_BROKEN_LINK if folder.is_symlink() else _PART_IS_A_FILE}"
                ) from error
        except NotADirectoryError as error:
            raise InputError(f"cannot write {path}: {_PART_IS_A_FILE}") from error
        except OSError as error:
            raise _write_error(path, error) from error
        else:
            return
    raise StorageError(f"cannot write {path}: its folder cannot be made; choose a path on an ordinary disk")


def sync_folder(folder: Path) -> None:
    """Flush the file names in `folder` to the disk, if the system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        # Systems that cannot flush a folder raise EINVAL, ENOTSUP or EACCES.
        if disk_remedy(error):
            raise storage_error(folder, error) from error


@contextmanager
def atomic_file(
    path: Path, final: Callable[[], Path] | None = None, *, make_parents: bool = True
) -> Generator[BufferedRandom]:
    """Open a new file for writing and reading. When the block ends, rename it to `path`, or to `final()` if given.

    An existing file is replaced. If the block raises an error, the new file is removed.
    """
    partial = partial_path(path)
    if make_parents:
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
        if is_write_error(error, path):
            raise _write_error(path, error) from error
        raise


def read_buffer(path: Path) -> memoryview:
    """Return the bytes of a large file, read-only."""
    import numpy as np

    with path.open("rb", buffering=0) as stream:
        # An array is faster than `bytes`, because numpy uses large memory pages.
        buffer = np.empty(os.fstat(stream.fileno()).st_size, np.uint8).data
        filled = 0
        while filled < len(buffer) and (count := stream.readinto(buffer[filled:])):
            filled += count
        rest = stream.read()
    return memoryview(bytes(buffer[:filled]) + rest) if rest else buffer[:filled].toreadonly()


def write_atomic(path: Path, data: bytes | str) -> None:
    """Write `data`, text as UTF-8, to `path`; see `atomic_file`."""
    with atomic_file(path) as stream:
        stream.write(data.encode() if isinstance(data, str) else data)


_BLOCK_BYTES: Final = 1 << 20  # Bytes that are read at a time; they fit into the second-level cache of the processor


def sha256_of(data: Any) -> str:
    """Return the SHA-256 of `data`: bytes, or an object with a contiguous buffer such as a C-ordered array."""
    return hashlib.sha256(data).hexdigest()


def stream_sha256(stream: BinaryIO) -> str:
    """Return the SHA-256 of the rest of an open file."""
    digest = hashlib.sha256()
    while block := stream.read(_BLOCK_BYTES):
        digest.update(block)
    return digest.hexdigest()


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return stream_sha256(stream)


class HashingWriter(io.RawIOBase):
    """Stream that writes to a buffered file and hashes and counts the bytes; it does not close the file."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._digest = hashlib.sha256()
        self._written = 0

    def writable(self) -> bool:
        """Return whether the stream can be written."""
        return True

    def write(self, data: Any) -> int:
        """Write bytes, or an object with a contiguous buffer, and return the number of bytes."""
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
        """SHA-256 of the bytes written so far."""
        return self._digest.hexdigest()


# Largest accepted JSON file, in bytes. A data set with a million skipped images needs a third of this size.
MAX_JSON_BYTES: Final = 256 << 20

# Longest accepted line of a file that is read line by line, in bytes. Our own lines have a few hundred bytes.
MAX_LINE_BYTES: Final = 1 << 20

_MAX_NAME_LENGTH: Final = 4096  # PATH_MAX of Linux, in characters

# Largest accepted sum of the holes of a file, in bytes. A hole is a range of zeros without blocks on the disk.
_MAX_HOLE_BYTES: Final = 1 << 30

_MAX_HOLES: Final = 4096  # Number of holes that are measured; the rest of the file counts as data

_COPY_REMEDY: Final = "ask the author for a copy of the folder without it, or copy the folder with cp -rL (no links)"


@lru_cache(8192)
def is_inside_name(name: str) -> bool:
    """Return whether a name that was read from a file is a path below the file's folder; the disk is not read.

    Examples
    --------
    >>> [is_inside_name(name) for name in ("images/000001.png", "../x", "/etc/passwd", "a/../../x", "a//b", "")]
    [True, False, False, False, False, False]
    """
    return (
        0 < len(name) <= _MAX_NAME_LENGTH
        and "\0" not in name
        and not any(component in ("", ".", "..") for component in name.split("/"))
    )


@contextmanager
def open_inside(root: Path, name: str) -> Generator[BinaryIO]:
    """Open a file below a folder for reading; links are followed if they lead to a file in the folder."""
    if not is_inside_name(name):
        raise FormatError(f"{root}: {name!r}, expected the name of a file inside the folder; {_COPY_REMEDY}")
    handle = _open_without_links(root, name)
    if handle is None:
        target = _target_inside(root, name)
        handle = _open_without_links(root, target)
        if handle is None:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(root / name))
    with open(handle, "rb") as stream:  # noqa: PTH123  a descriptor
        _refuse_large_holes(handle, root / name)
        yield stream


def require_plain_folder(folder: Path, max_bytes: Mapping[str, int] | None = None, below: tuple[str, ...] = ()) -> None:
    """Raise a FormatError unless a folder contains only folders, regular files and links to files and folders inside.

    `max_bytes`: size limits of files by name. `below`: subfolders that are also checked.
    """
    try:
        for inner in ("", *below):
            with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder / inner) as entries:
                for entry in entries:
                    _require_plain(folder, f"{inner}/{entry.name}" if inner else entry.name, entry)
        for name, limit in (max_bytes or {}).items():
            _require_size(folder / name, limit)
    except OSError as error:
        raise reading_error(folder, error, "allow reading it") from error


def _require_size(path: Path, limit: int) -> None:
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISREG(status.st_mode) and status.st_size > limit:
        raise FormatError(f"{path} has {status.st_size} bytes, expected at most {limit}; restore it from a copy")


def require_plain_tree(folder: Path) -> None:
    """Raise a FormatError unless a folder contains only folders and regular files, at any depth."""
    for path, folders, files in os.walk(folder):
        for name in (*folders, *files):
            mode = (Path(path) / name).lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise FormatError(f"{Path(path) / name} is {_kind(mode)}, expected a regular file; {_COPY_REMEDY}")


def bounded_lines(stream: BinaryIO, name: str) -> Iterator[bytes]:
    """Yield the lines of a stream; a line longer than `MAX_LINE_BYTES` raises a FormatError that contains `name`."""
    while line := stream.readline(MAX_LINE_BYTES + 1):
        if len(line) > MAX_LINE_BYTES:
            raise FormatError(
                f"{name} has a line of more than {MAX_LINE_BYTES} bytes, which is too long; restore it from a copy"
            )
        yield line


def _parse_json(data: bytes | str, name: str) -> Any:
    import pydantic_core

    # pydantic refuses lone surrogates, which cannot be written as UTF-8; the standard library accepts them.
    try:
        return pydantic_core.from_json(data)
    except ValueError as error:
        raise FormatError(f"{name} is not valid JSON: {error}; restore it from a copy") from error


def parse_json_object(data: bytes | str, name: str) -> dict[str, Any]:
    """Return the object in a JSON text (RFC 8259); another text raises a FormatError that contains `name`."""
    value = _parse_json(data, name)
    if not isinstance(value, dict):
        raise FormatError(
            f"{name} has a value of type {type(value).__name__}, expected a JSON object; restore it from a copy"
        )
    return cast("dict[str, Any]", value)


def _require_plain(folder: Path, name: str, entry: os.DirEntry[str]) -> None:
    if entry.is_symlink():
        target = _target_inside(folder, name)
        mode = (folder.resolve() / target).stat().st_mode
    elif entry.is_file(follow_symlinks=False) or entry.is_dir(follow_symlinks=False):
        return
    else:
        mode = entry.stat(follow_symlinks=False).st_mode
    if not stat.S_ISDIR(mode):
        _require_regular(mode, folder / name)


def _require_regular(mode: int, path: Path) -> None:
    if not stat.S_ISREG(mode):
        raise FormatError(f"{path} is {_kind(mode)}, expected a regular file; {_COPY_REMEDY}")


def _refuse_large_holes(handle: int, path: Path) -> None:
    # A small archive can contain a file of any size that consists mostly of holes (lseek(2), SEEK_HOLE).
    size = os.fstat(handle).st_size
    if size <= _MAX_HOLE_BYTES:
        return
    holes = data = 0
    with suppress(OSError):
        # A file system without holes reports a single hole at the end of the file.
        for _ in range(_MAX_HOLES):
            hole = os.lseek(handle, data, os.SEEK_HOLE)
            if hole >= size:
                break
            holes += size - hole
            data = os.lseek(handle, hole, os.SEEK_DATA)
            holes -= size - data
    os.lseek(handle, 0, os.SEEK_SET)
    if holes > _MAX_HOLE_BYTES:
        raise FormatError(f"{path} has a size of {size} bytes, of which {size - holes} are data; {_COPY_REMEDY}")


def _kind(mode: int) -> str:
    kinds = (
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISLNK, "a link"),
        (stat.S_ISFIFO, "a pipe"),
        (stat.S_ISSOCK, "a socket"),
    )
    return next((name for is_kind, name in kinds if is_kind(mode)), "a device")


def _open_without_links(root: Path, name: str) -> int | None:
    """Open a file without following links and return its descriptor; None if a part of its path is a link."""
    *folders, file = name.split("/")
    handle = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for folder in folders:
            inner = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=handle)
            os.close(handle)
            handle = inner
        mode = os.stat(file, dir_fd=handle, follow_symlinks=False).st_mode
        if stat.S_ISLNK(mode):
            return None
        _require_regular(mode, root / name)
        return os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=handle)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENOTDIR) and _has_link(root, name):
            return None
        raise OSError(error.errno, error.strerror, str(root / name)) from error
    finally:
        os.close(handle)


def _has_link(root: Path, name: str) -> bool:
    path = root
    for component in name.split("/"):
        path = path / component
        if path.is_symlink():
            return True
    return False


def _target_inside(root: Path, name: str) -> str:
    """Resolve the links in a name, and return the resulting name below `root`."""
    top = root.resolve()
    try:
        target = (top / name).resolve(strict=True)
    except (OSError, RuntimeError) as error:
        raise FormatError(f"{root / name} is a link to a file that does not exist; {_COPY_REMEDY}") from error
    if not target.is_relative_to(top) or target == top:
        raise FormatError(f"{root / name} is a link to a place outside {root}; {_COPY_REMEDY}")
    return target.relative_to(top).as_posix()
