"""Folders of others: who works in one at a time, and the gate to those that somebody else made.

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

import contextlib
import errno
import fcntl
import logging
import os
import re
import shutil
import stat
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from foundation.errors import FormatError, InputError, StorageError
from foundation.files import ATTEMPTS, make_folder, reading_error, storage_error

MOST_JSON_BYTES: Final = 256 << 20
"""JSON is read as far as this: the description of a data set of a million pictures, all skipped, is a third of it."""

MOST_LINE_BYTES: Final = 1 << 20
"""Longest line of a file that is read by lines: the longest of ours are some hundred bytes, names of files 4096."""

FSTAB: Final = Path("/etc/fstab")
MOUNTS: Final = Path("/proc/self/mounts")

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


def unmounted_at(path: Path, fstab: Path = FSTAB, mounts: Path = MOUNTS) -> Path | None:
    """Return the folder at or above `path` where a disk of `fstab` is not mounted; None where each is, or none is told.

    `fstab`, `mounts`: the table of disks and that of mounted ones (fstab(5), proc(5)).
    """
    try:
        known, mounted = ({_place(line) for line in table.read_text().splitlines()} for table in (fstab, mounts))
    except OSError:
        return None
    whole = path.absolute()
    missing = [place for place in known - mounted if place is not None and whole.is_relative_to(place)]
    return max(missing, key=lambda place: len(place.parts), default=None)


def _place(line: str) -> Path | None:
    """Return the second field of a line of such a table; None of a comment and of what is mounted nowhere."""
    fields = line.split()
    if len(fields) < 3 or fields[0].startswith("#") or not fields[1].startswith("/") or fields[1] == "/":
        return None
    return Path(re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), fields[1]))


def clear_folder(folder: Path, kept: Collection[str] = ()) -> None:
    """Remove what lies in a folder that is held, but for its lock and the names in `kept`."""
    for path in folder.iterdir():
        if path.name == LOCK_FILE or path.name in kept:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


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


LOCK_FILE: Final = ".lock"
"""Name of the file that is locked where a folder cannot be."""

_NO_LOCKS: Final = {errno.ENOLCK, errno.EBADF, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL}
"""What a file system answers that cannot lock what it was asked to (flock(2); NFS, Lustre, FUSE, SMB, macOS)."""

_log = logging.getLogger(__name__)


class FolderLock:
    """The hold on a folder; given by `held_folder`.

    `handle`: open file descriptor of what is locked; None where the file system has no locks.
    """

    def __init__(self, handle: int | None) -> None:
        self._handle = handle

    def share(self) -> None:
        """Let others hold the folder too, who ask for no more than a share of it."""
        if self._handle is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(self._handle, fcntl.LOCK_SH)


@contextmanager
def held_folder(
    folder: Path, busy: str, share_if: Callable[[], bool] | None = None, of: Path | None = None
) -> Generator[FolderLock]:
    """Hold a folder while the block runs; it is made if it is not there.

    `share_if`: where given, another program's hold is waited for until it is shared (`FolderLock.share`), and joined if
    this returns true then; if not, the attempt begins anew. `of`: what is made in the folder, named in the messages of
    errors; the folder itself if None.
    """
    for _ in range(ATTEMPTS):
        make_folder(folder, of)
        with ExitStack() as opened:
            try:
                place = _opened(folder, opened)
                handle, together = _locked(place, folder, share_if is not None, opened)
                there = _is_at(place, folder)
            except FileNotFoundError:
                continue  # Another program gave the folder its final name between two calls.
            except BlockingIOError as error:
                raise InputError(busy) from error
            except OSError as error:
                raise storage_error(folder if of is None else of, error) from error
            if not there or (together and share_if is not None and not share_if()):
                continue
            yield FolderLock(handle)
            return
    place = folder if of is None else of
    raise StorageError(f"cannot write {place}: its folder is made and not there; name a place on an ordinary disk")


def _opened(folder: Path, opened: ExitStack) -> int:
    handle = os.open(folder, os.O_RDONLY)
    opened.callback(_close, handle)
    return handle


def _close(handle: int) -> None:
    # Nothing was written to it: what a failing disk says now, it says of something else, too.
    with contextlib.suppress(OSError):
        os.close(handle)


def _locked(place: int, folder: Path, wait: bool, opened: ExitStack) -> tuple[int | None, bool]:
    """Lock the open folder, else a file in it; return what is locked, and whether it is held together with others."""
    with _lockless_suppressed():
        return place, _lock(place, wait)
    while True:
        file = os.open(LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666, dir_fd=place)
        opened.callback(_close, file)
        together = None
        with _lockless_suppressed():
            together = _lock(file, wait)
        if together is None:
            _remove_lock_file(place)
            _log.warning("%s: this file system has no locks; see to it that no other program works there", folder)
            return None, False
        if _is_lock_file(file, place):
            opened.callback(_leave_lock_file, file, place)
            return file, together


@contextmanager
def _lockless_suppressed() -> Generator[None]:
    """Suppress the errors of a file system that cannot lock what it was asked to."""
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def _is_lock_file(file: int, place: int) -> bool:
    """Return whether the locked file is still the one in the folder; who held it last has removed it."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(LOCK_FILE, dir_fd=place))
    except FileNotFoundError:
        return False


def _leave_lock_file(file: int, place: int) -> None:
    """Remove the locked file, wherever its folder is by now, unless others hold it too."""
    with contextlib.suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove_lock_file(place)


def _remove_lock_file(place: int) -> None:
    with contextlib.suppress(OSError):
        os.unlink(LOCK_FILE, dir_fd=place)


def _lock(handle: int, wait: bool) -> bool:
    """Hold alone, or together with others where `wait`; return whether it is held together."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        if not wait:
            raise
        fcntl.flock(handle, fcntl.LOCK_SH)
        return True
    return False


def _is_at(handle: int, folder: Path) -> bool:
    """Return whether the open folder is still the one of that name; another program may have finished it."""
    try:
        return os.path.samestat(os.fstat(handle), folder.stat())
    except FileNotFoundError:
        return False
