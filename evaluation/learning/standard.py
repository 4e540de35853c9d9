"""List the learned methods that the commands offer."""

from __future__ import annotations

from collections.abc import Mapping

from evaluation.learning.color_beaver import ColorBeaver
from evaluation.learning.constant_light import ConstantLight
from evaluation.learning.convnet import ConvNet
from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.kernel_ridge import KernelRidge
from evaluation.learning.log_chroma import LogChroma
from evaluation.learning.regression_trees import RegressionTrees
from evaluation.learning.smart_color_cat import SmartColorCat


def standard_learners() -> Mapping[str, FeatureLearner]:
    """Return the learned methods by their names on the command line.

    Examples
    --------
    >>> standard_learners()["regression-trees"].name
    'Regression trees (simple features)'
    """
    learners: tuple[FeatureLearner, ...] = (
        RegressionTrees(),
        SmartColorCat(),
        ColorBeaver(),
        LogChroma(),
        KernelRidge(),
        ConvNet(),
        ConstantLight(),
    )
    return {learner.key: learner for learner in learners}
