"""Gehler-Shi: values computed by hand for a synthetic copy of three images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.datasets import DataOptions, open_scenes
from evaluation.datasets.published.gehler_shi import NAMES
from foundation.errors import FormatError, InputError
from tests.evaluation.datasets.made_up import gehler_shi, image_of, write_mat, write_png

PARTIAL = DataOptions(partial=True)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    gehler_shi(tmp_path)
    return tmp_path


def test_names_are_sorted() -> None:
    assert len(NAMES) == 568
    assert list(NAMES) == sorted(NAMES)
    assert sum(name.startswith("8D5U") for name in NAMES) == 86
    # Numbers and names of files in public copies of the recommended release.
    for number, name in ((1, "8D5U5524"), (26, "8D5U5552"), (100, "IMG_0296"), (120, "IMG_0323"), (568, "IMG_0903")):
        assert NAMES[number - 1] == name


def test_applies_levels_mask_and_ground_truth(copy: Path) -> None:
    data = open_scenes(copy, options=PARTIAL)
    assert [scene.name for scene in data.scenes] == ["8D5U5524.png", "IMG_0281.png", "IMG_0903.png"]
    # Row n of the synthetic ground truth, from 0, is n + 1, n + 1000, n + 2000.
    lights = [scene.truth.tolist() for scene in data.scenes]
    assert lights == [[1, 1000, 2000], [87, 1086, 2086], [568, 1567, 2567]]
    first, second, _ = data.scenes
    assert first.read()[0][0, 0].tolist() == [9000, 100, 7000]
    assert second.read()[0][0, 0].tolist() == [9000 - 129, 0, 7000 - 129]
    assert (first.saturation, second.saturation) == (3692, 3692 - 129)
    _, mask = first.read()
    expected = np.zeros((8, 10), bool)
    expected[2:5, 2:7] = True
    np.testing.assert_array_equal(mask, expected)
    assert "recommended by Hemrit et al., 2018" in data.treatment["ground truth"]
    assert "565 of the 568" in data.treatment["images"]


def test_uses_ground_truth_of_shi_only_on_request(copy: Path) -> None:
    data = open_scenes(copy, options=DataOptions(partial=True, truth="shi"))
    assert data.scenes[0].truth.tolist() == [2000, 1000, 1]
    assert "not comparable" in data.treatment["ground truth"]
    (copy / "ColorCheckerData.mat").unlink()
    with pytest.raises(InputError, match=r"ColorCheckerData\.mat.*colorconstancy\.com.*--read truth"):
        open_scenes(copy, options=PARTIAL)
    # The data set is still recognised by its chart corners.
    (copy / "real_illum_568..mat").unlink()
    with pytest.raises(InputError, match=r"has no ColorCheckerData\.mat"):
        open_scenes(copy, options=PARTIAL)


def test_refuses_missing_and_unlisted_images(copy: Path) -> None:
    with pytest.raises(FormatError, match=r"565.*568.*8D5U5525.*--read partial"):
        open_scenes(copy)
    write_png(copy / "Canon1D" / "png" / "8D5U5551.png", image_of(8, 10))  # annotated, but not one of the 568
    with pytest.raises(FormatError, match=r"1.*8D5U5551"):
        open_scenes(copy, options=PARTIAL)


def test_refuses_images_without_chart_corners(copy: Path) -> None:
    (copy / "coordinates" / "IMG_0903_macbeth.txt").unlink()
    with pytest.raises(FormatError, match=r"1.*coordinates/IMG_0903_macbeth\.txt"):
        open_scenes(copy, options=PARTIAL)


@pytest.mark.parametrize("text", ["", "20 16\n4 4\n", "20\n4 4\n12 4\n4 8\n12 8\n", "0 16\n4 4\n12 4\n4 8\n12 8\n"])
def test_refuses_invalid_chart_corners(copy: Path, text: str) -> None:
    (copy / "coordinates" / "8D5U5524_macbeth.txt").write_text(text)
    scene = open_scenes(copy, options=DataOptions(partial=True, camera="1D")).scenes[0]
    with pytest.raises(FormatError, match=r"8D5U5524_macbeth\.txt"):
        scene.read()


def test_refuses_ground_truth_with_wrong_number_of_rows(copy: Path) -> None:
    write_mat(copy / "ColorCheckerData.mat", {"REC_groundtruth": np.ones((482, 3))})
    with pytest.raises(FormatError, match=r"REC_groundtruth.*482.*568"):
        open_scenes(copy, options=PARTIAL)
