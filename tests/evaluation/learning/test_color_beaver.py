"""Color Beaver: band of illuminants."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from evaluation.learning.color_beaver import ColorBeaver, clip_to_band
from evaluation.metrics import recovery_error
from tests.evaluation.learning.made_up_world import lights_on_a_line

pytestmark = pytest.mark.slow


def test_moves_points_to_nearest_of_band() -> None:
    rng = np.random.default_rng(0)
    corners, width = np.array([[0.0, 0.0], [1.0, 0.2], [2.0, -0.3]]), 0.15
    points = rng.uniform(-1, 3, (50, 2))
    moved = clip_to_band(points, corners[None], np.array([[width, width]]))[0]
    shares = np.linspace(0, 1, 4000)[:, None]
    line = np.concatenate([first * (1 - shares) + last * shares for first, last in itertools.pairwise(corners)])
    gaps = np.linalg.norm(points[:, None] - line, axis=2).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved - points, axis=1), np.maximum(gaps - width, 0), atol=1e-3)


def test_fits_line_of_illuminants() -> None:
    # Estimates with random distances from the line: moved to the line they are correct.
    rng = np.random.default_rng(0)
    truths = lights_on_a_line(80, rng)
    across = np.array([1, 1]) / np.sqrt(2)
    estimates = (truths[:, [0, 2]] + rng.normal(0, 0.03, (80, 1)) * across)[:, None]
    model = ColorBeaver().fit_features(estimates[:60], truths[:60], seed=0)
    raw = np.stack([estimates[60:, 0, 0], 1 - estimates[60:, 0].sum(axis=1), estimates[60:, 0, 1]], axis=1)
    assert np.median(recovery_error(raw, truths[60:])) > 1.5
    assert np.median(recovery_error(model.lights(estimates[60:]), truths[60:])) < 0.3


def test_selects_better_base() -> None:
    rng = np.random.default_rng(1)
    truths = lights_on_a_line(80, rng)
    good, bad = truths[:, [0, 2]], rng.permutation(truths[:, [0, 2]])
    model = ColorBeaver(norms="1 2", generations=20).fit_features(np.stack([bad, good], axis=1), truths)
    assert int(model.base) == 1
