"""Results of methods on data sets, and the files of a results folder."""

from evaluation.results.result import Result

__all__ = ["Result"]
