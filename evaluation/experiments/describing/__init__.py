"""What images and lights a data set is made of, beside another's: how real is what was generated."""

from evaluation.experiments.describing.description import Description, describe, figures

__all__ = ["Description", "describe", "figures"]
