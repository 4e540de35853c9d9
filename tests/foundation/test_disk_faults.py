"""Each system call of saving a file and of locking a folder fails, once or always: one message, no incomplete file."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

import pytest

from foundation.errors import StorageError
from foundation.files import write_atomic
from foundation.folders import atomic_folder, locked_folder, require_free
from tests.failing_calls import DISK_FAULTS, FailingCalls, Ran, failing_calls, why_not

pytestmark = [pytest.mark.slow, pytest.mark.skipif(why_not() != "", reason=why_not())]

REMEDIES = {
    errno.EIO: "check its cable",
    errno.ENOSPC: "free space",
    errno.EROFS: "mount it for writing",
    errno.EDQUOT: "quota on the disk",
    errno.ENODEV: "connect and mount it",
    errno.ESTALE: "mount it again here",
}


@pytest.fixture
def disk(tmp_path: Path) -> Generator[FailingCalls]:
    with failing_calls(tmp_path) as calls:
        yield calls


def each_call(
    disk: FailingCalls,
    action: Callable[[], object],
    restore: Callable[[], object] = lambda: None,
    numbers: Sequence[int] = DISK_FAULTS,
) -> Generator[tuple[Ran, int, bool]]:
    """Yield the result of `action` for each of its calls and each error, once and lasting; `restore` resets it."""
    restore()
    first = disk.run(action)
    assert first.error is None
    assert first.calls
    for number in numbers:
        for lasting in (False, True):
            for at in range(200):
                restore()
                ran = disk.run(action, at, number, lasting=lasting)
                if ran.error is not None:
                    assert isinstance(ran.error, StorageError), f"{ran.failed}: {ran.error!r}"
                    message = str(ran.error)
                    assert os.strerror(number) in message
                    assert REMEDIES[number] in message
                    assert message.endswith("then run the same command again")
                    assert "\n" not in message
                if ran.failed is None:
                    assert ran.error is None
                    break
                yield ran, number, lasting
            else:
                pytest.fail("it makes more than 200 calls")


def test_injected_error_hits_one_call(disk: FailingCalls, tmp_path: Path) -> None:
    """Test of the tool: only the named call of the thread fails."""

    def write() -> None:
        with (tmp_path / "a").open("wb", buffering=0) as stream:
            stream.write(b"x")

    ran = disk.run(write, 0, errno.EIO, calls=("write",))
    assert (ran.calls, ran.failed) == (("write /a",), "write /a")
    assert isinstance(ran.error, OSError)
    assert ran.error.errno == errno.EIO
    assert (tmp_path / "a").read_bytes() == b""
    assert disk.run(lambda: Path("/etc/passwd").read_text(), 0).calls == ()


def save_old(path: Path) -> None:
    write_atomic(path, "old")
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_file_is_complete_or_error_is_reported(disk: FailingCalls, tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    faults = 0
    for ran, _, _ in each_call(disk, lambda: write_atomic(path, "new" * 5000), lambda: save_old(path)):
        assert path.read_text() in ("old", "new" * 5000)
        if ran.error is None:
            assert path.read_text() == "new" * 5000
        assert {entry.name for entry in tmp_path.iterdir()} <= {"frames.csv", ".frames.csv.partial"}
        faults += ran.error is not None
    assert faults > 50


def test_folder_is_complete_or_error_is_reported(disk: FailingCalls, tmp_path: Path) -> None:
    path = tmp_path / "in" / "lut"

    def save() -> None:
        with atomic_folder(path, "the table") as folder:
            write_atomic(folder / "a", "1")
            write_atomic(folder / "b", "2")

    def clear() -> None:
        shutil.rmtree(path.parent, ignore_errors=True)

    for ran, _, _ in each_call(disk, save, clear, (errno.EIO, errno.ENOSPC)):
        if path.exists():
            assert {file.name: file.read_text() for file in path.iterdir()} == {"a": "1", "b": "2"}
        else:
            assert ran.error is not None


@pytest.mark.parametrize("locks", [True, False])
def test_folder_is_locked_or_error_is_reported(
    disk: FailingCalls, tmp_path: Path, locks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    flock = fcntl.flock
    if not locks:

        def no_folder(handle: int, operation: int) -> None:
            # NFS answers so for a folder; a file in it is locked instead.
            if Path(f"/proc/self/fd/{handle}").readlink().is_dir():
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            flock(handle, operation)

        monkeypatch.setattr(fcntl, "flock", no_folder)
    held: list[bool] = []

    def hold() -> None:
        with locked_folder(tmp_path / "session", "busy"):
            held.append(True)

    for ran, _, _ in each_call(disk, hold, held.clear, (errno.EIO, errno.ESTALE)):
        assert len(held) == (ran.error is None)


def test_path_is_checked_or_error_is_reported(disk: FailingCalls, tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    for _ in each_call(disk, lambda: require_free(target, "the table")):
        pass
    target.rmdir()
    for _ in each_call(disk, lambda: require_free(target, "the table"), numbers=(errno.EIO, errno.ESTALE)):
        pass
