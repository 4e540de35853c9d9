"""Cube+, Cube++ and SimpleCube++: values computed by hand for synthetic copies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.datasets import DataOptions, open_scenes
from foundation.errors import FormatError, InputError
from tests.evaluation.datasets.made_up import cube_plus, cube_plus_plus, image_of, simple_cube, write_png

pytestmark = pytest.mark.slow


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    cube_plus(tmp_path)
    return tmp_path


def test_cube_plus_applies_levels_mask_and_ground_truth(copy: Path) -> None:
    data = open_scenes(copy)
    assert [scene.name for scene in data.scenes] == ["1.PNG", "2.PNG", "3.PNG"]
    np.testing.assert_array_equal(
        [scene.truth for scene in data.scenes], [[0.1, 0.5, 0.4], [0.2, 0.5, 0.3], [0.3, 0.5, 0.2]]
    )
    image, mask = data.scenes[2].read()
    assert image.dtype == np.uint16
    assert image[0, 0].tolist() == [9000 - 2048, 0, 7000 - 2048]  # 100 is below black.
    assert image[5, 5].tolist() == [952, 2952, 1952]
    assert mask is not None
    assert mask.sum() == 100
    assert mask[1050:, 2050:].all()
    # The largest value is 9000, and the authors discard pixels from m - 2.
    assert data.scenes[2].saturation == 9000 - 2 - 2048
    assert data.scenes[0].saturation == 6950  # requested before the image is read
    assert "the published Cube+ has 1707" in data.treatment["images"]


def test_distinguishes_cube_from_cube_plus(copy: Path) -> None:
    (copy / "cube+_gt.txt").rename(copy / "cube_gt.txt")
    data = open_scenes(copy)
    assert data.name == "Cube"
    assert "the published Cube has 1365" in data.treatment["images"]


def test_refuses_unlisted_and_duplicate_images(copy: Path) -> None:
    write_png(copy / "4.png", image_of(4, 4))
    with pytest.raises(FormatError, match=r"1 images.*cube\+_gt.txt \(4\)"):
        open_scenes(copy)
    (copy / "4.png").unlink()
    write_png(copy / "PNG" / "1.PNG", image_of(4, 4))
    with pytest.raises(FormatError, match=r"1\.PNG.*1\.PNG"):
        open_scenes(copy)


def test_refuses_reduced_copy(copy: Path) -> None:
    write_png(copy / "1.PNG", image_of(866, 1300))
    with pytest.raises(FormatError, match=r"1\.PNG.*1300.*866.*2601.*1732"):
        open_scenes(copy).scenes[0].read()


@pytest.fixture
def plus_plus(tmp_path: Path) -> Path:
    cube_plus_plus(tmp_path)
    return tmp_path


@pytest.fixture
def simple(tmp_path: Path) -> Path:
    simple_cube(tmp_path)
    return tmp_path


def test_excludes_images_without_mean_ground_truth(plus_plus: Path) -> None:
    data = open_scenes(plus_plus)
    assert [scene.name for scene in data.scenes] == ["00_0001.png"]
    assert data.scenes[0].truth.tolist() == [0.15, 0.5, 0.35]
    assert "1 of these have no mean and are excluded" in data.treatment["images"]
    assert "the published Cube++ has 4890" in data.treatment["images"]


def test_cube_plus_plus_applies_levels_and_mask(plus_plus: Path) -> None:
    with_level, without_level = open_scenes(plus_plus, options=DataOptions(truth="left")).scenes
    image, mask = with_level.read()
    assert image[0, 0].tolist() == [6952, 0, 4952]
    assert image[1, 1].tolist() == [952, 2952, 1952]
    assert mask is not None
    assert mask.sum() == 1000 * 700
    assert mask[728:, 1892:].all()
    assert with_level.saturation == 8000 - 2048  # MakerNotes:NormalWhiteLevel
    assert without_level.saturation == 9000 - 2 - 2048  # largest value minus 2


def test_refuses_white_level_below_black(plus_plus: Path) -> None:
    (plus_plus / "properties.csv").write_text("image,MakerNotes:NormalWhiteLevel\n00_0001,1000\n")
    with pytest.raises(FormatError, match=r"properties\.csv.*2.*1000"):
        open_scenes(plus_plus)


def test_refuses_missing_columns_and_ground_truths(plus_plus: Path) -> None:
    table = (plus_plus / "gt.csv").read_text()
    (plus_plus / "gt.csv").write_text(table.replace("mean_b", "mean_blue"))
    with pytest.raises(FormatError, match=r"gt\.csv.*mean_b"):
        open_scenes(plus_plus)
    (plus_plus / "gt.csv").write_text(table.replace("0.15,0.5,0.35", "nan,nan,nan"))
    with pytest.raises(InputError, match="'mean'"):
        open_scenes(plus_plus)
    (plus_plus / "gt.csv").write_text(table.replace("0.15,0.5,0.35", "0.15,,0.35"))
    with pytest.raises(FormatError, match=r"gt\.csv.*2.*mean_g"):
        open_scenes(plus_plus)


def test_simple_cube_applies_levels_mask_and_ground_truth(simple: Path) -> None:
    data = open_scenes(simple)
    assert [(scene.name, scene.truth.tolist()) for scene in data.scenes] == [
        ("00_0003.png", [0.15, 0.5, 0.35]),
        ("01_0004.png", [0.2, 0.5, 0.3]),
    ]
    image, mask = data.scenes[1].read()
    assert mask is not None
    assert mask.sum() == 250 * 175
    assert mask[182:, 473:].all()
    assert image[181, 472].tolist() == [952, 2952, 1952]
    assert data.scenes[1].saturation == 9000 - 2 - 2048
    assert data.treatment["images"] == "train 1, test 1; the published SimpleCube++ has 2234"
