"""Read variables of MATLAB files and refuse damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from evaluation.datasets.published.matlab import names_or_none, numeric_table, read_mat, scalar
from foundation.errors import FormatError

NAMES = np.array([["SonyA57_0001 "], ["b"]], dtype=object)


def write(path: Path) -> None:
    content = {"lights": np.arange(6.0).reshape(2, 3), "names": NAMES, "level": 128, "text": "dark", "bad": [[np.nan]]}
    savemat(str(path), content, do_compression=True)


def read_all(path: Path) -> None:
    content = read_mat(path)
    numeric_table(content, "lights", path, 3)
    names_or_none(content, "names", path)
    scalar(content, "level", path)


def test_reads_written_values(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    write(path)
    content = read_mat(path)
    np.testing.assert_array_equal(numeric_table(content, "lights", path, 3), [[0, 1, 2], [3, 4, 5]])
    assert names_or_none(content, "names", path) == ["SonyA57_0001", "b"]
    assert names_or_none(content, "none", path) is None
    assert scalar(content, "level", path) == 128
    for read_wrong in (
        lambda: numeric_table(content, "lights", path, 4),
        lambda: numeric_table(content, "bad", path, 1),
        lambda: numeric_table(content, "text", path, 3),
        lambda: scalar(content, "lights", path),
        lambda: names_or_none(content, "lights", path),
        lambda: scalar(content, "none", path),
    ):
        with pytest.raises(FormatError, match=r"a\.mat"):
            read_wrong()


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.9])
def test_refuses_truncated_file(tmp_path: Path, fraction: float) -> None:
    path = tmp_path / "a.mat"
    write(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(FormatError, match=r"a\.mat"):
        read_all(path)
