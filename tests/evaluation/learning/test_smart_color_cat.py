"""Smart Color Cat with known results."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.learning.smart_color_cat import BIN_CHOICES, FINE_BINS, SmartColorCat
from evaluation.metrics import recovery_error
from tests.evaluation.learning.made_up_world import lights_on_a_line, world

pytestmark = pytest.mark.slow

RED, GREEN = (0.8, 0.1, 0.1), (0.1, 0.3, 0.1)


def test_is_exact_if_assumption_holds() -> None:
    # The fraction of red pixels is a linear function of the position on the line.
    rng = np.random.default_rng(0)
    truths = lights_on_a_line(60, rng)
    features = np.zeros((60, FINE_BINS), np.float32)
    features[:, 100], features[:, 400] = 1 - truths[:, 0], truths[:, 0]
    model = SmartColorCat().fit_features(features[:40], truths[:40])
    assert len(model.weights) in BIN_CHOICES
    assert [*BIN_CHOICES] == sorted(bins for bins in BIN_CHOICES if FINE_BINS % bins == 0 and 3 <= bins <= 60)
    assert recovery_error(model.lights(features[40:]), truths[40:]).max() < 0.3


def test_clips_to_range_of_training_illuminants() -> None:
    scenes = world(40)
    method = SmartColorCat().fit(scenes)
    truths = np.stack([scene.truth / scene.truth.sum() for scene in scenes])
    for image in (np.full((8, 8, 3), RED), np.full((8, 8, 3), GREEN)):
        light = method.estimate(image.astype(np.float32))
        share = light / light.sum()
        assert truths[:, 0].min() - 1e-6 <= share[0] <= truths[:, 0].max() + 1e-6
