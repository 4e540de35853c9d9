"""Cube++ and SimpleCube++: values computed by hand on made-up copies."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.datasets import DataOptions, open_scenes
from foundation.errors import FormatError, InputError
from tests.evaluation.datasets.made_up import cube_plus_plus, image_of, simple_cube, write_png

pytestmark = pytest.mark.slow


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    cube_plus_plus(tmp_path)
    return tmp_path


@pytest.fixture
def simple(tmp_path: Path) -> Path:
    simple_cube(tmp_path)
    return tmp_path


def test_the_mean_is_taken_where_there_is_one(whole: Path) -> None:
    data = open_scenes(whole)
    assert [scene.name for scene in data.scenes] == ["00_0001.png"]
    assert data.scenes[0].truth.tolist() == [0.15, 0.5, 0.35]
    assert "1 of these have no mean and are left out" in data.treatment["images"]
    assert "the published Cube++ has 4890" in data.treatment["images"]


@pytest.mark.parametrize(
    ("truth", "light"),
    [
        ("left", [0.1, 0.5, 0.4]),
        ("right", [0.2, 0.5, 0.3]),
        ("left-white", [0.11, 0.5, 0.39]),
        ("RIGHT_white", [0.21, 0.5, 0.29]),
    ],
)
def test_each_face(whole: Path, truth: str, light: list[float]) -> None:
    data = open_scenes(whole, options=DataOptions(truth=truth))
    assert [scene.truth.tolist() for scene in data.scenes] == [light, light]
    assert data.treatment["ground truth"] == f"{truth.lower().replace('-', '_')} of gt.csv"


def test_levels_and_mask(whole: Path) -> None:
    own, other = open_scenes(whole, options=DataOptions(truth="left")).scenes
    image, mask = own.read()
    assert image[0, 0].tolist() == [6952, 0, 4952]
    assert image[1, 1].tolist() == [952, 2952, 1952]
    assert mask is not None
    assert mask.sum() == 1000 * 700
    assert mask[728:, 1892:].all()
    assert own.saturation == 8000 - 2048  # MakerNotes:NormalWhiteLevel of its row.
    assert other.saturation == 9000 - 2 - 2048  # Its row has none: the largest value less 2.


def test_without_properties_saturation_is_the_peak(whole: Path) -> None:
    (whole / "properties.csv").unlink()
    data = open_scenes(whole)
    assert "m - 2" in data.treatment["saturation"]
    assert data.scenes[0].saturation == 9000 - 2 - 2048


def test_a_white_level_below_black_is_refused(whole: Path) -> None:
    (whole / "properties.csv").write_text("image,MakerNotes:NormalWhiteLevel\n00_0001,1000\n")
    with pytest.raises(FormatError, match=r"properties\.csv, line 2: MakerNotes:NormalWhiteLevel is 1000, expected"):
        open_scenes(whole)


def test_another_size_is_refused(whole: Path) -> None:
    write_png(whole / "PNG" / "00_0001.png", image_of(432, 648))
    with pytest.raises(FormatError, match=r"is 648 × 432, expected 2592 × 1728"):
        open_scenes(whole).scenes[0].read()


def test_missing_columns_and_truths(whole: Path) -> None:
    table = (whole / "gt.csv").read_text()
    (whole / "gt.csv").write_text(table.replace("mean_b", "mean_blue"))
    with pytest.raises(FormatError, match=r"gt\.csv has the columns .*; mean_b is missing"):
        open_scenes(whole)
    (whole / "gt.csv").write_text(table.replace("0.15,0.5,0.35", "nan,nan,nan"))
    with pytest.raises(InputError, match=r"no image of .* has the ground truth 'mean'"):
        open_scenes(whole)
    (whole / "gt.csv").write_text(table.replace("0.15,0.5,0.35", "0.15,,0.35"))
    with pytest.raises(FormatError, match=r"gt\.csv, line 2: mean_g is '', expected a number"):
        open_scenes(whole)


def test_simple_cube(simple: Path) -> None:
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


def test_a_part_of_simple_cube(simple: Path) -> None:
    data = open_scenes(simple, options=DataOptions(subset="test"))
    assert [scene.name for scene in data.scenes] == ["01_0004.png"]
    with pytest.raises(InputError, match="has no subset 'val'; it has train, test"):
        open_scenes(simple, options=DataOptions(subset="val"))
    (simple / "test" / "PNG" / "01_0004.png").unlink()
    with pytest.raises(FormatError, match=r"lacks 1 of the 1 images of test/gt\.csv \(01_0004\)"):
        open_scenes(simple)
