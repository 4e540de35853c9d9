"""What a figure of Matplotlib shows, artist by artist, to be pinned."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from tests.pinned import plain


def drawn(figure: Figure) -> list[Any]:
    """Return what a figure shows, artist by artist, without what depends on fonts."""
    return [plain(figure.get_size_inches()), *(one for artist in figure.findobj() for one in _artist(artist))]


def _artist(artist: Artist) -> Iterator[Any]:
    """Yield what an artist shows, as plain values, where it shows something."""
    shown: list[Any]
    match artist:
        case Axes():
            shown = [artist.get_xlim(), artist.get_ylim(), artist.get_xscale(), artist.get_yscale()]
        case Line2D():
            style = (artist.get_color(), artist.get_linewidth(), artist.get_linestyle(), artist.get_marker())
            shown = [np.asarray(artist.get_xydata(), float), style]
        case Text():
            shown = [artist.get_text(), artist.get_position(), artist.get_fontsize(), artist.get_color()]
        case Collection():
            offsets = np.ma.filled(np.ma.asarray(artist.get_offsets(), float), np.nan)
            shown = [offsets, artist.get_facecolor(), artist.get_linewidth()]
            shown += [np.asarray(path.vertices, float) for path in artist.get_paths()]
        case AxesImage():
            shown = [np.ma.filled(np.ma.asarray(artist.get_array(), float), np.nan), artist.get_extent()]
            shown += [artist.get_clim(), artist.get_cmap().name]
        case Patch():
            shown = [artist.get_path().vertices, artist.get_facecolor(), artist.get_edgecolor(), artist.get_linewidth()]
        case _:
            return
    if artist.get_visible():
        yield [type(artist).__name__, *map(plain, shown)]
