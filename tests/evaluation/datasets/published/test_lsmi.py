"""LSMI: values computed by hand for synthetic copies of both forms."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from evaluation.datasets import DataOptions, open_scenes
from evaluation.datasets.published import lsmi as reader
from evaluation.scene import MixedScene
from foundation.errors import FormatError, InputError
from tests.data_files import shipped
from tests.evaluation.datasets.made_up import lsmi, lsmi_preprocessed


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    lsmi(tmp_path)
    return tmp_path


@pytest.fixture
def preprocessed(tmp_path: Path) -> Path:
    lsmi_preprocessed(tmp_path)
    return tmp_path


def test_applies_levels_mask_and_illuminants(copy: Path) -> None:
    data = open_scenes(copy)
    assert [scene.name for scene in data.scenes] == [
        *("sony/Place1_1.tiff", "sony/Place1_12.tiff", "sony/Place2_1.tiff", "sony/Place2_123.tiff"),
    ]
    single, double, _, triple = data.scenes
    assert single.truth.tolist() == [0.5, 1, 0.5]
    assert not isinstance(single, MixedScene)
    assert single.saturation == 4095 - 128
    image, mask = single.read()
    assert image[0, 0].tolist() == [9000 - 128, 0, 7000 - 128]
    assert mask is not None
    assert mask.sum() == 9
    assert mask[2:5, 2:5].all()
    assert isinstance(double, MixedScene)
    assert double.lights.tolist() == [[0.5, 1, 0.5], [2, 1, 1]]
    assert isinstance(triple, MixedScene)
    assert len(triple.lights) == 3


def test_reads_fractions_and_truth_map(copy: Path) -> None:
    scene = open_scenes(copy).scenes[1]
    assert isinstance(scene, MixedScene)
    weights, lit = scene.read_weights(), scene.read_truth_map()
    assert weights[0, 0].tolist() == [0.25, 0.75]
    assert np.isnan(weights[7, 9]).all()
    assert np.isnan(lit[7, 9]).all()
    # 0.25 (0.5, 1, 0.5) + 0.75 (2, 1, 1) = (1.625, 1, 0.875), sum 3.5
    np.testing.assert_allclose(lit[0, 0], np.array([1.625, 1, 0.875]) / 3.5, rtol=1e-6)
    np.testing.assert_allclose(scene.truth, np.array([1.625, 1, 0.875]) / 3.5, rtol=1e-6)


def test_normalises_fractions(copy: Path) -> None:
    scene = open_scenes(copy).scenes[3]
    assert isinstance(scene, MixedScene)
    np.testing.assert_allclose(scene.read_weights()[3, 3], [0.25, 0.25, 0.5], rtol=1e-6)  # 0.2, 0.2, 0.4 in the file


def test_ground_truth_is_mean_over_pixels(copy: Path) -> None:
    shares = np.zeros((8, 10, 2))
    shares[:, :5, 0] = shares[:, 5:, 1] = 1
    np.save(copy / "sony" / "Place1" / "Place1_12.npy", shares)
    scene = open_scenes(copy).scenes[1]
    # Half of the pixels have (0.5, 1, 0.5), half (2, 1, 1): the mean is (1.25, 1, 0.75).
    np.testing.assert_allclose(scene.truth, np.array([1.25, 1, 0.75]) / 3, rtol=1e-6)


def test_reads_preprocessed_form(preprocessed: Path) -> None:
    data = open_scenes(preprocessed)
    assert [scene.name for scene in data.scenes] == ["sony_512/Place1_1.tiff", "sony_512/Place1_12.tiff"]
    scene = data.scenes[1]
    image, mask = scene.read()
    assert image[0, 0].tolist() == [9000, 100, 7000]
    assert mask is not None
    assert mask.sum() == 9
    assert scene.saturation is None
    assert isinstance(scene, MixedScene)
    assert np.isnan(scene.read_truth_map()[7, 9]).all()  # its fractions are 0
    assert "resized" in data.treatment["saturation"]


@pytest.mark.slow
def test_reads_levels_from_raw_file(copy: Path) -> None:
    (copy / "sony").rename(copy / "galaxy")
    with pytest.raises(InputError, match=r"--read black.*saturation"):
        open_scenes(copy)
    with_options = open_scenes(copy, options=DataOptions(black=64, saturation=1023))
    assert with_options.scenes[0].saturation == 1023 - 64
    shutil.copy(shipped("raw/canon_eos_550d_colorchart.dng"), copy / "galaxy.dng")
    data = open_scenes(copy)
    # tests/data/README.md: "black 2056, white 15000".
    assert data.scenes[0].saturation == 15000 - 2056
    assert data.treatment["black level"] == "galaxy 2056, subtracted (galaxy.dng)"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("Light2", None, r"meta\.json.*Place1.*Light2.*1_make_mixture_map\.py"),
        ("Light2", [1, 1], "Light2.*1.*1"),
        ("Light2", ["a", 1, 1], "Light2"),
        ("MCCCoord", None, "MCCCoord.*mcc1.*mcc2.*mcc3"),
        ("MCCCoord", {"mcc1": [], "mcc2": [], "mcc3": []}, "expected four corners"),
    ],
)
def test_refuses_invalid_metadata(copy: Path, key: str, value: object, message: str) -> None:
    path = copy / "sony" / "meta.json"
    meta = json.loads(path.read_text())
    meta["Place1"][key] = value
    path.write_text(json.dumps(meta))
    with pytest.raises(FormatError, match=message):
        open_scenes(copy)


def test_refuses_missing_files(copy: Path) -> None:
    camera = copy / "sony"
    (camera / "Place1" / "Place1_12.npy").unlink()
    for options in (DataOptions(), DataOptions(partial=True)):
        with pytest.raises(FormatError, match=r"Place1_12\.npy.*1_make_mixture_map\.py"):
            open_scenes(copy, options=options)
    shutil.rmtree(camera / "Place1")
    with pytest.raises(FormatError, match=r"1.*2.*Place1"):
        open_scenes(copy)
    data = open_scenes(copy, options=DataOptions(partial=True))
    assert [scene.name for scene in data.scenes] == ["sony/Place2_1.tiff", "sony/Place2_123.tiff"]


def test_excludes_images_without_ground_truth(copy: Path) -> None:
    # The published meta.json of the Sony has NaN illuminants (github.com/DY112/LSMI-dataset, issue 9).
    path = copy / "sony" / "meta.json"
    meta = json.loads(path.read_text())
    meta["Place1"]["Light2"] = [float("nan"), 1.0, float("nan")]
    path.write_text(json.dumps(meta))
    with pytest.raises(FormatError, match=r"Place1, Light2.*--read partial"):
        open_scenes(copy)
    data = open_scenes(copy, options=DataOptions(partial=True))
    names = [scene.name for scene in data.scenes]
    assert "sony/Place2_1.tiff" in names
    assert "sony/Place1_12.tiff" not in names
    assert "1 without ground truth are excluded (Place1_12.tiff)" in data.treatment["images"]


@pytest.mark.parametrize(
    "shares", [np.ones((8, 10)), np.ones((8, 10, 3)), np.ones((8, 10, 2), int), -np.ones((8, 10, 2))]
)
def test_refuses_invalid_fractions(copy: Path, shares: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
    np.save(copy / "sony" / "Place1" / "Place1_12.npy", shares)
    scene = open_scenes(copy).scenes[1]
    assert isinstance(scene, reader.LsmiMixedScene)
    with pytest.raises(FormatError, match=r"Place1_12\.npy"):
        scene.read_weights()
