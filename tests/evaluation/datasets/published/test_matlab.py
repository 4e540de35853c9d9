"""Values of MATLAB files are what was written, and damaged files are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from evaluation.datasets.published.matlab import read_mat, scalar, strings, table
from foundation.errors import FormatError

NAMES = np.array([["SonyA57_0001 "], ["b"]], dtype=object)


def write(path: Path) -> None:
    content = {"lights": np.arange(6.0).reshape(2, 3), "names": NAMES, "level": 128, "text": "dark", "bad": [[np.nan]]}
    savemat(str(path), content, do_compression=True)


def read_all(path: Path) -> None:
    content = read_mat(path)
    table(content, "lights", path, 3)
    strings(content, "names", path)
    scalar(content, "level", path)


def test_values_are_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    write(path)
    content = read_mat(path)
    np.testing.assert_array_equal(table(content, "lights", path, 3), [[0, 1, 2], [3, 4, 5]])
    assert strings(content, "names", path) == ["SonyA57_0001", "b"]
    assert strings(content, "none", path) is None
    assert scalar(content, "level", path) == 128
    for wrong in (
        lambda: table(content, "lights", path, 4),
        lambda: table(content, "bad", path, 1),
        lambda: table(content, "text", path, 3),
        lambda: scalar(content, "lights", path),
        lambda: strings(content, "lights", path),
        lambda: scalar(content, "none", path),
    ):
        with pytest.raises(FormatError, match=r"a\.mat"):
            wrong()


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_file_that_ends_early_is_refused(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "a.mat"
    write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(FormatError, match=r"a\.mat"):
        read_all(path)
