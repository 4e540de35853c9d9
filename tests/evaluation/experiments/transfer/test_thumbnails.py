"""Images made small keep the colours of their areas, and nothing of what is clipped or masked."""

from __future__ import annotations

import numpy as np

from evaluation.experiments.cross_validation import SmallScene, make_small, shrink_image


def test_areas_are_averaged_by_hand() -> None:
    image = np.arange(48, dtype=np.uint16).reshape(4, 4, 3)
    small, mask = shrink_image(image, side=2)
    assert not mask.any()
    np.testing.assert_array_equal(small[0, 0], [7.5, 8.5, 9.5])
    np.testing.assert_array_equal(small[1, 1], [37.5, 38.5, 39.5])


def test_areas_that_cut_pixels_are_averaged_by_their_shares() -> None:
    image = np.repeat(np.array([[[10.0], [20.0], [60.0]]]), 3, axis=2)
    small, _ = shrink_image(image, side=2)
    # 1.5 px each: 10 and half of 20, half of 20 and 60.
    np.testing.assert_allclose(small[0, :, 0], [20 / 1.5, 70 / 1.5], rtol=1e-5)


def test_what_is_clipped_or_masked_does_not_show() -> None:
    light = np.array([3.0, 4.0, 2.0])
    image = np.random.default_rng(0).uniform(1, 100, (32, 48, 1)) * light
    image[3:9, 5:20] = 900, 100, 5
    mask = np.zeros((32, 48), dtype=bool)
    mask[20:, 30:] = True
    image[mask] = 100, 900, 5
    mask[:4, :4] = True
    small, empty = shrink_image(image, 12, saturation=900, mask=mask)
    assert small.shape == (8, 12, 3)
    assert empty[0, 0]
    assert empty[6, 9]
    assert not empty[3:5].any()
    seen = small[~empty]
    np.testing.assert_allclose(seen / seen.sum(axis=1, keepdims=True), np.tile(light / 9, (len(seen), 1)), rtol=1e-5)
    assert not small[empty].any()


def test_scenes_in_memory() -> None:
    image = np.ones((6, 8, 3), np.float32)
    scenes = [SmallScene(name, np.ones(3), image, None, 900.0) for name in ("a", "b")]
    counted: list[int] = []
    small = make_small(scenes, 4, workers=2, on_scene=lambda: counted.append(1))
    assert [(scene.name, scene.read()[0].shape, scene.saturation) for scene in small] == [
        ("a", (3, 4, 3), None),
        ("b", (3, 4, 3), None),
    ]
    assert len(counted) == 2
    untouched = make_small(scenes, 8)
    assert untouched[0].saturation == 900
    assert untouched[0].image is image
