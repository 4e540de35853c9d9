"""All figures, in the order in which they are judged and reported: that of their definitions, file by file."""

from __future__ import annotations

from calibration.figures import geometry, light, radiometry, truth
from calibration.figures.figure import Figure

FIGURES: tuple[Figure, ...] = tuple(
    value
    for module in (geometry, radiometry, light, truth)
    for value in vars(module).values()
    if isinstance(value, Figure)
)
BY_NAME: dict[str, Figure] = {figure.name: figure for figure in FIGURES}
