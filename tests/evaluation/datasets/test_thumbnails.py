"""Thumbnails in an archive: masks, levels and refused archives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.datasets import DataOptions, open_scenes
from foundation.errors import FormatError
from tests.evaluation.datasets.made_up import thumbnails

VALID = {"images": np.ones((2, 4, 5, 3), np.float32), "gt": np.ones((2, 3)), "names": ["a", "b"]}


def test_masks_zeros_and_uses_given_saturation(tmp_path: Path) -> None:
    thumbnails(tmp_path)
    first, second = open_scenes(tmp_path / "thumbs.npz").scenes
    image, mask = first.read()
    assert image[0, 0].tolist() == [9000, 100, 7000]
    assert mask is not None
    assert mask.sum() == 1
    assert mask[1, 1]
    assert second.truth.tolist() == [1, 2, 1]
    assert first.saturation is None
    data = open_scenes(tmp_path / "thumbs.npz", options=DataOptions(saturation=8000))
    assert [scene.saturation for scene in data.scenes] == [8000, 8000]
    assert data.treatment["saturation"].startswith("8000, ")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gt": np.ones((3, 3))}, r"images \(2, 4, 5, 3\), gt \(3, 3\)"),
        ({"gt": np.array([[1, 1, 1], [1, -1, 1]])}, "gt of b: .*1 -1 1"),
        ({"images": np.ones((2, 4, 5, 3), np.uint8)}, "uint8.*uint16"),
        ({"images": np.ones((2, 4, 5))}, r"images \(2, 4, 5\)"),
        ({"names": ["a"]}, r"names \(1,\)"),
        ({"gt": [["a", "b", "c"]] * 2}, "cannot be read as thumbnails"),
        ({"names": ["a", "a"]}, "'a'"),
        ({"names": ["a", "b\n"]}, r"'b\\n'"),
        ({"images": np.full((2, 4, 5, 3), np.nan, np.float32)}, "a has infinite or NaN pixels"),
    ],
)
def test_refuses_invalid_archive(tmp_path: Path, change: dict[str, npt.ArrayLike], message: str) -> None:
    np.savez(
        tmp_path / "set.npz",
        allow_pickle=False,
        **{name: np.asarray(value) for name, value in (VALID | change).items()},
    )
    with pytest.raises(FormatError, match=message):
        open_scenes(tmp_path / "set.npz")


def test_clips_and_counts_negative_values(tmp_path: Path) -> None:
    images = np.ones((2, 4, 5, 3), np.float32)
    images[1, 0, 0] = [-1, 2, 3]
    np.savez(tmp_path / "set.npz", images=images, gt=VALID["gt"], names=[b"a", b"b"])
    data = open_scenes(tmp_path / "set.npz")
    assert [scene.name for scene in data.scenes] == ["a", "b"]
    assert data.scenes[1].read()[0][0, 0].tolist() == [0, 2, 3]
    assert "1 negative values are set to 0" in data.treatment["black level"]
