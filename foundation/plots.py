"""Figures by Matplotlib: SVG that takes a page's colours, PNG on white, the same bytes every time.

The series colours are those of M. Okabe and K. Ito, "Color universal design", 2008, which the colour-blind tell apart;
black and yellow, which vanish on a dark and a light screen, are replaced by grey and left out. Line styles change with
every round of the colours. Matplotlib is imported where a figure is made, and used through its objects only: no window
is opened and no state left behind.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import resources
from io import BytesIO
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

# Colours of text, of axes and notes, of rules, and of the page itself; an SVG's are exchanged on a dark screen.
INK, FAINT, GRID, PAPER = "#22262b", "#5b636d", "#e3e6ea", "#fdfdfe"

# Colour of what is marked in a picture.
MARK = "#e8502a"

# Colours of lines of R, G and B.
CHANNEL_INK = ("#c8382e", "#2f8f46", "#2f62c8")

# Colours of series, in the order of their use.
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f8790")

DASHES = ("-", "--", ":", "-.")  # Line styles: the first for the first round of colours, and so on

# Variables of `templates/colours.css` that the colours of an SVG become.
_NAMES = {INK: "ink", FAINT: "faint", GRID: "grid", PAPER: "paper"}

_PNG_DPI = 110  # Pictures 10 inches wide fill a page's 1100 pixels

# Photographs are as large as at Matplotlib's own 6, and written in a third of the time.
_PNG_SETTINGS: Final = (cv2.IMWRITE_PNG_COMPRESSION, 4)

# Resolution of what is drawn as a picture within an SVG, pixels an inch: sharp on a screen of twice the usual.
_RASTER_DPI = 180

_STYLE = {
    "font.size": 9,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    # Names of methods, images and data sets are the user's: "$" begins no mathematics.
    "text.parse_math": False,
}

_SVG_STYLE = _STYLE | {
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "legend.frameon": False,
    "svg.fonttype": "none",
    # Names of parts come from a hash; without a salt of its own each run draws another.
    "svg.hashsalt": "crop",
}


def series_style(number: int) -> dict[str, str]:
    """Return Matplotlib's `color` and `linestyle` of the series of that number, counted from 0.

    Examples
    --------
    >>> series_style(0), series_style(7)
    ({'color': '#0072b2', 'linestyle': '-'}, {'color': '#0072b2', 'linestyle': '--'})
    """
    return {"color": SERIES[number % len(SERIES)], "linestyle": DASHES[number // len(SERIES) % len(DASHES)]}


def legend_label(name: str) -> str:
    """Return a name as Matplotlib's legends show it, which leave out what begins with an underscore.

    Examples
    --------
    >>> legend_label("_mine"), legend_label("Gray-world")
    (' _mine', 'Gray-world')
    """
    return f" {name}" if name.startswith("_") else name


def draw_png(draw: Callable[..., None], *arguments: Any) -> bytes:
    """Return the PNG of a figure that `draw(figure, *arguments)` fills and gives its size; it has plain numbers."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Matplotlib's own types leave the keyword arguments of every method unknown.
    library: Any = matplotlib
    with library.rc_context(_STYLE):
        figure: Any = Figure(layout="constrained", dpi=_PNG_DPI)
        canvas: Any = FigureCanvasAgg(figure)
        draw(figure, *arguments)
        _write_plain_numbers(figure)
        # Figure.savefig draws all of it twice, once for the layout alone.
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())
    return cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGR), _PNG_SETTINGS)[1].tobytes()


def draw_svg(draw: Callable[..., None], *arguments: Any, inches: tuple[float, float] = (7.2, 4.0)) -> bytes:
    """Return the SVG of a figure that `draw(figure, *arguments)` fills.

    `INK`, `FAINT`, `GRID` and `PAPER` in it become the page's colours of that name, which a dark screen exchanges, so
    the SVG is to stand in a page (`foundation.pages.figure`). Text stays text; logarithmic axes have plain numbers.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    library: Any = matplotlib
    with library.rc_context(_SVG_STYLE):
        figure: Any = Figure(figsize=inches, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure, *arguments)
        _write_plain_numbers(figure)
        stream = BytesIO()
        figure.savefig(stream, format="svg", dpi=_RASTER_DPI, metadata={"Date": None})
    text = stream.getvalue().decode()
    for colour, name in _NAMES.items():
        text = re.sub(re.escape(colour), f"var(--{name})", text, flags=re.IGNORECASE)
    return text.encode()


def standalone_svg(svg: bytes) -> bytes:
    """Return an SVG of `draw_svg` as a file of its own: with a page's colours, light or dark as the reader likes.

    Examples
    --------
    >>> b"--paper" in standalone(b"<svg><path/></svg>")
    True
    """
    colours = (resources.files("foundation") / "templates" / "colours.css").read_text(encoding="utf-8")
    style = f"<style>{colours}svg {{ background: var(--paper); font-family: system-ui, sans-serif }}</style>"
    return re.sub(rb"(<svg\b[^>]*>)", lambda found: found[1] + style.encode(), svg, count=1)


def draw_squares(
    axes: Any,
    page_mm: tuple[float, float],
    places_mm: npt.NDArray[np.float64],
    side_mm: float,
    values: npt.NDArray[np.float64],
    inches: float,
    **colours: Any,
) -> Any:
    """Draw values (N,) as squares where they lie on a page, (N, 2) mm from its top left; return them for a colour bar.

    `inches`: width of the axes, about. `colours`: `cmap`, `vmin`, `vmax`.
    """
    width, height = page_mm
    # A marker's size is an area in points, 72 to an inch.
    points = max(72 * inches / width * side_mm, 1.2)
    axes.set(xlabel="mm", xlim=(0, width), ylim=(height, 0), aspect="equal")
    return axes.scatter(*places_mm.T, c=values, s=points**2, marker="s", linewidths=0, **colours)


def _write_plain_numbers(figure: Any) -> None:
    """Give logarithmic axes numbers: Matplotlib writes powers of ten in mathematics, which is not set here."""
    from matplotlib.ticker import LogFormatter

    class PlainLogFormatter(LogFormatter):
        """Numbers where Matplotlib's own formatter has them."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log" and isinstance(axis.get_major_formatter(), LogFormatter):
                axis.set_major_formatter(PlainLogFormatter())
            if axis.get_scale() == "log" and isinstance(axis.get_minor_formatter(), LogFormatter):
                axis.set_minor_formatter(PlainLogFormatter())
