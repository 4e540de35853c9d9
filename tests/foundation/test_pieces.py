"""Records of finished pieces: damaged lines, other inputs, missing files."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.files import sha256_of
from foundation.pieces import Piece, read_pieces

ONE = Piece("one", "of these", {"a.png": "0" * 64}, '{"value": 0.1}')
TWO = Piece("two", "of these", {}, "[]")
FOREIGN = Piece("one", "of others", {}, "{}")


def test_restores_pieces() -> None:
    record = ONE.to_line() + TWO.to_line()
    assert read_pieces(record) == read_pieces(record, "of these") == {"one": ONE, "two": TWO}
    assert read_pieces(record + FOREIGN.to_line())["one"] == FOREIGN, "the last line of a name is used"
    assert read_pieces(record + FOREIGN.to_line(), "of these")["one"] == ONE
    foreign_line = b"a line\tof something else"
    assert read_pieces(b"%s\t%s\n" % (sha256_of(foreign_line).encode(), foreign_line)) == read_pieces(b"") == {}


@given(st.data())
def test_ignores_damaged_lines_only(data: st.DataObject) -> None:
    line = ONE.to_line()
    position = data.draw(st.integers(1, len(line) - 2))
    byte = data.draw(st.integers(0, 255).filter(lambda byte: byte != line[position]))
    changed = line[:position] + bytes([byte]) + line[position + 1 :]
    for damaged in (line[:position], changed):
        assert read_pieces(damaged + TWO.to_line()) == {"two": TWO}


@pytest.mark.parametrize("content", [b"other", None])
def test_piece_without_its_files_is_incomplete(tmp_path: Path, content: bytes | None) -> None:
    files = {"a": b"1", "b": b"22"}
    piece = Piece("one", "", {name: sha256_of(data) for name, data in files.items()}, "{}")
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    assert piece.is_complete(lambda name: (tmp_path / name).open("rb"))
    (tmp_path / "b").unlink()
    if content is not None:
        (tmp_path / "b").write_bytes(content)
    assert not piece.is_complete(lambda name: (tmp_path / name).open("rb"))
