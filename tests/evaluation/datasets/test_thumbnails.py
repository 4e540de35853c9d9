"""Thumbnails in an archive: what is masked, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.datasets import DataOptions, open_scenes
from foundation.errors import FormatError
from tests.evaluation.datasets.made_up import thumbnails

SOME = {"images": np.ones((2, 4, 5, 3), np.float32), "gt": np.ones((2, 3)), "names": ["a", "b"]}


def test_values(tmp_path: Path) -> None:
    thumbnails(tmp_path)
    one, two = open_scenes(tmp_path / "thumbs.npz").scenes
    image, mask = one.read()
    assert image[0, 0].tolist() == [9000, 100, 7000]
    assert mask is not None
    assert mask.sum() == 1
    assert mask[1, 1]
    assert two.truth.tolist() == [1, 2, 1]
    assert one.saturation is None
    stated = open_scenes(tmp_path / "thumbs.npz", options=DataOptions(saturation=8000))
    assert [scene.saturation for scene in stated.scenes] == [8000, 8000]
    assert stated.treatment["saturation"] == "8000, as the user gave it"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gt": np.ones((3, 3))}, r"images \(2, 4, 5, 3\), gt \(3, 3\)"),
        ({"gt": np.array([[1, 1, 1], [1, -1, 1]])}, "gt of b: 1 -1 1 is no light"),
        ({"images": np.ones((2, 4, 5, 3), np.uint8)}, "uint8.*uint16"),
        ({"images": np.ones((2, 4, 5))}, r"images \(2, 4, 5\)"),
        ({"names": ["a"]}, r"names \(1,\)"),
        ({"gt": [["a", "b", "c"]] * 2}, "is no archive of thumbnails"),
        ({"names": ["a", "a"]}, "'a'"),
        ({"names": ["a", "b\n"]}, r"'b\\n'"),
        ({"images": np.full((2, 4, 5, 3), np.nan, np.float32)}, "a has pixels that are not finite"),
    ],
)
def test_what_is_no_such_archive(tmp_path: Path, change: dict[str, npt.ArrayLike], message: str) -> None:
    np.savez(
        tmp_path / "set.npz", allow_pickle=False, **{name: np.asarray(value) for name, value in (SOME | change).items()}
    )
    with pytest.raises(FormatError, match=message):
        open_scenes(tmp_path / "set.npz")


def test_values_below_black_are_black_and_counted(tmp_path: Path) -> None:
    images = np.ones((2, 4, 5, 3), np.float32)
    images[1, 0, 0] = [-1, 2, 3]
    np.savez(tmp_path / "set.npz", images=images, gt=SOME["gt"], names=[b"a", b"b"])
    found = open_scenes(tmp_path / "set.npz")
    assert [scene.name for scene in found.scenes] == ["a", "b"]
    assert found.scenes[1].read()[0][0, 0].tolist() == [0, 2, 3]
    assert "1 values below it are taken as 0" in found.treatment["black level"]
