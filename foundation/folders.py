"""Create folders atomically, lock them, detect unmounted disks, measure free space, and find the user's cache folder.

A folder is filled under a hidden name next to its final path, then renamed. The operating system holds the locks, so a
lock ends with its program. If a file system cannot lock folders, a file in the folder is locked.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import math
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
    """Return the user's cache folder of CroP, or None if the user has no home folder.

    The folder is `$XDG_CACHE_HOME/croplab`, or `~/.cache/croplab` (macOS: `~/Library/Caches/croplab`).
    """
    # XDG Base Directory Specification 0.8: relative paths are ignored.
    cache_home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if cache_home.is_absolute():
        return cache_home / "croplab"
    try:
        home = Path.home()
    except RuntimeError:
        return None
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "croplab"


def require_free(path: Path, content: str) -> None:
    """Raise an error unless `path` is free or an empty folder, and can be written.

    `content`: what is written there, for the message, such as "the LUT".
    """
    try:
        is_empty = path.is_dir() and not any(path.iterdir())
    except OSError as error:
        if disk_remedy(error) is None:
            raise
        raise storage_error(path, error, "read") from error
    if not is_empty:
        require_free_file(path, content)


def require_free_file(path: Path, content: str) -> None:
    """Raise an error if `path` exists, even as an empty folder, or if it cannot be written."""
    try:
        exists = path.exists() or path.is_symlink()
        folder = next(parent for parent in path.absolute().parents if parent.exists())
        must_probe = not exists and folder.is_dir()
    except OSError as error:
        if disk_remedy(error) is None:
            raise
        raise storage_error(path, error, "read") from error
    if exists:
        raise InputError(f"{path} already exists; choose another place for {content}, or remove it")
    if must_probe:
        try:
            # Only a temporary file proves that a folder can be written; permissions and mount options do not.
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise storage_error(path, error) from error


def publish_folder(folder: Path, path: Path, content: str) -> None:
    """Rename a complete folder to `path`, which must be free or an empty folder, and flush the new name to the disk."""
    require_free(path, content)
    try:
        folder.replace(path)
    except OSError as error:
        raise storage_error(path, error) from error
    sync_folder(path.parent)


@contextmanager
def atomic_folder(path: Path, content: str) -> Generator[Path]:
    """Make a folder under a hidden name, and rename it to `path` when the block ends without an error.

    `path` must be free or an empty folder. If the block raises an error, the hidden folder is removed.
    """
    require_free(path, content)
    partial = partial_path(path)
    make_folder(path.parent, path)
    try:
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir()
        yield partial
        publish_folder(partial, path, content)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if is_write_error(error, path):
            raise storage_error(path, error) from error
        raise


FSTAB: Final = Path("/etc/fstab")  # List of the disks of a Linux machine
MOUNTS: Final = Path("/proc/self/mounts")  # List of the disks that are mounted now


def unmounted_folder(path: Path, fstab: Path = FSTAB, mounts: Path = MOUNTS) -> Path | None:
    """Return the mount point at or above `path` whose disk is not mounted, or None if there is none."""
    try:
        disks, mounted = ({_mount_point(line) for line in table.read_text().splitlines()} for table in (fstab, mounts))
    except OSError:
        return None
    absolute = path.absolute()
    missing = [folder for folder in disks - mounted if folder is not None and absolute.is_relative_to(folder)]
    return max(missing, key=lambda folder: len(folder.parts), default=None)


def _mount_point(line: str) -> Path | None:
    fields = line.split()
    if len(fields) < 3 or fields[0].startswith("#") or not fields[1].startswith("/") or fields[1] == "/":
        return None
    # Spaces and other special characters are written as octal escapes.
    return Path(re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), fields[1]))


def clear_folder(folder: Path) -> None:
    """Remove all files and folders in a locked folder, except the lock file."""
    for path in folder.iterdir():
        if path.name == LOCK_FILE:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


LOCK_FILE: Final = ".lock"  # File that is locked if the file system cannot lock the folder

# Errors of file systems that cannot lock a file or a folder (flock(2); NFS, Lustre, FUSE, SMB, macOS).
_NO_LOCKS: Final = {errno.ENOLCK, errno.EBADF, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL}

_log = logging.getLogger(__name__)


class FolderLock:
    """Lock on a folder, made by `locked_folder`; `handle` is the locked descriptor, None if locks are impossible."""

    def __init__(self, handle: int | None) -> None:
        self._handle = handle

    def share(self) -> None:
        """Allow other programs to use the folder at the same time (see `share_if` of `locked_folder`)."""
        if self._handle is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(self._handle, fcntl.LOCK_SH)


@contextmanager
def locked_folder(
    folder: Path, busy: str, share_if: Callable[[], bool] | None = None, target: Path | None = None
) -> Generator[FolderLock]:
    """Lock a folder while the block runs; a missing folder is made.

    If another program has the lock, an InputError with the message `busy` is raised. With `share_if`, wait instead
    until the other program allows sharing (`FolderLock.share`). Then share the lock if `share_if()` is true, or try
    again if it is false. Messages name `target`, by default the folder.
    """
    for _ in range(FOLDER_ATTEMPTS):
        make_folder(folder, target)
        with ExitStack() as resources:
            try:
                folder_handle = _open_folder(folder, resources)
                handle, is_shared = _lock_folder(folder_handle, folder, share_if is not None, resources)
                is_current = _is_at(folder_handle, folder)
            except FileNotFoundError:
                continue  # Another program renamed the folder to its final name between two of our calls.
            except BlockingIOError as error:
                raise InputError(busy) from error
            except OSError as error:
                raise storage_error(folder if target is None else target, error) from error
            if not is_current or (is_shared and share_if is not None and not share_if()):
                continue
            yield FolderLock(handle)
            return
    path = folder if target is None else target
    raise StorageError(f"cannot write {path}: its folder was removed {FOLDER_ATTEMPTS} times; choose an ordinary disk")


def _open_folder(folder: Path, resources: ExitStack) -> int:
    handle = os.open(folder, os.O_RDONLY)
    resources.callback(_close, handle)
    return handle


def _close(handle: int) -> None:
    # Nothing was written through this descriptor, so an error here loses no data.
    with contextlib.suppress(OSError):
        os.close(handle)


def _lock_folder(folder_handle: int, folder: Path, wait: bool, resources: ExitStack) -> tuple[int | None, bool]:
    """Lock the open folder, or a file in it; return the locked descriptor, and whether the lock is shared."""
    with _ignore_missing_locks():
        return folder_handle, _lock(folder_handle, wait)
    while True:
        file = os.open(LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666, dir_fd=folder_handle)
        resources.callback(_close, file)
        is_shared = None
        with _ignore_missing_locks():
            is_shared = _lock(file, wait)
        if is_shared is None:
            _remove_lock_file(folder_handle)
            _log.warning("%s: this file system has no locks; make sure that no other program uses the folder", folder)
            return None, False
        # The program that had the lock before may have removed the file before we locked it.
        if _is_lock_file(file, folder_handle):
            resources.callback(_release_lock_file, file, folder_handle)
            return file, is_shared


@contextmanager
def _ignore_missing_locks() -> Generator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def _is_lock_file(file: int, folder_handle: int) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(LOCK_FILE, dir_fd=folder_handle))
    except FileNotFoundError:
        return False


def _release_lock_file(file: int, folder_handle: int) -> None:
    # If another program shares the lock, the exclusive lock fails and the file is kept. The folder may have been
    # renamed, so its handle is used.
    with contextlib.suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove_lock_file(folder_handle)


def _remove_lock_file(folder_handle: int) -> None:
    with contextlib.suppress(OSError):
        os.unlink(LOCK_FILE, dir_fd=folder_handle)


def _lock(handle: int, wait: bool) -> bool:
    """Lock exclusively, or, if another program has the lock, wait and share it; return whether the lock is shared."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        if not wait:
            raise
        fcntl.flock(handle, fcntl.LOCK_SH)
        return True
    return False


