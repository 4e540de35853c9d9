"""What methods made of data sets: values, and the folder that holds them."""

from evaluation.results.result import Result

__all__ = ["Result"]
