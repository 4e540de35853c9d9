"""NUS 8 cameras: values computed by hand for a synthetic copy."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from evaluation.datasets import DataOptions, open_scenes
from evaluation.datasets.published import nus8 as published
from foundation.errors import FormatError
from tests.evaluation.datasets.made_up import nus8, write_mat


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    nus8(tmp_path)
    return tmp_path


def change(path: Path, **variables: object) -> None:
    existing = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    write_mat(path, {name: value for name, value in (existing | variables).items() if value is not None})


def test_applies_levels_mask_and_ground_truth_of_each_camera(copy: Path) -> None:
    data = open_scenes(copy)
    assert [scene.name for scene in data.scenes] == [
        *("NikonD5200_0001", "NikonD5200_0003", "SonyA57_0001", "SonyA57_0003"),
    ]
    nikon, _, sony, last = data.scenes
    assert (nikon.saturation, sony.saturation) == (15892, 4093 - 128)
    assert last.truth.tolist() == [0.2, 0.5, 0.3]
    image, mask = sony.read()
    assert image[0, 0].tolist() == [9000 - 128, 0, 7000 - 128]
    assert nikon.read()[0][0, 0].tolist() == [9000, 100, 7000]
    assert mask is not None
    expected = np.zeros((8, 10), bool)
    expected[1:4, 5:10] = True  # rows 2 to 4 and columns 6 to 10, counted from 1
    np.testing.assert_array_equal(mask, expected)
    _, column = last.read()
    assert column is not None
    assert column.sum() == 8
    assert column[:, 0].all()
    assert data.treatment["black level"].endswith("NikonD5200 0, SonyA57 128")
    assert data.treatment["images"] == "NikonD5200 2 (published: 200), SonyA57 2 (published: 268)"
    assert data.treatment["saturation"].endswith("NikonD5200 15892, SonyA57 4093")


def test_published_counts_add_up() -> None:
    # Authors' page: 1736 images of eight cameras; list of ground truths: 1853 with the ninth.
    counts = dict(published._PUBLISHED_COUNTS)
    assert (len(counts), counts.pop("NikonD40"), sum(counts.values())) == (9, 117, 1736)
    assert counts["Canon1DsMkIII"] == 259


def test_finds_images_and_mat_files_in_separate_folders(copy: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    other = tmp_path_factory.mktemp("other")
    (other / "images").mkdir()
    (other / "ground_truth").mkdir()
    for path in sorted(copy.rglob("*.*")):
        shutil.copy(path, other / ("images" if path.suffix == ".PNG" else "ground_truth"))
    assert [scene.name for scene in open_scenes(other).scenes] == [scene.name for scene in open_scenes(copy).scenes]


def test_uses_order_of_files_without_names_and_requires_all(copy: Path) -> None:
    change(copy / "SonyA57" / "SonyA57_gt.mat", all_image_names=None)
    assert [scene.truth[0] for scene in open_scenes(copy / "SonyA57").scenes] == [0.1, 0.2]
    (copy / "SonyA57" / "SonyA57_0001.PNG").unlink()
    with pytest.raises(FormatError, match=r"2.*1.*SonyA57"):
        open_scenes(copy / "SonyA57", options=DataOptions(partial=True))


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"darkness_level": None}, "darkness_level"),
        ({"saturation_level": [[1, 2]]}, r"saturation_level is \[\[1, 2\]\], expected one number"),
        ({"saturation_level": [[100]]}, "saturation 100, .*black 128"),
        ({"saturation_level": [[128]]}, "saturation 128, .*black 128"),
        ({"CC_coords": np.ones((3, 4))}, "2.*3.*CC_coords"),
        ({"groundtruth_illuminants": np.ones((2, 2))}, "groundtruth_illuminants.*2.*2"),
        ({"groundtruth_illuminants": np.zeros((2, 3))}, "1.*groundtruth_illuminants.*0.*0.*0"),
        ({"all_image_names": np.ones((2, 1))}, "all_image_names"),
    ],
)
def test_refuses_invalid_variables(copy: Path, variables: dict[str, object], message: str) -> None:
    path = copy / "SonyA57" / "SonyA57_gt.mat"
    change(path, **variables)
    with pytest.raises(FormatError, match=message) as refusal:
        open_scenes(copy / "SonyA57")
    assert "SonyA57_gt.mat" in str(refusal.value)


# Corners of 24 patches, which follow the box of the chart.
PATCHES = "\n1.5,3.5,3.5,1.5\n1.5,1.5,2.5,2.5" * 24


def write_masks(copy: Path, first: str, second: str) -> Path:
    folder = copy / "SonyA57" / "CHECKER"
    folder.mkdir()
    for number, text in ((1, first), (3, second)):
        (folder / f"SonyA57_{number:04d}_mask.txt").write_text(text + PATCHES)
        (folder / f"SonyA57_{number:04d}_color.txt").write_text("1,2,3\n" * 24)
    return folder


def test_reads_charts_from_text_files_without_coordinates(copy: Path) -> None:
    change(copy / "SonyA57" / "SonyA57_gt.mat", CC_coords=None)
    # x from 5.7 to 9.9 and y from 2.2 to 4.4, counted from 1: columns 6 to 10 and rows 2 to 4.
    write_masks(copy, "5.7,2.2,4.2,2.2", "1,1,0.4,7")
    data = open_scenes(copy)
    first, second = (scene.read()[1] for scene in data.scenes[2:])
    assert first is not None
    assert second is not None
    expected = np.zeros((8, 10), bool)
    expected[1:4, 5:10] = True
    np.testing.assert_array_equal(first, expected)
    assert np.argwhere(second).tolist() == [[row, 0] for row in range(8)]
    assert data.treatment["mask"] == (
        "the chart: of NikonD5200 by CC_coords of the .mat, rows and columns counted from 1, both ends included; of "
        "SonyA57 by CHECKER/…_mask.txt, first line, as the .mat has no CC_coords"
    )


def test_refuses_image_without_chart(copy: Path) -> None:
    change(copy / "SonyA57" / "SonyA57_gt.mat", CC_coords=None)
    folder = write_masks(copy, "5.7,2.2,4.2,2.2", "1,1,0.4,7")
    (folder / "SonyA57_0003_mask.txt").unlink()
    with pytest.raises(FormatError, match=r"CC_coords.*1.*CHECKER.*SonyA57_0003"):
        open_scenes(copy)
    (copy / "SonyA57" / "SonyA57_0003.PNG").unlink()  # A missing image needs no chart.
    assert len(open_scenes(copy, options=DataOptions(partial=True)).scenes) == 3


def test_prefers_mat_file_and_reports_agreement(copy: Path) -> None:
    write_masks(copy, "5.7,2.2,3.2,2.2", "1,1,0.4,7")
    data = open_scenes(copy / "SonyA57")
    mask = data.scenes[0].read()[1]
    assert mask is not None
    assert mask.sum() == 3 * 5  # from the .mat; the text file ends a column earlier
    assert "(2 of 2 as in CHECKER/…_mask.txt, within 1 px)" in data.treatment["mask"]


def test_refuses_contradicting_chart_positions(copy: Path) -> None:
    write_masks(copy, "2.2,5.7,2.2,4.2", "1,1,0.4,7")  # rows and columns exchanged
    with pytest.raises(FormatError, match=r"2.*4.*CC_coords.*1") as refusal:
        open_scenes(copy)
    for name in ("SonyA57_0001_mask.txt", "SonyA57_gt.mat"):
        assert name in str(refusal.value)


def test_reads_text_files_of_all_cameras_from_one_folder(copy: Path) -> None:
    change(copy / "SonyA57" / "SonyA57_gt.mat", CC_coords=None)
    write_masks(copy, "6,2,4,2", "1,1,0.4,7").rename(copy / "CHECKER")
    mask = open_scenes(copy).scenes[2].read()[1]
    assert mask is not None
    assert mask.sum() == 3 * 5


def test_accepts_boxes_with_half_overlap(copy: Path) -> None:
    # The box in the .mat has 15 px: half of a box of 30 px, less of one of 40 px.
    folder = write_masks(copy, "1,2,9,2", "1,1,0.4,7")
    assert "within 5 px" in open_scenes(copy / "SonyA57").treatment["mask"]
    (folder / "SonyA57_0001_mask.txt").write_text("1,1,9,3")
    with pytest.raises(FormatError):
        open_scenes(copy / "SonyA57")


def test_rounds_box_like_imcrop(tmp_path: Path) -> None:
    (tmp_path / "mask.txt").write_text("0.2,1.5,3,2.9")
    assert published.read_mask(tmp_path / "mask.txt") == (2, 4, 1, 3)


@pytest.mark.parametrize(
    ("first", "last", "is_accepted"),
    [(-2, 8, True), (-3, 8, False), (1, 10, True), (1, 11, False), (2, 2, True), (3, 2, False), (0, 0, False),
     (8, 8, True), (9, 10, False)],
)  # fmt: skip
def test_limits_chart_outside_image_to_two_pixels(first: int, last: int, is_accepted: bool) -> None:
    inside = np.zeros(8, bool)
    inside[max(first - 1, 0) : last] = True
    for box, is_across in (((first, last, 1, 8), False), ((1, 8, first, last), True)):
        scene = published.ChartScene("a", "a.png", (1.0, 1.0, 1.0), 0.0, None, box)
        if is_accepted:
            mask = scene.mask(np.zeros((8, 8, 3), np.uint16))
            np.testing.assert_array_equal(mask.T if is_across else mask, np.repeat(inside[:, None], 8, axis=1))
        else:
            with pytest.raises(FormatError, match=r"a\.png is 8 × 8"):
                scene.mask(np.zeros((8, 8, 3), np.uint16))


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,0,4", "1,2,nan,4", "1e308,1,1e308,4", "left,right"])
def test_refuses_damaged_text_file(copy: Path, text: str) -> None:
    folder = write_masks(copy, "5.7,2.2,3.2,2.2", "1,1,0.4,7")
    (folder / "SonyA57_0003_mask.txt").write_text(text)
    with pytest.raises(FormatError, match=r"SonyA57_0003_mask\.txt, line 1: "):
        open_scenes(copy)
