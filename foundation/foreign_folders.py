"""The gate to folders that somebody else made: data sets, tables, sessions, published tables.

Such a folder is copied from a stranger's disk or an archive, and any file of it may hold anything. Rules that every
reader keeps by going through here:

- A name that stands in a file leads to a file inside the folder, or nowhere: no ``..``, no root, no link that leads
  out.
- What is opened is a regular file: a device or a pipe never ends, and some do something when they are read.
- What is read whole has a size that its reader has stated; what is read by lines has lines that end.
- JSON is of a depth that a reader survives, and its texts can be written again.

All that is refused is a `FormatError` that names the file. Folders are looked at once, when they are opened: who may
change a folder while it is read may change what it says, too.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from foundation.errors import FormatError
from foundation.files import reading_error

MOST_JSON_BYTES: Final = 256 << 20
"""JSON is read as far as this: the description of a data set of a million pictures, all skipped, is a third of it."""

MOST_LINE_BYTES: Final = 1 << 20
"""Longest line of a file that is read by lines: the longest of ours are some hundred bytes, names of files 4096."""

_MOST_NAME: Final = 4096
"""Longest name, as PATH_MAX of Linux has it."""

_MOST_HOLES: Final = 1 << 30
"""Bytes of a file that its disk need not hold: black pictures are copied with holes, though smaller ones."""
_LOOKED_AT: Final = 4096
"""Holes of a file that are counted; whoever makes more of them has filled as many blocks."""

_COPY_REMEDY: Final = "ask who made the folder for a copy without it, or copy it with its links resolved (cp -rL)"


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


def read_inside(root: Path, name: str, most_bytes: int) -> bytes:
    """Return the bytes of a file below a folder, as `open_inside`; a FormatError if it has more than `most_bytes`."""
    with open_inside(root, name) as stream:
        size = os.fstat(stream.fileno()).st_size
        data = stream.read(most_bytes + 1) if size <= most_bytes else b""
        if size > most_bytes or len(data) > most_bytes:
            raise FormatError(
                f"{root / name} has {max(size, len(data))} bytes, at most {most_bytes} expected; it is not what it is "
                "called, or damaged"
            )
    return data


def require_plain_folder(
    folder: Path, most_bytes: Mapping[str, int] | None = None, below: tuple[str, ...] = ()
) -> None:
    """Refuse a folder that holds anything but folders, regular files and links that stay inside."""
    try:
        for inner in ("", *below):
            with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder / inner) as entries:
                for entry in entries:
                    _require_plain(folder, f"{inner}/{entry.name}" if inner else entry.name, entry)
        for name, most in (most_bytes or {}).items():
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
    """Yield the lines of a stream; a FormatError that names `what` if one is longer than `MOST_LINE_BYTES`."""
    while line := stream.readline(MOST_LINE_BYTES + 1):
        if len(line) > MOST_LINE_BYTES:
            raise FormatError(f"{what} has a line of more than {MOST_LINE_BYTES} bytes; it is damaged")
        yield line


def parse_json(data: bytes | str, what: str) -> Any:
    """Return the value of a JSON text (RFC 8259), whose texts can be written as UTF-8; a FormatError names `what`."""
    import pydantic_core

    try:
        return pydantic_core.from_json(data)
    except ValueError as error:
        raise FormatError(f"{what} is no JSON that can be read: {error}; it is damaged") from error


def parse_json_object(data: bytes | str, what: str) -> dict[str, Any]:
    """Return the object of a JSON text, as `parse_json`; a FormatError if it is something else."""
    value = parse_json(data, what)
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
