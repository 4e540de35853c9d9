"""All figures, in the order in which they are judged and reported. It is the order of their definitions."""

from __future__ import annotations

from collections import Counter

from calibration.figures import geometry, light, radiometry, truth
from calibration.figures.figure import Figure


def collect_figures() -> tuple[Figure, ...]:
    """Return the figures of all modules; raise ValueError if their fields contradict each other."""
    modules = (geometry, radiometry, light, truth)
    figures = tuple(value for module in modules for value in vars(module).values() if isinstance(value, Figure))
    names = {figure.name for figure in figures}
    name_counts = Counter(figure.name for figure in figures)
    for figure in figures:
        if not (figure.title and figure.why and figure.source):
            raise ValueError(f"{figure.name}: title, why and source are required")
        if figure.refuse is not None and (figure.refuse > figure.accept) != (figure.sense == "at most"):
            raise ValueError(f"{figure.name} ({figure.sense}): refuse is not beyond accept = {figure.accept}")
        if figure.cause is not None and not names.issuperset(figure.cause.follows):
            raise ValueError(f"{figure.name}: follows = {figure.cause.follows} contains an unknown figure")
    if duplicates := sorted(name for name, count in name_counts.items() if count > 1):
        raise ValueError(f"duplicate figure names: {', '.join(duplicates)}")
    owner_by_position: dict[int, str] = {}
    for figure in figures:
        for line in figure.lines:
            if line.position in owner_by_position:
                raise ValueError(f"{figure.name}: line {line.position} is used by {owner_by_position[line.position]}")
            owner_by_position[line.position] = figure.name
    return figures


FIGURES: tuple[Figure, ...] = collect_figures()
BY_NAME: dict[str, Figure] = {figure.name: figure for figure in FIGURES}
