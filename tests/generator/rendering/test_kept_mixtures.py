"""Mixtures are kept for the next time, and damaged ones are as good as none."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from generator.rendering.cell_mixtures import CellMixtures, cache_folder, keep_mixtures, load_mixtures


@pytest.fixture
def mixtures() -> CellMixtures:
    rng = np.random.default_rng(4)
    return CellMixtures(
        np.sort(rng.integers(0, 32768, (7, 16)), axis=1).astype(np.uint16),
        rng.random((7, 3)).astype(np.float32),
        rng.random((7, 3)).astype(np.float32),
    )


def test_what_is_kept_is_found(mixtures: CellMixtures, tmp_path: Path) -> None:
    folder = tmp_path / "not yet there"
    assert load_mixtures("ab12", 7, folder) is None
    keep_mixtures("ab12", mixtures, folder)
    found = load_mixtures("ab12", 7, folder)
    assert found is not None
    for name in ("cells", "colours", "wanted"):
        kept, given = getattr(found, name), getattr(mixtures, name)
        assert kept.dtype == given.dtype
        np.testing.assert_array_equal(kept, given)
    assert [path.suffix for path in folder.iterdir()] == [".mixtures"]


@pytest.mark.parametrize("place", [0, 25, 100, -1])
def test_a_damaged_file_is_none(mixtures: CellMixtures, tmp_path: Path, place: int) -> None:
    keep_mixtures("ab12", mixtures, tmp_path)
    path = tmp_path / "ab12.mixtures"
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    assert load_mixtures("ab12", 7, tmp_path) is None
    keep_mixtures("ab12", mixtures, tmp_path)
    assert load_mixtures("ab12", 7, tmp_path) is not None


@pytest.mark.parametrize("content", [b"", b"something else", b"CroP cell mixtures 1\n"])
def test_a_foreign_or_cut_file_is_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "ab12.mixtures").write_bytes(content)
    assert load_mixtures("ab12", 7, tmp_path) is None


def test_mixtures_of_another_size_are_none(mixtures: CellMixtures, tmp_path: Path) -> None:
    keep_mixtures("ab12", mixtures, tmp_path)
    assert load_mixtures("ab12", 8, tmp_path) is None


def test_where_nothing_can_be_kept_nothing_is(mixtures: CellMixtures, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    keep_mixtures("ab12", mixtures, tmp_path / "file" / "below")
    assert load_mixtures("ab12", 7, tmp_path / "file" / "below") is None


def test_the_folder_is_the_one_of_the_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "croplab"
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("sys.platform", "linux")
    assert cache_folder() == tmp_path / ".cache" / "croplab"
    monkeypatch.setattr("sys.platform", "darwin")
    assert cache_folder() == tmp_path / "Library" / "Caches" / "croplab"


def test_what_was_kept_first_makes_room(
    mixtures: CellMixtures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "notes.txt").write_text("not ours")
    for number in range(3):
        keep_mixtures(f"{number}", mixtures, tmp_path)
        os.utime(tmp_path / f"{number}.mixtures", ns=(number, number))
    size = (tmp_path / "0.mixtures").stat().st_size
    monkeypatch.setattr("generator.rendering.cell_mixtures.MOST_BYTES", 3 * size)
    keep_mixtures("3", mixtures, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.mixtures", "2.mixtures", "3.mixtures", "notes.txt"]
