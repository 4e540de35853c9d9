"""Smart Color Cat where its answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.learning.smart_color_cat import CHOICES, FINE, SmartColorCat
from evaluation.metrics import recovery_error
from tests.evaluation.learning.made_up_world import lights_on_a_line, world

pytestmark = pytest.mark.slow

RED, GREEN = (0.8, 0.1, 0.1), (0.1, 0.3, 0.1)


def test_smart_color_cat_is_exact_where_its_assumption_holds() -> None:
    # The histogram tells the place on the line linearly: a share of red pixels that grows with it.
    rng = np.random.default_rng(0)
    truths = lights_on_a_line(60, rng)
    features = np.zeros((60, FINE), np.float32)
    features[:, 100], features[:, 400] = 1 - truths[:, 0], truths[:, 0]
    model = SmartColorCat().fit_features(features[:40], truths[:40])
    assert len(model.weights) in CHOICES
    assert [*CHOICES] == sorted(bins for bins in CHOICES if FINE % bins == 0 and 3 <= bins <= 60)
    assert recovery_error(model.lights(features[40:]), truths[40:]).max() < 0.3


def test_smart_color_cat_stays_between_the_lights_it_knows() -> None:
    scenes = world(40)
    method = SmartColorCat().fit(scenes)
    truths = np.stack([scene.truth / scene.truth.sum() for scene in scenes])
    for image in (np.full((8, 8, 3), RED), np.full((8, 8, 3), GREEN)):
        light = method.estimate(image.astype(np.float32))
        share = light / light.sum()
        assert truths[:, 0].min() - 1e-6 <= share[0] <= truths[:, 0].max() + 1e-6
