"""Files that the disk does not read: a few are taken again, many are waited for."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path

import pytest

from experiment.session import repair as verification
from experiment.session.records import AcceptedFile
from foundation.errors import StorageError
from foundation.hashing import file_sha256


def frames(folder: Path, count: int = 6) -> list[AcceptedFile]:
    """Return so many frames whose files are in the folder."""
    (folder / "frames").mkdir()
    found: list[AcceptedFile] = []
    for number in range(count):
        path = folder / "frames" / f"{number}.cr2"
        path.write_bytes(bytes([number]) * 100)
        found.append(AcceptedFile(number + 1, number, number, f"frames/{number}.cr2", 100, file_sha256(path)))
    return found


def failing(monkeypatch: pytest.MonkeyPatch, code: int, names: set[str]) -> Callable[[Path], str]:
    def read(path: Path) -> str:
        if path.name in names:
            raise OSError(code, "Input/output error" if code == errno.EIO else "Permission denied", str(path))
        return file_sha256(path)

    monkeypatch.setattr(verification, "file_sha256", read)
    return read


def test_a_file_in_bad_sectors_is_named_and_the_others_are_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = frames(tmp_path)
    (tmp_path / "frames" / "5.cr2").write_bytes(bytes(100))
    failing(monkeypatch, errno.EIO, {"1.cr2"})
    looked: list[int] = []
    found = verification.unsound_files(tmp_path, taken, lambda done, total: looked.append(done))
    assert sorted(found) == [2, 6]
    assert found[2] == "frames/1.cr2 cannot be read: Input/output error; it is taken again"
    assert "has changed" in found[6]
    assert looked[-1] == 6


@pytest.mark.parametrize(
    ("code", "names", "said"),
    [
        (errno.EIO, {"0.cr2", "1.cr2", "2.cr2", "4.cr2"}, r"0\.cr2 and 3 more: Input/output error; check the disk"),
        (errno.EACCES, {"3.cr2"}, r"3\.cr2: Permission denied; check the disk, its cable and the permissions"),
    ],
)
def test_files_that_may_be_sound_are_not_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, names: set[str], said: str
) -> None:
    taken = frames(tmp_path)
    failing(monkeypatch, code, names)
    with pytest.raises(StorageError, match=said):
        verification.unsound_files(tmp_path, taken, lambda done, total: None)
