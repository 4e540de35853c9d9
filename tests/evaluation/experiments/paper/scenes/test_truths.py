"""Ground truths from files and data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.experiments.paper.material import read_truths
from foundation.errors import FormatError, InputError

TEXT = "File,GT_R,GT_G,GT_B\nA/1.png,1,2,3\nB/1.png,4,5,6\n\nA/2.png,7,8,9\n"


def test_rows_of_one_camera(tmp_path: Path) -> None:
    path = tmp_path / "eight.csv"
    path.write_text(TEXT)
    everything = read_truths(str(path))
    assert everything.name == "eight"
    assert everything.lights.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    one = read_truths(f"{path}#A/")
    assert one.name == "A"
    assert one.lights.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert one.images == ("A/1.png", "A/2.png")
    assert everything.images == ("A/1.png", "B/1.png", "A/2.png")
    with pytest.raises(InputError, match=r"no row of .* begins with 'C'; the first begins with 'A/1.png'"):
        read_truths(f"{path}#C")


def test_a_file_without_names(tmp_path: Path) -> None:
    path = tmp_path / "plain.txt"
    path.write_text("1 2 3\n4 5 6\n")
    assert read_truths(str(path)).lights.tolist() == [[1, 2, 3], [4, 5, 6]]
    with pytest.raises(FormatError, match="2 ground truths and 1 names"):
        read_truths(f"{path}#1")


def test_those_of_a_data_set(tmp_path: Path) -> None:
    path = tmp_path / "set.npz"
    lights = np.array([[1.0, 2, 1], [2, 2, 1]])
    np.savez(path, images=np.ones((2, 4, 4, 3), np.float32), gt=lights, names=np.array(["a", "b"]))
    found = read_truths(str(path))
    assert found.name == "set"
    assert found.lights.tolist() == lights.tolist()
