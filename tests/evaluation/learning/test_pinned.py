"""What every learner makes of a few small scenes, to the last digits: no change of the code may move it unseen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.adapting import adapt, learn_alone
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

# Parts of a method are pinned as well, since its estimate may not show them.

pytestmark = pytest.mark.slow

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
"""Each at its defaults and at others, trained for little: what is to be known again need not be learned well."""

TOLERANCES = {"log-chroma": 1e-3, "log-chroma without pretraining": 1e-3, "net": 1e-3, "net of one epoch": 1e-3}
"""Training in single precision."""


def scenes(count: int, seed: int) -> list[Made]:
    """Return scenes of 24 px; of some a part is masked, clipped, or a row and a column is cut off."""
    made = world(count, seed, size=24)
    mask = np.zeros((24, 24), bool)
    mask[4:9, 3:20] = True
    cut = made[0].image[:23, :21]
    made[0] = replace(made[0], image=np.ascontiguousarray(cut))
    made[1] = replace(made[1], mask=mask, image=np.where(mask[..., None], 9, made[1].image).astype(np.float32))
    made[2] = replace(made[2], saturation=float(np.sort(made[2].image.ravel())[-30]))
    return made


TRAIN, TEST, HERE = scenes(23, 0), scenes(5, 1), scenes(9, 2)


def real(arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, Any]:
    """Return arrays with complex ones in their two parts."""
    return {
        name: [np.real(array), np.imag(array)] if np.iscomplexobj(array) else array
        for name, array in sorted(arrays.items())
    }


@pytest.mark.parametrize("key", LEARNERS)
def test_what_is_learned(key: str, pinned: Pinned) -> None:
    learner = LEARNERS[key]
    if isinstance(learner, ConvNet):
        pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
    same = TOLERANCES.get(key, 1e-6)
    (given,) = extract(TRAIN, [learner])
    (here,) = extract(HERE, [learner])
    method = fit_extracted(learner, given, truths_of(TRAIN), 3)
    alone = learn_alone(learner, here, truths_of(HERE), 4)
    adapted = [adapt(method, alone, worth) for worth in (200.0, 5.0)]
    few = adapt(method, learn_alone(learner, here[:2], truths_of(HERE[:2]), 4))
    tests = extract(TEST, [learner])[0]
    pinned(
        f"what is learned, {key}",
        {
            "features": [np.asarray(one, float) for one in tests if one is not None],
            "arrays": real(method.model.arrays()),
            "lights": [method.estimate(scene.image, scene.saturation, scene.mask) for scene in TEST],
            "held out": alone.held_out,
            "adapted": [
                [np.asarray(one.model.arrays()["share"]), one.estimate(scene.image, scene.saturation, scene.mask)]
                for one in (*adapted, few)
                for scene in TEST[:3]
            ],
        },
        same=same,
        nothing=1e-6 if same > 1e-6 else 1e-8,
    )
