"""Folders that one program works in at a time, whatever is made there: a session, a table, a dataset.

The lock is advisory (`flock(2)`) and lies on the folder itself, so that a program that is killed leaves none behind.
Network file systems refuse to lock a folder (`EBADF` on NFS, where `flock` needs write access); a file in it is locked
there instead, and removed by the last who holds it. Where the file system has no locks at all, the work goes on with a
warning: no other program may work there, and nothing prevents it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from foundation.errors import InputError, StorageError
from foundation.files import ATTEMPTS, make_folder, storage_error

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
