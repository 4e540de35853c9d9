"""Contract of all readers of data sets: `check` for the set, `check_scene` for each image.

Values are checked by the tests of each layout.
"""

from __future__ import annotations

import pickle

import numpy as np

from evaluation.scene import MixedScene, Scene, SceneSet

TREATMENT_KEYS = ("black level", "saturation", "mask", "ground truth")


def check(data: SceneSet) -> None:
    """Check a data set and every image of it."""
    assert data.scenes
    assert data.name
    for key in TREATMENT_KEYS:
        assert data.treatment[key].strip(), f"{key} is empty"
    names = [scene.name for scene in data.scenes]
    assert len(set(names)) == len(names)
    if data.folds is not None:
        assert len(data.folds) == len(names)
        assert min(data.folds) >= 0
    for scene in data.scenes:
        check_scene(scene)
    copies = pickle.loads(pickle.dumps(data.scenes))
    assert [scene.name for scene in copies] == names
    np.testing.assert_array_equal(copies[0].read()[0], data.scenes[0].read()[0])


def check_scene(scene: Scene) -> None:
    """Check dtypes, shapes and ranges of one image, and that it can be read twice."""
    truth = scene.truth
    assert truth.shape == (3,)
    assert truth.dtype == np.float64
    assert np.isfinite(truth).all()
    assert truth.min() >= 0
    assert truth.any()
    image, mask = scene.read()
    assert image.ndim == 3
    assert image.shape[2] == 3
    assert image.dtype in (np.uint16, np.float32, np.float64)
    assert image.min() >= 0
    if mask is not None:
        assert mask.shape == image.shape[:2]
        assert mask.dtype == np.bool_
        assert not mask.all(), "all pixels are masked"
    saturation = scene.saturation
    assert saturation is None or (np.isfinite(saturation) and saturation > 0)
    first = image.copy()
    image[...] = 0  # The caller may change its image.
    second, second_mask = scene.read()
    np.testing.assert_array_equal(second, first)
    np.testing.assert_array_equal(second_mask, mask)
    if isinstance(scene, MixedScene):
        check_mixed(scene, first.shape[:2])


def check_mixed(scene: MixedScene, shape: tuple[int, ...]) -> None:
    """Check the maps of an image under several illuminants."""
    lights, weights, truth_map = scene.lights, scene.read_weights(), scene.read_truth_map()
    assert lights.shape[1:] == (3,)
    assert len(lights) >= 2
    assert weights.shape == (*shape, len(lights))
    assert truth_map.shape == (*shape, 3)
    assert weights.dtype == truth_map.dtype == np.float32
    has_truth = np.isfinite(truth_map).all(axis=2)
    assert has_truth.any()
    np.testing.assert_array_equal(np.isfinite(weights).all(axis=2), has_truth)
    np.testing.assert_allclose(weights[has_truth].sum(axis=1), 1, atol=1e-4)
    np.testing.assert_allclose(truth_map[has_truth].sum(axis=1), 1, atol=1e-4)
    assert weights[has_truth].min() >= 0
    # The ground truth for methods with one estimate is a mean, so it lies between the values of the pixels.
    low, high = truth_map[has_truth].min(axis=0), truth_map[has_truth].max(axis=0)
    share = scene.truth / scene.truth.sum()
    assert (share >= low - 1e-4).all()
    assert (share <= high + 1e-4).all()
