"""Experiments: runs of methods, cross-validation, transfer, comparisons, and the experiments of the paper."""

from evaluation.experiments.running import evaluate

__all__ = ["evaluate"]
