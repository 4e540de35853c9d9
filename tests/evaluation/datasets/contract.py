"""What every reader of data sets keeps, whatever the layout: `check` for the set, `check_scene` for each image.

Measured on a reader's own words and on the images that it gives; what the values are is for the tests of each layout.
"""

from __future__ import annotations

import pickle

import numpy as np

from evaluation.scene import MixedScene, Scene, SceneSet

STATED = ("black level", "saturation", "mask", "ground truth")


def check(data: SceneSet) -> None:
    """Check a data set and every image of it."""
    assert data.scenes
    assert data.name
    for what in STATED:
        assert data.treatment[what].strip(), f"{what} is not stated"
    names = [scene.name for scene in data.scenes]
    assert len(set(names)) == len(names)
    if data.folds is not None:
        assert len(data.folds) == len(names)
        assert min(data.folds) >= 0
    for scene in data.scenes:
        check_scene(scene)
    again = pickle.loads(pickle.dumps(data.scenes))
    assert [scene.name for scene in again] == names
    np.testing.assert_array_equal(again[0].read()[0], data.scenes[0].read()[0])


def check_scene(scene: Scene) -> None:
    """Check one image: dtypes, shapes, ranges, and that a second reading gives the same."""
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
        assert not mask.all(), "no pixel is left"
    saturation = scene.saturation
    assert saturation is None or (np.isfinite(saturation) and saturation > 0)
    first = image.copy()
    image[...] = 0  # What a caller does to its image must not reach the next reading.
    second, again = scene.read()
    np.testing.assert_array_equal(second, first)
    np.testing.assert_array_equal(again, mask)
    if isinstance(scene, MixedScene):
        check_mixed(scene, first.shape[:2])


def check_mixed(scene: MixedScene, shape: tuple[int, ...]) -> None:
    """Check the maps of an image under several lights."""
    lights, weights, lit = scene.lights, scene.read_weights(), scene.read_truth_map()
    assert lights.shape[1:] == (3,)
    assert len(lights) >= 2
    assert weights.shape == (*shape, len(lights))
    assert lit.shape == (*shape, 3)
    assert weights.dtype == lit.dtype == np.float32
    known = np.isfinite(lit).all(axis=2)
    assert known.any()
    np.testing.assert_array_equal(np.isfinite(weights).all(axis=2), known)
    np.testing.assert_allclose(weights[known].sum(axis=1), 1, atol=1e-4)
    np.testing.assert_allclose(lit[known].sum(axis=1), 1, atol=1e-4)
    assert weights[known].min() >= 0
    # The light that single-light methods are held to is a mean, which may count bright pixels more: it is among them.
    low, high = lit[known].min(axis=0), lit[known].max(axis=0)
    share = scene.truth / scene.truth.sum()
    assert (share >= low - 1e-4).all()
    assert (share <= high + 1e-4).all()
