"""Pinned features, models and estimates of all learners for a few small scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.adapting import adapt, fit_local
from evaluation.learning.color_beaver import ColorBeaver
from evaluation.learning.constant_light import ConstantLight
from evaluation.learning.convnet import ConvNet
from evaluation.learning.feature_learner import FeatureLearner, extract, fit_extracted, truths_of
from evaluation.learning.kernel_ridge import KernelRidge
from evaluation.learning.log_chroma import LogChroma
from evaluation.learning.regression_trees import RegressionTrees
from evaluation.learning.smart_color_cat import SmartColorCat
from tests.evaluation.learning.made_up_world import world
from tests.evaluation.made_scenes import Made
from tests.pinned import Pinned

# Intermediate results are pinned too, because estimates may not depend on all of them.

pytestmark = pytest.mark.slow

# Default and other settings, with little training.
LEARNERS: dict[str, FeatureLearner] = {
    "constant light": ConstantLight(),
    "trees": RegressionTrees(windows=2),
    "trees of few colours": RegressionTrees(
        working_size=9, bins=5, palette=7, bandwidth=0.3, windows=3, depth=2, agreement=0.01
    ),
    "cat": SmartColorCat(),
    "cat of eight bins": SmartColorCat(working_size=10, bins=8),
    "beaver": ColorBeaver(population=12, generations=3),
    "beaver of two norms": ColorBeaver(norms="1 3 inf", corners=2, population=9, generations=2),
    "log-chroma": LogChroma(pretraining=2, training=2),
    "log-chroma without pretraining": LogChroma(working_size=12, least=0.05, pretraining=0, training=3, spread=2.0),
    "ridge": KernelRidge(),
    "ridge of counts": KernelRidge(working_size=7, penalty=2.0, brightness=0.0),
    "net": ConvNet(working_size=24, width=3, epochs=2),
    "net of one epoch": ConvNet(working_size=16, width=2, epochs=1, rate=0.01),
}

# Relative tolerances of training in single precision.
TOLERANCES = {"log-chroma": 1e-3, "log-chroma without pretraining": 1e-3, "net": 1e-3, "net of one epoch": 1e-3}


def scenes(count: int, seed: int) -> list[Made]:
    """Return scenes of 24 px; some are partly masked, clipped or cropped."""
    cases = world(count, seed, size=24)
    mask = np.zeros((24, 24), bool)
    mask[4:9, 3:20] = True
    cut = cases[0].image[:23, :21]
    cases[0] = replace(cases[0], image=np.ascontiguousarray(cut))
    cases[1] = replace(cases[1], mask=mask, image=np.where(mask[..., None], 9, cases[1].image).astype(np.float32))
    cases[2] = replace(cases[2], saturation=float(np.sort(cases[2].image.ravel())[-30]))
    return cases


TRAIN, TEST, LOCAL = scenes(23, 0), scenes(5, 1), scenes(9, 2)


def real(arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, Any]:
    """Return arrays with complex ones as real and imaginary parts."""
    return {
        name: [np.real(array), np.imag(array)] if np.iscomplexobj(array) else array
        for name, array in sorted(arrays.items())
    }


@pytest.mark.parametrize("key", LEARNERS)
def test_fitted_and_adapted_models(key: str, pinned: Pinned) -> None:
    learner = LEARNERS[key]
    if isinstance(learner, ConvNet):
        pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
    tolerance = TOLERANCES.get(key, 1e-6)
    (features,) = extract(TRAIN, [learner])
    (local_features,) = extract(LOCAL, [learner])
    method = fit_extracted(learner, features, truths_of(TRAIN), 3)
    local_fit = fit_local(learner, local_features, truths_of(LOCAL), 4)
    adapted = [adapt(method, local_fit, worth) for worth in (200.0, 5.0)]
    adapted_to_two = adapt(method, fit_local(learner, local_features[:2], truths_of(LOCAL[:2]), 4))
    tests = extract(TEST, [learner])[0]
    pinned(
        f"what is learned, {key}",
        {
            "features": [np.asarray(image, float) for image in tests if image is not None],
            "arrays": real(method.model.arrays()),
            "lights": [method.estimate(scene.image, scene.saturation, scene.mask) for scene in TEST],
            "held out": local_fit.held_out,
            "adapted": [
                [np.asarray(model.model.arrays()["share"]), model.estimate(scene.image, scene.saturation, scene.mask)]
                for model in (*adapted, adapted_to_two)
                for scene in TEST[:3]
            ],
        },
        same=tolerance,
        nothing=1e-6 if tolerance > 1e-6 else 1e-8,
    )
