"""Files: how they appear whole; and the gate to files and folders that somebody else made.

Every file that CroP writes under a final name goes through here, folders through `foundation.folders`: written beside
its place under a hidden name, flushed to the disk, then renamed. A crash leaves a hidden leftover, never a half file;
nothing is ever overwritten that the caller did not mean to replace. What is hashed is hashed by SHA-256 (FIPS 180-4).

Any file of a folder that came from others may hold anything; all that is refused is a `FormatError` that names the
file:

- A name that stands in a file leads to a file inside the folder, or nowhere: no ``..``, no root, no link that leads
  out.
- What is opened is a regular file: a device or a pipe never ends, and some do something when they are read.
- What is read whole has a size that its reader has stated; what is read by lines has lines that end.

Folders are looked at once, when they are opened: who may change one while it is read may change what it says, too.
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
# What helps against each fault of a disk, by the names of errno(3); not every system knows all of them.
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
_DISK_FAULTS = {getattr(errno, name): remedy for name, remedy in _DISK_REMEDIES.items() if hasattr(errno, name)}
# Faults of a write to an open file, of which the system does not say which one: these cannot be a socket's, nor a
# file's that somebody reads meanwhile.
_NAMELESS = (_DISK_FAULTS.keys() | {errno.EACCES, errno.EPERM}) - {errno.ENOENT, errno.ENOTCONN}

# How often a folder is made anew that another program takes away meanwhile: programs do so once or twice, special
# file systems (/proc) for ever.
FOLDER_ATTEMPTS = 1000


def partial_path(path: Path) -> Path:
    """Return the hidden name under which `path` is written before it is complete."""
    return path.with_name(f".{path.name}{_PARTIAL}")


def is_partial(name: str) -> bool:
    """Return whether a file or folder called `name` is a leftover of a write that never finished."""
    return name.startswith(".") and name.endswith(_PARTIAL)


def path_remedy(error: OSError) -> str | None:
    """Return what helps against a fault of the path that was named; None if the fault is another."""
    return _REMEDIES.get(error.errno or 0)


def disk_remedy(error: OSError) -> str | None:
    """Return what helps against a fault of the disk, not of the path; None if the fault is another."""
    return _DISK_FAULTS.get(error.errno or 0)


def storage_error(path: Path, error: OSError, what: str = "write") -> InputError | StorageError:
    """Return what went wrong at `path` as one sentence with its remedy; an InputError if the name is to blame."""
    remedy = path_remedy(error)
    by_name = remedy is not None and not isinstance(error, PermissionError)
    return (InputError if by_name else StorageError)(
        f"cannot {what} {path}: {error.strerror or error}; "
        f"{remedy or disk_remedy(error) or f'see to the disk, or choose another, {RUN_AGAIN}'}"
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
    of_disk = disk_remedy(error) if error.errno != errno.ENOENT else None
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


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV text, RFC 4180 with lines that end with LF; None is left empty."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def is_write_error(error: BaseException, path: Path) -> TypeGuard[OSError]:
    """Return whether `error` is about writing `path`, rather than about something that the caller read meanwhile."""
    if not isinstance(error, OSError):
        return False
    if not isinstance(error.filename, str | bytes):
        return error.errno in _NAMELESS
    about, partial = Path(os.fsdecode(error.filename)), partial_path(path)
    return about in (path, partial, *path.parents) or partial in about.parents


def make_folder(folder: Path, target: Path | None = None) -> None:
    """Make a folder and those above it, where they are missing.

    `target`: what the folder is made for, named in the messages; the folder itself if None.
    """
    path = folder if target is None else target
    for _ in range(FOLDER_ATTEMPTS):
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
        if disk_remedy(error):
            raise storage_error(folder, error) from error


@contextmanager
def atomic_file(path: Path, final: Callable[[], Path] | None = None, *, make: bool = True) -> Generator[BufferedRandom]:
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
        if is_write_error(error, path):
            raise _making_error(path, error) from error
        raise


def read_buffer(path: Path) -> memoryview:
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


def write_atomic(path: Path, data: bytes | str) -> None:
    """Write `data` (text as UTF-8) to `path`, complete or not at all; see `atomic_file`."""
    with atomic_file(path) as stream:
        stream.write(data.encode() if isinstance(data, str) else data)


_BLOCK: Final = 1 << 20  # Bytes read at a time: a block stays in the processor's second cache


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


# JSON is read as far as this: the description of a data set of a million pictures, all skipped, is a third of it.
MAX_JSON_BYTES: Final = 256 << 20

# Longest line of a file that is read by lines: the longest of ours are some hundred bytes, names of files 4096.
MAX_LINE_BYTES: Final = 1 << 20

_MOST_NAME: Final = 4096  # Longest name, as PATH_MAX of Linux has it

# Bytes of a file that its disk need not hold: black pictures are copied with holes, though smaller ones.
_MOST_HOLES: Final = 1 << 30
_LOOKED_AT: Final = 4096  # Holes of a file that are counted; whoever makes more of them has filled as many blocks

_COPY_REMEDY: Final = "ask who made the folder for a copy without it, or copy it with its links resolved (cp -rL)"


@lru_cache(8192)
def is_inside_name(name: str) -> bool:
    """Return whether a name that stands in a file leads to a place below its folder, without looking at the disk.

    Examples
    --------
    >>> [is_inside_name(name) for name in ("images/000001.png", "../x", "/etc/passwd", "a/../../x", "a//b", "")]
    [True, False, False, False, False, False]
    """
    return (
        0 < len(name) <= _MOST_NAME
        and "\0" not in name
        and not any(part in ("", ".", "..") for part in name.split("/"))
    )


@contextmanager
def open_inside(root: Path, name: str) -> Generator[BinaryIO]:
    """Open a file below a folder to be read."""
    if not is_inside_name(name):
        raise FormatError(f"{root}: {name!r} is no name of a file inside the folder; {_COPY_REMEDY}")
    handle = _opened_below(root, name)
    if handle is None:
        inside = _target_inside(root, name)
        handle = _opened_below(root, inside)
        if handle is None:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(root / name))
    with open(handle, "rb") as stream:  # noqa: PTH123  a descriptor
        _require_filled(handle, root / name)
        yield stream


def require_plain_folder(folder: Path, max_bytes: Mapping[str, int] | None = None, below: tuple[str, ...] = ()) -> None:
    """Refuse a folder that holds anything but folders, regular files and links that stay inside."""
    try:
        for inner in ("", *below):
            with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder / inner) as entries:
                for entry in entries:
                    _require_plain(folder, f"{inner}/{entry.name}" if inner else entry.name, entry)
        for name, most in (max_bytes or {}).items():
            _require_size(folder / name, most)
    except OSError as error:
        raise reading_error(folder, error, "see that it may be read") from error


def _require_size(path: Path, most: int) -> None:
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISREG(found.st_mode) and found.st_size > most:
        raise FormatError(
            f"{path} has {found.st_size} bytes, at most {most} expected; it is not what it is called, or damaged"
        )


def require_plain_tree(folder: Path) -> None:
    """Refuse a folder that holds, at any depth, anything but folders and regular files.

    For folders of others' formats.
    """
    for path, folders, files in os.walk(folder):
        for name in (*folders, *files):
            mode = (Path(path) / name).lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise FormatError(f"{Path(path) / name} is {_kind(mode)}, a regular file expected; {_COPY_REMEDY}")


def bounded_lines(stream: BinaryIO, what: str) -> Iterator[bytes]:
    """Yield the lines of a stream; a FormatError that names `what` if one is longer than `MAX_LINE_BYTES`."""
    while line := stream.readline(MAX_LINE_BYTES + 1):
        if len(line) > MAX_LINE_BYTES:
            raise FormatError(f"{what} has a line of more than {MAX_LINE_BYTES} bytes; it is damaged")
        yield line


def _parse_json(data: bytes | str, what: str) -> Any:
    """Return the value of a JSON text (RFC 8259), whose texts can be written as UTF-8; a FormatError names `what`."""
    import pydantic_core

    try:
        return pydantic_core.from_json(data)
    except ValueError as error:
        raise FormatError(f"{what} is no JSON that can be read: {error}; it is damaged") from error


def parse_json_object(data: bytes | str, what: str) -> dict[str, Any]:
    """Return the object of a JSON text, as `_parse_json`; a FormatError if it is something else."""
    value = _parse_json(data, what)
    if not isinstance(value, dict):
        raise FormatError(f"{what} holds {type(value).__name__}, a JSON object expected; it is damaged")
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
        raise FormatError(f"{path} is {_kind(mode)}, a regular file expected; {_COPY_REMEDY}")


def _require_filled(handle: int, path: Path) -> None:
    """Refuse a file that is mostly holes (lseek(2), SEEK_HOLE): a few bytes can claim more than anybody can read."""
    size = os.fstat(handle).st_size
    if size <= _MOST_HOLES:
        return
    holes = data = 0
    with suppress(OSError):
        # A file system that knows of no holes says that the first one is at the end.
        for _ in range(_LOOKED_AT):
            hole = os.lseek(handle, data, os.SEEK_HOLE)
            if hole >= size:
                break
            holes += size - hole
            data = os.lseek(handle, hole, os.SEEK_DATA)
            holes -= size - data
    os.lseek(handle, 0, os.SEEK_SET)
    if holes > _MOST_HOLES:
        raise FormatError(f"{path} claims {size} bytes and holds at most {size - holes}; {_COPY_REMEDY}")


def _kind(mode: int) -> str:
    kinds = (
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISLNK, "a link"),
        (stat.S_ISFIFO, "a pipe"),
        (stat.S_ISSOCK, "a socket"),
    )
    return next((name for known, name in kinds if known(mode)), "a device")


def _opened_below(root: Path, name: str) -> int | None:
    """Return a descriptor of a file, opened step by step without following a link; None where there is a link."""
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
    for part in name.split("/"):
        path = path / part
        if path.is_symlink():
            return True
    return False


def _target_inside(root: Path, name: str) -> str:
    """Return the name, without links, of the file that a name leads to by links; a FormatError if that is outside."""
    top = root.resolve()
    try:
        target = (top / name).resolve(strict=True)
    except (OSError, RuntimeError) as error:
        raise FormatError(f"{root / name} is a link that leads nowhere; {_COPY_REMEDY}") from error
    if not target.is_relative_to(top) or target == top:
        raise FormatError(f"{root / name} is a link that leads out of {root}; {_COPY_REMEDY}")
    return target.relative_to(top).as_posix()
