"""One program at a time in a folder: on disks that lock folders, on those that lock files alone, and on those without.

What a file system cannot lock is said by a `flock` in place of the system's; what it can, the system locks.
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

import pytest

from foundation import folders
from foundation.errors import InputError, StorageError
from foundation.folders import LOCK_FILE, locked_folder

BUSY = "another program is at it; wait for it"
Flock = Callable[[int, int], None]
flock: Flock = fcntl.flock


def refuse_folders(handle: int, operation: int) -> None:
    """Lock as NFS does: files that are open for writing, and nothing else."""
    if stat.S_ISDIR(os.fstat(handle).st_mode):
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    flock(handle, operation)


@pytest.fixture(params=["folders", "files"])
def locks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return what the file system locks."""
    if request.param == "files":
        monkeypatch.setattr(folders.fcntl, "flock", refuse_folders)
    return request.param


@pytest.mark.usefixtures("locks")
def test_a_folder_is_made_and_held_alone(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "table"
    with locked_folder(folder, BUSY):
        assert folder.is_dir()
        with pytest.raises(InputError, match=BUSY), locked_folder(folder, BUSY):
            pytest.fail("two hold it")
    with locked_folder(folder, BUSY):
        pass


@pytest.mark.usefixtures("locks")
def test_nothing_stays_in_a_folder_that_was_published_meanwhile(tmp_path: Path) -> None:
    folder, final = tmp_path / ".table.partial", tmp_path / "table"
    with locked_folder(folder, BUSY):
        (folder / "lut.json").touch()
        folder.rename(final)
    assert [path.name for path in final.iterdir()] == ["lut.json"]


@pytest.mark.usefixtures("locks")
def test_a_file_that_a_killed_program_left_holds_nobody_up(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).touch()
    with locked_folder(tmp_path, BUSY):
        pass


@pytest.mark.usefixtures("locks")
def test_programs_that_ask_for_a_share_are_there_together(tmp_path: Path) -> None:
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
def test_who_asks_for_a_share_waits_until_there_is_one(tmp_path: Path) -> None:
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
def test_who_waited_in_vain_begins_anew(tmp_path: Path) -> None:
    """The first fails before it has planned anything, and takes its folder along."""
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
def test_a_folder_that_was_finished_between_opening_and_locking_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, final = tmp_path / "making", tmp_path / "made"
    now: Flock = folders.fcntl.flock

    def finished_first(handle: int, operation: int) -> None:
        if not final.exists():
            folder.rename(final)
        now(handle, operation)

    monkeypatch.setattr(folders.fcntl, "flock", finished_first)
    with locked_folder(folder, BUSY):
        assert folder.is_dir()
    assert list(final.iterdir()) == []


def test_a_lock_file_that_its_holder_removed_is_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two wait; the first has the file that the last holder removed, the second made a new one."""
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
def test_without_locks_the_work_goes_on_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, number: int
) -> None:
    def none(handle: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(folders.fcntl, "flock", none)
    with caplog.at_level(logging.WARNING), locked_folder(tmp_path, BUSY) as lock:
        lock.share()
        assert list(tmp_path.iterdir()) == []
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path}: this file system has no locks; see to it that no other program works there"
    ]


def test_a_folder_that_is_made_and_never_there_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_nothing(folder: Path, of: Path | None = None) -> None:
        del folder, of

    monkeypatch.setattr("foundation.folders.make_folder", make_nothing)
    with (
        pytest.raises(StorageError),
        locked_folder(tmp_path / "x", "busy"),
    ):
        pass
