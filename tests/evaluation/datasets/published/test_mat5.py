"""MATLAB files are checked before SciPy follows what stands in them: damaged types made it crash the program."""

from __future__ import annotations

import contextlib
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat, savemat
from scipy.sparse import csc_array

from evaluation.datasets.published import matlab
from evaluation.datasets.published.matlab import check_mat5
from foundation.errors import FormatError

pytestmark = pytest.mark.slow

_CELLS = np.empty((1, 2), dtype=object)
_CELLS[0, 0], _CELLS[0, 1] = np.eye(2), np.array(["x", "yz"])

CONTENT: dict[str, object] = {
    "groundtruth_illuminants": np.arange(12.0).reshape(4, 3),
    "all_image_names": np.array([["SonyA57_0001"], ["b"], [""]], dtype=object),
    "darkness_level": 128,
    "single": np.array([1, 2], np.float32),
    "complex": np.array([1 + 2j, 3]),
    "logical": np.array([True, False]),
    "none": np.zeros((0, 3)),
    "nested": {"corners": _CELLS, "n": np.int16(-3)},
    "sparse": csc_array(np.eye(3)),
}


def written(compressed: bool, content: dict[str, object] | None = None, version: Literal["4", "5"] = "5") -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mat"
        savemat(str(path), CONTENT if content is None else content, format=version, do_compression=compressed)
        return path.read_bytes()


PLAIN = written(False)


@pytest.mark.parametrize("compressed", [False, True])
def test_what_scipy_writes_passes(compressed: bool) -> None:
    check_mat5(written(compressed))


def test_files_of_version_4_pass() -> None:
    check_mat5(written(False, {"gt": np.eye(3)}, "4"))


@given(at=st.integers(128, len(PLAIN) - 1), instead=st.binary(min_size=1, max_size=4), cut=st.booleans())
def test_what_passes_does_not_crash(at: int, instead: bytes, cut: bool) -> None:
    damaged = PLAIN[:at] + instead + (b"" if cut else PLAIN[at + len(instead) :])
    try:
        check_mat5(damaged)
    except ValueError:
        return
    # Any error is the caller's to tell; what must not happen is that the process ends.
    with tempfile.NamedTemporaryFile(suffix=".mat") as file, contextlib.suppress(Exception):
        file.write(damaged)
        file.flush()
        loadmat(file.name)


def test_a_type_that_scipy_would_follow_out_of_its_table_is_refused() -> None:
    plain = written(False, {"gt": np.array([[0.25, 0.5, 0.75]])})
    at = plain.index(struct.pack("<II", 9, 24))
    with pytest.raises(ValueError, match=f"byte {at + 8}: values of type 12345, expected numbers"):
        check_mat5(plain[:at] + struct.pack("<I", 12345) + plain[at + 4 :])


def test_lines_of_text_that_have_no_bytes_are_refused() -> None:
    plain = written(False, {"none": np.array([""])})
    at = plain.index(struct.pack("<IIii", 5, 8, 0, 0))
    check_mat5(plain[: at + 8] + struct.pack("<ii", 1000, 0) + plain[at + 16 :])
    with pytest.raises(ValueError, match="1001 lines"):
        check_mat5(plain[: at + 8] + struct.pack("<ii", 1001, 0) + plain[at + 16 :])


def test_values_that_are_not_as_many_as_the_dimensions_are_refused() -> None:
    plain = written(False, {"gt": np.array([[0.25, 0.5, 0.75]])})
    at = plain.index(struct.pack("<ii", 1, 3))
    with pytest.raises(ValueError, match=r"24 bytes.*4 of 8"):
        check_mat5(plain[:at] + struct.pack("<ii", 1, 4) + plain[at + 8 :])


def test_a_bomb_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matlab, "_LARGEST", 1 << 16)
    packed = zlib.compress(bytes((1 << 16) + 1), 9)
    with pytest.raises(ValueError, match="holds more than"):
        check_mat5(PLAIN[:128] + struct.pack("<II", 15, len(packed)) + packed)


# Type codes, sizes and classes as in "MAT-File Format", R2019b, chapter 1.
NUMBERS = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
TEXTS = {**NUMBERS, 16: 1, 17: 2, 18: 4}
CELL, STRUCT, CHAR, SPARSE, DOUBLE, UINT64 = 1, 2, 4, 5, 6, 15
COMPLEX = 0x0800


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def array(flags: int, sides: tuple[int, ...], *values: bytes) -> bytes:
    """Return an array of class and flags, its dimensions, and the elements of its values."""
    told = element(6, struct.pack("<II", flags, 0)) + element(5, struct.pack(f"<{len(sides)}i", *sides))
    return element(14, told + element(1, b"a") + b"".join(values))


def fields(length: int, names: bytes, *arrays: bytes) -> bytes:
    return array(STRUCT, (1, 1), struct.pack("<HHi", 5, 4, length), element(1, names), *arrays)


def nested(depth: int) -> bytes:
    return array(CELL, (1, 1), nested(depth - 1)) if depth else array(DOUBLE, (0, 0), element(9, b""))


def refused(part: bytes) -> str:
    """Return why a file is refused whose one variable is given; "" if it is not."""
    try:
        check_mat5(PLAIN[:128] + part)
    except ValueError as error:
        return str(error)
    return ""


def test_values_take_the_bytes_of_their_type() -> None:
    for kind in range(25):
        size = NUMBERS.get(kind, 0)
        given = {count: refused(array(DOUBLE, (1, 3), element(kind, bytes(count)))) for count in range(33)}
        assert [count for count, why in given.items() if not why] == ([3 * size] if size else []), kind
        if not size:
            assert f"values of type {kind}, expected numbers" in given[24]
        lines = [count for count in range(9) if not refused(array(CHAR, (1, 3), element(kind, bytes(count))))]
        assert lines == ([*range(0, 9, TEXTS[kind])] if kind in TEXTS else []), kind


