"""Confidence intervals of one set of errors, of the parts of which `bootstrap` makes those of two."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from evaluation.experiments.bootstrap import STATISTICS, ErrorSample, Statistic, bca, resamples


def intervals(
    errors: ArrayLike, seed: int = 0, count: int = 2000, level: float = 0.95
) -> dict[Statistic, tuple[float, float]]:
    """Return the confidence interval of every statistic of errors (N,), from the same resamples."""
    sample = ErrorSample.of(errors)
    replicates = np.concatenate([sample.statistics(drawn) for drawn in resamples(len(sample.order), seed, count)])
    left_out, estimate = sample.without_each(), sample.estimate()
    return {
        name: bca(estimate[place], replicates[:, place], [left_out[:, place]], level)
        for place, name in enumerate(STATISTICS)
    }
