"""Settings that nobody gives are those of their sources, or those with which our published figures were found."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.learning.color_beaver import ColorBeaver
from evaluation.learning.convnet import ConvNet
from evaluation.learning.kernel_ridge import KernelRidge
from evaluation.learning.log_chroma import LogChroma
from evaluation.learning.regression_trees import RegressionTrees
from evaluation.learning.smart_color_cat import SmartColorCat
from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.gray_pixels import GraynessIndex, LocalGraynessIndex, MeanShiftedGrayPixel
from evaluation.methods.pca import BrightDark
from evaluation.methods.retinex import ColorSparrow, ImprovedWhitePatch, SurfaceReflectance
from evaluation.methods.standard import standard_methods

SETTINGS = (
    # google/ffcc, projects/GehlerShiThumb/GehlerShiThumbHyperparams.m: the multipliers, and in its traces the steps of
    # either loss. The smoothness of the bias and the sizes are ours: docs/reference/learned-methods.md.
    LogChroma(
        working_size=64,
        least=1 / 256,
        crossentropy=2**-8.25,
        likelihood=2**1.75,
        pixel_smoothness=2**-26.25,
        edge_smoothness=2**-23.5,
        bias_smoothness=2**-17,
        pixel_size=2**-33,
        edge_size=2**-33,
        bias_size=2**-25,
        spread=1,
        pretraining=16,
        training=64,
    ),
    # OpenCV's learning_based_color_balance.cpp and its training script.
    RegressionTrees(working_size=256, bins=64, palette=300, bandwidth=0.1, windows=20, depth=4, agreement=0.025),
    # docs/reference/learned-methods.md.
    SmartColorCat(working_size=256, bins=0),
    ColorBeaver(norms="1", corners=3, population=80, generations=120),
    KernelRidge(working_size=64, penalty=0.3, brightness=1),
    ConvNet(working_size=64, width=16, epochs=60, rate=0.003),
    # Cheng et al. 2014, section 4; Qian et al. 2019 and Yang et al. 2015, and the programs of the former.
    BrightDark(share=0.035),
    GraynessIndex(share=0.001),
    LocalGraynessIndex(share=0.1, lights=2),
    MeanShiftedGrayPixel(share=0.01),
    # The program of Banić and Lončarić 2013, version 0.1; the other two are reconstructions, docs/reference/methods.md.
    ColorSparrow(spray=225, step=10, kernel=5, seed=0),
    ImprovedWhitePatch(pixels=60, samples=20, seed=0),
    SurfaceReflectance(patches=10),
)

ORDER_NORM_SCALE = {
    "white-patch": (0, np.inf, 0),
    "gray-world": (0, 1, 0),
    "shades-of-gray": (0, 2, 0),
    "general-gray-world": (0, 9, 9),
    "gray-edge-1": (1, 1, 6),
    "gray-edge-2": (2, 1, 1),
}
"""n, p and σ with which the framework stands in the tables of NUS; Shades-of-Gray as in the paper of this suite."""


@pytest.mark.parametrize("given", SETTINGS, ids=lambda given: type(given).__name__)
def test_settings_are_those_of_their_sources(given: object) -> None:
    assert type(given)() == given


def test_the_framework_has_the_usual_constants() -> None:
    found = {name: method for name, method in standard_methods().items() if isinstance(method, GrayEdge)}
    assert {name: (method.order, method.p, method.sigma) for name, method in found.items()} == ORDER_NORM_SCALE
    assert {method.border for method in found.values()} == {None}