def test_arrays_are_of_a_known_class_and_have_its_parts() -> None:
    part, place, empty = element(9, bytes(24)), element(5, bytes(12)), array(DOUBLE, (0, 0), element(9, b""))
    passed = [kind for kind in range(40) if not refused(array(kind, (1, 3), part))]
    assert passed == [CHAR, *range(DOUBLE, UINT64 + 1)]
    passed = [count for count in range(5) if not refused(array(DOUBLE | COMPLEX, (3, 1), *[part] * count))]
    assert passed == [2]
    for flags, wanted in ((SPARSE, 1), (SPARSE | COMPLEX, 2)):
        passed = [count for count in range(5) if not refused(array(flags, (3, 3), place, place, *[part] * count))]
        assert passed == [wanted]
    assert "values of type 9" in refused(array(SPARSE, (3, 3), part, place, part))
    passed = [count for count in range(9) if not refused(array(CELL, (2, 3), *[empty] * count))]
    assert passed == [6]
    assert "of type 9 in a cell" in refused(array(CELL, (1, 1), part))
    assert not refused(array(CELL, (0, 0)))
    assert not refused(array(DOUBLE, (1, 3, 1), part))
    assert not refused(fields(1, b"x", empty))
    assert "12 bytes, each 5" in refused(fields(5, bytes(12), empty, empty, empty))
    assert "each 0" in refused(fields(0, bytes(12)))
    passed = [count for count in range(9) if not refused(fields(4, bytes(12), *[empty] * count))]
    assert passed == [3]
    assert not refused(nested(20))
    assert "more than 20 deep" in refused(nested(21))


def test_tags_flags_and_dimensions_are_whole() -> None:
    name, value, flags = element(1, b"a"), element(9, bytes(8)), element(6, struct.pack("<II", DOUBLE, 0))
    sides = element(5, struct.pack("<ii", 1, 1))
    for parts, why in (
        ([flags, sides, name, value], ""),
        ([flags, sides], "an array of 2 parts"),
        ([element(6, bytes(4)), sides, name, value], "no flags"),
        ([element(5, bytes(8)), sides, name, value], "no flags"),
        ([flags, element(5, bytes(4)), name, value], "no dimensions"),
        ([flags, element(5, bytes(10)), name, value], "no dimensions"),
        ([flags, element(6, bytes(8)), name, value], "no dimensions"),
        ([flags, element(5, struct.pack("<ii", 1, -1)), name, value], "the dimensions are [1, -1]"),
        ([flags, sides, element(2, b"a"), value], "no name"),
        # The name in a small element: four bytes at most.
        ([flags, sides, struct.pack("<HH4s", 1, 4, b"long"), value], ""),
        ([flags, sides, struct.pack("<HH4s", 1, 5, b"long"), value], "a small element of 5 bytes"),
        ([flags, sides, name, value, bytes(7)], "7 bytes are left"),
    ):
        found = refused(struct.pack("<II", 14, sum(map(len, parts))) + b"".join(parts))
        assert (why in found) if why else not found, (why, found)
    assert not refused(element(14, b""))
    assert "of type 9, expected an array" in refused(value)
    assert "does not hold one array" in refused(element(15, zlib.compress(nested(0) + nested(0))))
    with pytest.raises(ValueError, match="it has 127 bytes"):
        check_mat5(PLAIN[:127])
    with pytest.raises(ValueError, match=r"order.*b'XX'"):
        check_mat5(PLAIN[:126] + b"XX")


def test_variables_are_what_is_expected_of_them() -> None:
    content = {
        "lights": np.arange(6).reshape(2, 3),
        "flat": np.arange(3),
        "bad": np.array([[1, 2, np.inf]]),
        "words": np.array([["a", "b", "c"]]),
        "level": np.array([[128]], np.uint16),
        "zero": np.array([[0.0]]),
        "minus": np.array([[-1.0]]),
        "names": np.array([[np.array(["a.png "])], [np.array([["b"]])]], dtype=object),
        "numbers": np.array([[np.array([1])]], dtype=object),
    }
    path = Path("gt.mat")
    np.testing.assert_array_equal(matlab.table(content, "lights", path, 3), [[0, 1, 2], [3, 4, 5]])
    for name, columns in (("lights", 2), ("flat", 3), ("bad", 3), ("words", 3), ("none", 3)):
        with pytest.raises(FormatError, match=rf"gt\.mat.*{name}"):
            matlab.table(content, name, path, columns)
    assert (matlab.scalar(content, "level", path), matlab.scalar(content, "zero", path)) == (128, 0)
    for name in ("flat", "minus", "words", "none"):
        with pytest.raises(FormatError, match=rf"gt\.mat.*{name}"):
            matlab.scalar(content, name, path)
    with pytest.raises(FormatError, match="none among"):
        matlab.scalar({"__header__": b"", "it": 1}, "none", path)
    assert matlab.strings(content, "names", path) == ["a.png", "b"]
    assert matlab.strings(content, "none", path) is None
    for name in ("numbers", "lights"):
        with pytest.raises(FormatError, match=f"{name} holds"):
            matlab.strings(content, name, path)


def test_a_file_is_checked_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "deep.mat").write_bytes(PLAIN[:128] + nested(21))
    with pytest.raises(FormatError, match="more than 20 deep"):
        matlab.read_mat(tmp_path / "deep.mat")
