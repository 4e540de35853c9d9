"""All figures, in the order in which they are judged and reported: that of their definitions, file by file."""

from __future__ import annotations

from collections import Counter

from calibration.figures import geometry, light, radiometry, truth
from calibration.figures.figure import Figure


def collected() -> tuple[Figure, ...]:
    """Return the figures of the files; a ValueError says of one that contradicts itself or another."""
    modules = (geometry, radiometry, light, truth)
    found = tuple(value for module in modules for value in vars(module).values() if isinstance(value, Figure))
    names = {figure.name for figure in found}
    times = Counter(figure.name for figure in found)
    for figure in found:
        if not (figure.title and figure.why and figure.source):
            raise ValueError(f"{figure.name}: a figure has a title, and limits with their reason and source")
        if figure.refuse is not None and (figure.refuse > figure.accept) != (figure.sense == "at most"):
            raise ValueError(f"{figure.name}: refused at {figure.refuse}, accepted {figure.sense} {figure.accept}")
        if figure.cause is not None and not names.issuperset(figure.cause.follows):
            raise ValueError(f"{figure.name}: it follows {figure.cause.follows}, which are not all figures")
    if twice := sorted(name for name, count in times.items() if count > 1):
        raise ValueError(f"two figures have one of the names {', '.join(twice)}")
    at: dict[int, str] = {}
    for figure in found:
        for line in figure.lines:
            if line.place in at:
                raise ValueError(f"{figure.name}: place {line.place} of the summary has a line of {at[line.place]}")
            at[line.place] = figure.name
    return found


FIGURES: tuple[Figure, ...] = collected()
BY_NAME: dict[str, Figure] = {figure.name: figure for figure in FIGURES}
