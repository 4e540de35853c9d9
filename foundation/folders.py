"""Folders: whether a place is free, how they are published whole and emptied, who holds one, which disk is missing.

A folder appears whole as a file does (`foundation.files`): filled beside its place under a hidden name, flushed to the
disk, then renamed. One that is held is locked by the system, so that a program which ends leaves no lock behind; where
a disk locks no folders, a file in it is locked. Also where the user's cache is.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from foundation.errors import InputError, StorageError
from foundation.files import (
    FOLDER_ATTEMPTS,
    disk_remedy,
    is_write_error,
    make_folder,
    partial_path,
    storage_error,
    sync_folder,
)


def cache_folder() -> Path | None:
    """Return the user's folder for what can be computed again, or None if there is no home.

    `$XDG_CACHE_HOME/croplab` or `~/.cache/croplab` (XDG Base Directory Specification 0.8, which has a relative one
    ignored), on macOS `~/Library/Caches/croplab`.
    """
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if given.is_absolute():
        return given / "croplab"
    try:
        home = Path.home()
    except RuntimeError:
        return None
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "croplab"


def require_free(path: Path, what: str) -> None:
    """Refuse when `path` exists and is not an empty folder."""
    try:
        empty = path.is_dir() and not any(path.iterdir())
    except OSError as error:
        if disk_remedy(error) is None:
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
        if disk_remedy(error) is None:
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
def atomic_folder(path: Path, what: str) -> Generator[Path]:
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
        if is_write_error(error, path):
            raise storage_error(path, error) from error
        raise


FSTAB: Final = Path("/etc/fstab")
MOUNTS: Final = Path("/proc/self/mounts")  # Tables of disks, and of mounted ones, of Linux


def unmounted_folder(path: Path, fstab: Path = FSTAB, mounts: Path = MOUNTS) -> Path | None:
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


def clear_folder(folder: Path) -> None:
    """Remove what lies in a folder that is held, but for its lock."""
    for path in folder.iterdir():
        if path.name == LOCK_FILE:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


LOCK_FILE: Final = ".lock"  # Name of the file that is locked where a folder cannot be

# What a file system answers that cannot lock what it was asked to (flock(2); NFS, Lustre, FUSE, SMB, macOS).
_NO_LOCKS: Final = {errno.ENOLCK, errno.EBADF, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL}

_log = logging.getLogger(__name__)


class FolderLock:
    """The hold on a folder; given by `locked_folder`.

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
def locked_folder(
    folder: Path, busy: str, share_if: Callable[[], bool] | None = None, target: Path | None = None
) -> Generator[FolderLock]:
    """Hold a folder while the block runs; it is made if it is not there.

    `share_if`: where given, another program's hold is waited for until it is shared (`FolderLock.share`), and joined if
    this returns true then; if not, the attempt begins anew. `target`: what is made in the folder, named in the messages
    of errors; the folder itself if None.
    """
    for _ in range(FOLDER_ATTEMPTS):
        make_folder(folder, target)
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
                raise storage_error(folder if target is None else target, error) from error
            if not there or (together and share_if is not None and not share_if()):
                continue
            yield FolderLock(handle)
            return
    place = folder if target is None else target
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
