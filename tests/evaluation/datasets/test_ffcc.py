"""Values of FFCC folders, computed by hand for a synthetic copy."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.datasets import DataOptions, open_scenes
from foundation.errors import FormatError
from tests.evaluation.datasets.made_up import ffcc, image_of, write_png


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    ffcc(tmp_path)
    return tmp_path


def test_reads_thumbnails_of_8_and_16_bits(copy: Path) -> None:
    data = open_scenes(copy)
    assert [scene.name for scene in data.scenes] == ["folder_1/000001.png", "folder_2/000001.png"]
    assert [scene.truth.tolist() for scene in data.scenes] == [[0.500249, 0.819743, 0.278876], [0.1, 0.2, 0.3]]
    deep, shallow = data.scenes
    image, mask = deep.read()
    assert image[0, 0].tolist() == [9000, 100, 7000]
    assert mask is not None
    assert mask.sum() == 1
    assert mask[1, 2]
    small, _ = shallow.read()
    assert small.dtype == image.dtype
    assert small[3, 3].tolist() == [30, 50, 40]
    assert deep.saturation is None


def test_reads_texts_in_capitals(copy: Path) -> None:
    (copy / "folder_2/000001.txt").rename(copy / "folder_2/000001.TXT")
    assert open_scenes(copy).scenes[1].truth.tolist() == [0.1, 0.2, 0.3]


def test_refuses_files_without_partner(copy: Path) -> None:
    write_png(copy / "folder_1" / "2.png", image_of(2, 2))
    with pytest.raises(FormatError, match=r"2.*1.*2\.png.*0"):
        open_scenes(copy)
    (copy / "folder_1" / "2.png").unlink()
    (copy / "folder_1" / "readme.txt").write_text("hello")
    with pytest.raises(FormatError, match=r"0.*1.*readme\.txt"):
        open_scenes(copy)
    assert len(open_scenes(copy, options=DataOptions(partial=True)).scenes) == 2


def test_reports_invalid_ground_truth_on_use(copy: Path) -> None:
    (copy / "folder_1" / "000001.txt").write_text("0.5\n0.8\nblue\n")
    with pytest.raises(FormatError, match=r"000001\.txt"):
        _ = open_scenes(copy).scenes[0].truth
