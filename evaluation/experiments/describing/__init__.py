"""What images and lights a data set is made of, beside another's: how real is what was generated."""

from evaluation.experiments.describing.description import DataDescription, describe, figures

__all__ = ["DataDescription", "describe", "figures"]
