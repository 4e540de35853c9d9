"""The door to data sets: one function opens each layout that is known, by its name or by what it looks like."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from evaluation.datasets.generated import open_generated
from evaluation.datasets.thumbnails import open_thumbnails
from evaluation.scene import SceneSet
from foundation.errors import InputError


@dataclass(frozen=True)
class Layout:
    """A way in which data sets lie on the disk.

    Attributes
    ----------
    title
        What lies so, for help and messages: "a dataset made by generate".
    matches
        Whether a path or URL looks like it; reads names at most.
    open
        Returns the data set at a path or URL.
    """

    title: str
    matches: Callable[[str], bool]
    open: Callable[[str], SceneSet]


LAYOUTS: Mapping[str, Layout] = {
    "thumbnails": Layout(
        "thumbnails in a NumPy archive", lambda place: "://" not in place and place.endswith(".npz"), open_thumbnails
    ),
    "generated": Layout("a dataset made by generate", lambda _: True, open_generated),
}
"""By the names that the command takes; the first that matches a place is its layout."""


def open_scenes(place: Path | str, layout: str | None = None) -> SceneSet:
    """Return the data set at a place; images are read when they are used.

    Parameters
    ----------
    place
        Folder, file or URL.
    layout
        A name of `LAYOUTS`; by default the first that matches.

    Raises
    ------
    InputError
        There is no layout of that name.
    FormatError
        The data set is not there, or not as its layout has it; the message says what is missing.
    """
    if layout is not None and layout not in LAYOUTS:
        raise InputError(f"{layout!r} is no layout; the layouts are {', '.join(LAYOUTS)}")
    name = layout or next(name for name, known in LAYOUTS.items() if known.matches(str(place)))
    return LAYOUTS[name].open(str(place))
