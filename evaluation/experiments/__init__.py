"""What can be asked of methods and data sets: runs, cross-validation, transfer, comparisons, the paper."""

from evaluation.experiments.running import evaluate

__all__ = ["evaluate"]
