"""How far estimates are off: angular errors, their summaries, and errors by pixel where several lights fall."""

from evaluation.metrics.angular import ErrorKind, recovery_error, reproduction_error
from evaluation.metrics.maps import MapError, RegionError, measure_map
from evaluation.metrics.summaries import Summary, percentiles, summarise

__all__ = [
    "ErrorKind",
    "MapError",
    "RegionError",
    "Summary",
    "measure_map",
    "percentiles",
    "recovery_error",
    "reproduction_error",
    "summarise",
]
