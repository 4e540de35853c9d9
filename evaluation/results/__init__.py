"""What methods made of data sets: values, and the folder that holds them."""

from evaluation.results.result import Result, images_csv, table_csv

__all__ = ["Result", "images_csv", "table_csv"]
