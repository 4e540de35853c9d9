"""Folder locks on file systems that lock folders, on those that lock files only, and on those without locks.

A replaced `flock` simulates missing locks of a file system.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest

from foundation import folders
from foundation.errors import InputError, StorageError
from foundation.folders import LOCK_FILE, free_bytes_at, locked_folder

BUSY = "another program is at it; wait for it"
Flock = Callable[[int, int], None]
flock: Flock = fcntl.flock


def refuse_folders(handle: int, operation: int) -> None:
    """Lock as NFS does: only files that are open for writing."""
    if stat.S_ISDIR(os.fstat(handle).st_mode):
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    flock(handle, operation)


@pytest.fixture(params=["folders", "files"])
def locks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the kind of lockable objects."""
    if request.param == "files":
        monkeypatch.setattr(folders.fcntl, "flock", refuse_folders)
    return request.param


@pytest.mark.usefixtures("locks")
def test_makes_and_locks_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "table"
    with locked_folder(folder, BUSY):
        assert folder.is_dir()
        with pytest.raises(InputError, match=BUSY), locked_folder(folder, BUSY):
            pytest.fail("two hold it")
    with locked_folder(folder, BUSY):
        pass


@pytest.mark.usefixtures("locks")
def test_leaves_no_lock_file_in_a_published_folder(tmp_path: Path) -> None:
    folder, final = tmp_path / ".table.partial", tmp_path / "table"
    with locked_folder(folder, BUSY):
        (folder / "lut.json").touch()
        folder.rename(final)
    assert [path.name for path in final.iterdir()] == ["lut.json"]


@pytest.mark.usefixtures("locks")
def test_ignores_the_lock_file_of_a_killed_program(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).touch()
    with locked_folder(tmp_path, BUSY):
        pass


@pytest.mark.usefixtures("locks")
def test_programs_share_a_lock(tmp_path: Path) -> None:
    plan = tmp_path / "plan"
    with locked_folder(tmp_path, BUSY, share_if=plan.exists) as first:
        plan.touch()
        first.share()
        with locked_folder(tmp_path, BUSY, share_if=plan.exists), pytest.raises(InputError, match=BUSY):
            locked_folder(tmp_path, BUSY).__enter__()
        # The second to leave took nothing away from the first.
        with pytest.raises(InputError, match=BUSY), locked_folder(tmp_path, BUSY):
            pytest.fail("one holds it alone, another shares it")
    with locked_folder(tmp_path, BUSY):
        pass


@pytest.mark.slow
@pytest.mark.usefixtures("locks")
def test_waits_for_a_shared_lock(tmp_path: Path) -> None:
    plan, joined = tmp_path / "plan", threading.Event()

    def join() -> None:
        with locked_folder(tmp_path, BUSY, share_if=plan.exists):
            assert plan.exists()
            joined.set()

    with locked_folder(tmp_path, BUSY, share_if=plan.exists) as first:
        second = threading.Thread(target=join)
        second.start()
        assert not joined.wait(0.1)
        plan.touch()
        first.share()
        assert joined.wait(10)
    second.join()


@pytest.mark.usefixtures("locks")
def test_retries_after_a_useless_wait(tmp_path: Path) -> None:
    """The first program fails before it has planned anything, and removes its folder."""
    folder, waits = tmp_path / "dataset", threading.Event()
    held: list[bool] = []

    def join() -> None:
        waits.set()
        with locked_folder(folder, BUSY, share_if=(folder / "plan").exists):
            held.append(folder.is_dir())

    with locked_folder(folder, BUSY):
        second = threading.Thread(target=join)
        second.start()
        assert waits.wait(10)
        folder.rename(tmp_path / "gone")
    second.join(10)
    assert held == [True]


@pytest.mark.usefixtures("locks")
def test_makes_a_folder_again_that_was_renamed_before_locking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, final = tmp_path / "making", tmp_path / "made"
    system_flock: Flock = folders.fcntl.flock

    def finished_first(handle: int, operation: int) -> None:
        if not final.exists():
            folder.rename(final)
        system_flock(handle, operation)

    monkeypatch.setattr(folders.fcntl, "flock", finished_first)
    with locked_folder(folder, BUSY):
        assert folder.is_dir()
    assert list(final.iterdir()) == []


def test_ignores_a_lock_file_removed_by_its_owner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two waiting programs, one has the removed lock file and the other a new one."""
    removed: list[bool] = []

    def removed_first(handle: int, operation: int) -> None:
        refuse_folders(handle, operation)
        if not removed:
            removed.append(True)
            (tmp_path / LOCK_FILE).unlink()

    monkeypatch.setattr(folders.fcntl, "flock", removed_first)
    with locked_folder(tmp_path, BUSY):
        assert (tmp_path / LOCK_FILE).exists()
        with pytest.raises(InputError, match=BUSY), locked_folder(tmp_path, BUSY):
            pytest.fail("two hold it")


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL])
def test_warns_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, number: int
) -> None:
    def none(handle: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(folders.fcntl, "flock", none)
    with caplog.at_level(logging.WARNING), locked_folder(tmp_path, BUSY) as lock:
        lock.share()
        assert list(tmp_path.iterdir()) == []
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path}: this file system has no locks; make sure that no other program uses the folder"
    ]


def test_gives_up_on_a_folder_that_disappears(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def make_nothing(folder: Path, of: Path | None = None) -> None:
        del folder, of

    monkeypatch.setattr("foundation.folders.make_folder", make_nothing)
    with (
        pytest.raises(StorageError),
        locked_folder(tmp_path / "x", "busy"),
    ):
        pass


@pytest.mark.parametrize(("platform", "below_home"), [("linux", ".cache"), ("darwin", "Library/Caches")])
def test_cache_is_where_the_system_keeps_caches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, platform: str, below_home: str
) -> None:
    # XDG Base Directory Specification; Apple, "File System Programming Guide".
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("sys.platform", platform)
    assert folders.cache_folder() == tmp_path / below_home / "croplab"


def test_free_space_reports_disk_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "statvfs", Mock(side_effect=OSError(errno.EIO, os.strerror(errno.EIO))))
    with pytest.raises(StorageError):
        free_bytes_at(tmp_path)
