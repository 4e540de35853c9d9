"""Numbers of a Matplotlib figure, to be pinned."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text


def drawn(figure: Figure) -> dict[str, list[float]]:
    """Return all numbers of a figure by kind of artist, without those that depend on fonts."""
    numbers: dict[str, list[float]] = {"size": list(figure.get_size_inches())}
    for artist in figure.findobj():
        if artist.get_visible():
            for values in _artist(artist):
                flat = np.ma.filled(np.ma.asarray(values, float), np.nan).ravel()
                numbers.setdefault(type(artist).__name__, []).extend(flat.tolist())
    return numbers


def _artist(artist: Artist) -> Iterator[Any]:
    match artist:
        case Axes():
            yield from (artist.get_xlim(), artist.get_ylim())
        case Line2D():
            yield from (artist.get_xydata(), to_rgba(artist.get_color()), artist.get_linewidth())
        case Text() if artist.get_text():
            yield from (artist.get_position(), artist.get_fontsize(), to_rgba(artist.get_color()))
        case Collection():
            yield from (artist.get_offsets(), artist.get_facecolor(), artist.get_linewidth())
            yield from (path.vertices for path in artist.get_paths())
        case AxesImage():
            yield from (artist.get_array(), artist.get_extent(), artist.get_clim())
        case Patch():
            yield from (artist.get_path().vertices, artist.get_facecolor(), artist.get_edgecolor())
            yield artist.get_linewidth()
        case _:
            return
