"""The learned methods that the commands offer."""

from __future__ import annotations

from collections.abc import Mapping

from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.regression_trees import RegressionTrees


def standard_learners() -> Mapping[str, FeatureLearner]:
    """Return the learned methods by their names on the command line.

    Examples
    --------
    >>> standard_learners()["regression-trees"].name
    'Regression trees (simple features)'
    """
    learners: tuple[FeatureLearner, ...] = (RegressionTrees(),)
    return {learner.key: learner for learner in learners}
