"""LEVI: values of the authors' program for a synthetic copy."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import loadmat

from evaluation.datasets import DataOptions, open_scenes
from foundation.errors import FormatError
from tests.evaluation.datasets.made_up import levi, write_mat, write_png


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    levi(tmp_path)
    return tmp_path


def test_reads_as_authors_program(copy: Path) -> None:
    # Line by line as RGB_estimation in utils/Algorithm.py of github.com/BrianChen1120/RL-AWB, without the reduction.
    data = open_scenes(copy)
    assert [scene.name for scene in data.scenes] == [f"{number}.png" for number in range(1, 12)]
    for index, scene in enumerate(data.scenes, start=1):
        truth = loadmat(copy / "gt.mat")["gts"][index - 1, :].flatten()
        stored = cv2.imread(str(copy / "img" / f"{index}.png"), cv2.IMREAD_UNCHANGED)
        grey = cv2.imread(str(copy / "msk" / f"{index}.png"), cv2.IMREAD_GRAYSCALE)
        assert stored is not None
        assert grey is not None
        expected = cv2.cvtColor(stored, cv2.COLOR_BGR2RGB).astype(np.float64)
        image, mask = scene.read()
        np.testing.assert_array_equal(image, expected)
        np.testing.assert_array_equal(mask, grey > 0)
        np.testing.assert_array_equal(scene.truth, truth)
        assert scene.saturation == np.max(expected) * 0.95


@pytest.mark.parametrize("variable", ["gt", "real_rgb"])
def test_reads_other_names_of_ground_truths(copy: Path, variable: str) -> None:
    write_mat(copy / "gt.mat", {variable: np.ones((11, 3))})
    data = open_scenes(copy, options=DataOptions(black=128, saturation=4000))
    assert data.scenes[0].truth.tolist() == [1, 1, 1]
    assert data.scenes[0].saturation == 4000 - 128


def test_refuses_inverted_and_missing_masks(copy: Path) -> None:
    write_png(copy / "msk" / "2.png", np.full((8, 10, 3), 255, np.uint8))
    with pytest.raises(FormatError, match="100%"):
        open_scenes(copy).scenes[1].read()
    (copy / "msk" / "2.png").unlink()
    with pytest.raises(FormatError, match="masks of 1 images"):
        open_scenes(copy)
