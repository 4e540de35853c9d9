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
    with pytest.raises(ValueError, match="1001 lines of text in 0 bytes"):
        check_mat5(plain[: at + 8] + struct.pack("<ii", 1001, 0) + plain[at + 16 :])


def test_values_that_are_not_as_many_as_the_dimensions_are_refused() -> None:
    plain = written(False, {"gt": np.array([[0.25, 0.5, 0.75]])})
    at = plain.index(struct.pack("<ii", 1, 3))
    with pytest.raises(ValueError, match="24 bytes of values, expected 4 of 8 bytes"):
        check_mat5(plain[:at] + struct.pack("<ii", 1, 4) + plain[at + 8 :])


def test_a_bomb_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matlab, "_LARGEST", 1 << 16)
    packed = zlib.compress(bytes((1 << 16) + 1), 9)
    with pytest.raises(ValueError, match="holds more than"):
        check_mat5(PLAIN[:128] + struct.pack("<II", 15, len(packed)) + packed)
