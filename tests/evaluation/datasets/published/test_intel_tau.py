"""INTEL-TAU: values computed by hand for a synthetic copy."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.datasets import DataOptions, open_scenes
from foundation.errors import FormatError, InputError
from tests.evaluation.datasets.made_up import intel_tau

NAMES = [
    "Canon_5DSR/field_1_cameras/C_5DSR_field_2.tiff",
    "Canon_5DSR/lab_printouts/C_5DSR_lab_10.tiff",
    "Nikon_D810/field_1_cameras/N_D810_field_7.tiff",
]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    intel_tau(tmp_path)
    return tmp_path


def test_applies_levels_mask_and_ground_truth(copy: Path) -> None:
    data = open_scenes(copy)
    assert [scene.name for scene in data.scenes] == NAMES
    assert [scene.truth.tolist() for scene in data.scenes] == [[0.3, 0.5, 0.2], [0.25, 0.5, 0.25], [0.2, 0.5, 0.3]]
    image, mask = data.scenes[0].read()
    assert image[0, 0].tolist() == [9000, 100, 7000]
    assert data.scenes[0].saturation == 65535
    assert mask is not None
    assert mask.sum() == 2
    assert mask[3, 4:6].all()
    assert data.treatment["images"] == "Canon_5DSR 2, Nikon_D810 1; the published data set has 7022"
    assert data.folds is None


def test_selects_camera_and_subset(copy: Path) -> None:
    assert [scene.name for scene in open_scenes(copy, options=DataOptions(subset="lab-printouts")).scenes] == NAMES[1:2]
    data = open_scenes(copy, options=DataOptions(camera="nikon_d810", subset="field_1_cameras"))
    assert data.name == "INTEL-TAU Nikon_D810 field_1_cameras"
    assert [scene.name for scene in data.scenes] == NAMES[2:]
    with pytest.raises(FormatError, match=r"Nikon_D810.*lab_printouts"):
        open_scenes(copy, options=DataOptions(camera="Nikon_D810", subset="lab_printouts"))
    with pytest.raises(InputError, match=r"'lab_realscene'.*field_1_cameras.*lab_printouts"):
        open_scenes(copy, options=DataOptions(subset="lab_realscene"))
    assert [scene.name for scene in open_scenes(copy / "Canon_5DSR").scenes] == NAMES[:2]


def test_reads_authors_folds(copy: Path) -> None:
    lists = copy / "splits"
    lists.mkdir()
    rows: list[list[str]] = [[] for _ in range(10)]
    rows[3] = [r"y:\Intel-TAU_v3\Canon_5DSR\field_1_cameras\C_5DSR_field_002.plain16"]
    rows[9] = [r"y:\Intel-TAU_v3\Canon_5DSR\lab_printouts\C_5DSR_lab_010.plain16"]
    rows[0] = [r"y:\Intel-TAU_v3\Nikon_D810\field_1_cameras\N_D810_field_007.plain16"]
    for number, row in enumerate(rows, 1):
        (lists / f"Intel-TAU_v3_filelist_subset{number:02d}.txt").write_text("\n".join(row))
    assert open_scenes(copy).folds == (3, 9, 0)
    (lists / "Intel-TAU_v3_filelist_subset04.txt").write_text("")
    assert open_scenes(copy).folds is None


def test_refuses_image_without_ground_truth_even_if_partial(copy: Path) -> None:
    (copy / "Canon_5DSR/field_1_cameras/C_5DSR_field_002.wp").unlink()
    for partial in (False, True):
        with pytest.raises(FormatError, match=r"1.*C_5DSR_field_2"):
            open_scenes(copy, options=DataOptions(partial=partial))


def test_reports_invalid_ground_truth_on_use(copy: Path) -> None:
    (copy / "Canon_5DSR/field_1_cameras/C_5DSR_field_002.wp").write_text("0.3 0.5")
    scene = open_scenes(copy).scenes[0]
    with pytest.raises(FormatError, match=r"C_5DSR_field_002\.wp.*0\.3.*0\.5"):
        _ = scene.truth
