"""What every learner makes of a few small scenes, to the last digits: no change of the code may move it unseen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning import color_beaver, convnet, log_chroma, regression_trees
from evaluation.learning.adapting import adapt, learn_alone, stacked_share
from evaluation.learning.color_beaver import ColorBeaver
from evaluation.learning.constant_light import ConstantLight
from evaluation.learning.convnet import ConvNet
from evaluation.learning.feature_learner import FeatureLearner, extract, fit_extracted, truths_of
from evaluation.learning.kernel_ridge import KernelRidge
from evaluation.learning.log_chroma import LogChroma
from evaluation.learning.regression_trees import RegressionTrees, consensus
from evaluation.learning.smart_color_cat import SmartColorCat
from evaluation.learning.working_size import chromaticities, lights_from_chromaticities, reduce
from foundation.errors import InputError
from tests.evaluation.learning.made_up_world import MadeUp, world
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


def scenes(count: int, seed: int) -> list[MadeUp]:
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


FREQUENT = [
    [1, 0.5, 0.5],
    [0.99, 0.5, 0.5],
    [0.2, 0.2, 0.2],
    [0.25, 0.25, 0.75],
    [0.26, 0.3, 0.8],
    [1, 1, 1],
    [0, 0, 0],
]
"""Colours at and beside borders of bins."""


def test_angles_of_the_net(pinned: Pinned) -> None:
    torch: Any = pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
    wanted = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [1.0, 2, 3]])
    found = torch.tensor([[1.0, 0, 0], [0.6, 0.8, 0], [0.0, 0, 1]])
    pinned("angles of the net", convnet._angle(torch, found, wanted).numpy(), same=1e-4, nothing=1e-8)


def test_parts_of_learning(pinned: Pinned) -> None:
    random = np.random.default_rng(2)
    one, truths = (random.dirichlet([5.0, 9, 4], 12) for _ in range(2))
    near = 0.8 * truths + 0.2 * one
    points = random.uniform(-0.2, 0.8, (9, 2))
    corners = np.array([[[0.1, 0.5], [0.3, 0.3], [0.6, 0.2]], [[0.2, 0.2], [0.2, 0.2], [0.5, 0.5]]])
    estimates = random.uniform(0.2, 0.5, (4, 4, 2))
    estimates[2] = [[0.25, 0.5], [0.25, 0.5], [0.25, 0.525], [0.3, 0.5]]
    image = random.uniform(1, 900, (11, 7, 3))
    image[0, 0], image[5, 3], image[9] = 900, 1000, 0
    mask = random.random((11, 7)) < 0.3
    mask[:4, :2] = [[1, 0], [0, 1], [1, 1], [0, 1]]
    found = {
        "shares": [
            stacked_share(a, b, truths, expected)
            for a, b in ((one, near), (near, one), (one, one))
            for expected in (0.0, 0.5, 1)
        ],
        "bounded": color_beaver.bounded(points, corners, np.array([[0.01, 0.2], [0.1, 0.0]])),
        "frequent": [
            regression_trees._frequent_colours(np.array(FREQUENT, np.float32), bins, most)
            for bins in (1, 4, 5)
            for most in (1, 3)
        ],
        "consensus": [consensus(estimates, agreement) for agreement in (0.0, 0.025, 0.1, 0.3)],
        "reduced": [
            list(map(np.asarray, reduce(kind, saturation, given, longest)))
            for kind, saturation in (
                (image, 1000.0),
                (image.astype(np.uint16), 900.0),
                (image.astype(np.float32), None),
            )
            for given in (None, mask)
            for longest in (11, 10, 4, 1)
        ],
        "chromaticities": chromaticities(np.array([[0, 0, 0], [1, 0, 0], [1, 2, 5.0], [1e-300, 0, 1e-300]])),
        "lights": lights_from_chromaticities(np.array([[0.2, 0.5], [0.9, 0.4], [-0.1, 1.1], [0, 0], [1, 0]])),
    }
    pinned("parts of learning", found)


def test_losses_of_log_chroma(pinned: Pinned) -> None:
    random = np.random.default_rng(1)
    response = random.normal(0, 1, (6, 64, 64))
    for number, (u, v) in enumerate([(0, 0), (63, 31), (31, 32), (5, 60), (33, 1)]):
        response[number, u, v] += (40, 12, 9, 7, 20)[number]
    likely = np.exp(response)
    likely /= likely.sum(axis=(1, 2), keepdims=True)
    places = np.array([[0.0, 0], [-1.4, 31.5], [32.5, 95.49], [5, 60], [33.5, 1], [10, 11.2]])
    flat = np.full((1, 64, 64), 1 / 4096)
    opposite = np.zeros((1, 64, 64))
    opposite[0, 0, 0], opposite[0, 32, 32] = 0.5 + 3.5e-7, 0.5 - 3.5e-7
    moments = log_chroma.moments(likely)
    scales = [log_chroma._scale(*weights) for weights in ((1e-8, 2e-10), (0.0, 1e-9), (1e-6, 1e-7))]
    fine = random.poisson(0.02, (2, 2, 128, 128)).astype(np.uint16)
    fine[1, 1] = 0
    pixels = random.uniform(0, 1, (200, 3)).astype(np.float32)
    pixels[0] = 2**-8
    picture, used = pixels[:63].reshape(7, 9, 3), random.random((7, 9)) < 0.7
    histograms = log_chroma.fold(random.poisson(0.01, (5, 2, 128, 128)).astype(np.uint16), wide=False)
    penalties = log_chroma.Penalties((1e-8, 1e-7, 1e-5), (1e-10, 1e-10, 1e-8), 1.5)
    found = {
        "moments": moments,
        "moments of a flat one": log_chroma.moments(flat).covariance,
        "slopes of a nearly flat one": log_chroma.moments(opposite).slopes,
        "likelihood": [log_chroma.likelihood(likely, moments, places, spread) for spread in (1.0, 0.3)],
        "cross-entropy": log_chroma.crossentropy(response, likely, places),
        "scales": scales,
        "folded": [log_chroma.fold(fine, wide) for wide in (False, True)],
        "histograms": [log_chroma._histogram(pixels, least).astype(float) for least in (2.0**-8, 0.2)],
        "deviations": log_chroma._deviations(picture, used),
    }
    pinned("losses of log-chroma", found)
    stages = [((1, 0.01, 0.0),), ((0, 0.01, 0.0), (2, 0.0, 3.0))]
    trained = [
        log_chroma.train(histograms, places[:5], np.array([1.0, 2, 1, 1, 3.5]), penalties, stage) for stage in stages
    ]
    pinned(
        "steps of training log-chroma",
        [[filters.real, filters.imag, bias] for filters, bias in trained],
        same=1e-3,
        nothing=1e-5,
    )


def test_lights_that_span_much(pinned: Pinned) -> None:
    found: list[Any] = []
    for span in (1.4, 1.5, 1.51, 2.9, 3.0, 3.01):
        truths = np.exp([[0, 0, 0], [-span, 0, 0.4], [-span / 2, 0, 0.1]])
        features = np.zeros((3, 2, 128, 128), np.uint16)
        features[:, :, [3, 70, 20], [5, 8, 100]] = 7
        try:
            model = LogChroma(pretraining=1, training=0).fit_features(features, truths)
            found.append([model.grid, model.centre])
        except InputError:
            found.append({"refused": 1})
    pinned("lights that span much to log-chroma", found)