def _is_at(handle: int, folder: Path) -> bool:
    # Another program may have renamed the folder.
    try:
        return os.path.samestat(os.fstat(handle), folder.stat())
    except FileNotFoundError:
        return False


def free_bytes_at(folder: Path) -> int:
    """Return the free space on the disk of `folder`, which need not exist, bytes."""
    existing = folder.absolute()
    try:
        while not existing.is_dir() and existing != existing.parent:
            existing = existing.parent
        if os.statvfs(existing).f_flag & os.ST_RDONLY:
            raise storage_error(folder, OSError(errno.EROFS, os.strerror(errno.EROFS)))
        if not os.access(existing, os.W_OK | os.X_OK):
            raise storage_error(folder, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
        return shutil.disk_usage(existing).free
    except OSError as error:
        raise storage_error(folder, error, "read") from error


def bytes_text(number: float, up: bool = False) -> str:
    """Return bytes as GB or MB with one decimal; `up`: whether to round up.

    Examples
    --------
    >>> bytes_text(25_340_000), bytes_text(1.01e9), bytes_text(1.01e9, up=True)
    ('25.3 MB', '1.0 GB', '1.1 GB')
    """
    unit, name = (1e9, "GB") if number >= 1e9 else (1e6, "MB")
    tenths = number / unit * 10
    return f"{(math.ceil(tenths) if up else round(tenths)) / 10:.1f} {name}"
