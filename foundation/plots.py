"""Draw Matplotlib figures as SVG in the colours of the page, or as PNG on white. Equal data give equal bytes.

Matplotlib is imported when a figure is drawn. Only its object interface is used, so there are no windows and no global
state.
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

# Colours of text, of axes and notes, of grid lines, and of the background. A dark page replaces them in an SVG.
INK, FAINT, GRID, PAPER = "#22262b", "#5b636d", "#e3e6ea", "#fdfdfe"

# Colour of marks in a picture.
MARK = "#e8502a"

# Colours of the lines for R, G and B.
CHANNEL_INK = ("#c8382e", "#2f8f46", "#2f62c8")

# Colours of data series that colour-blind people can distinguish: M. Okabe, K. Ito, "Color universal design", 2008.
# Black is replaced by grey, which is also visible on a dark page. Yellow is omitted, because a light page hides it.
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f8790")

DASHES = ("-", "--", ":", "-.")  # Line styles; the style changes after every seven series

# Variables of `templates/colours.css` that replace the colours of an SVG.
_CSS_VARIABLES = {INK: "ink", FAINT: "faint", GRID: "grid", PAPER: "paper"}

_PNG_DPI = 110  # A picture of 10 inches fills the page width of 1100 pixels

# Compression level 4 makes PNG files as small as Matplotlib's level 6, in a third of the time.
_PNG_SETTINGS: Final = (cv2.IMWRITE_PNG_COMPRESSION, 4)

# Resolution of raster images in an SVG, pixels per inch: sharp on a screen with twice the usual resolution.
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
    # Names of methods, images and data sets may contain "$", which must not start a formula.
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
    # Matplotlib names SVG elements by a hash. With a fixed salt, the names are the same in each run.
    "svg.hashsalt": "crop",
}


def series_style(number: int) -> dict[str, str]:
    """Return the Matplotlib keywords `color` and `linestyle` of a series, numbered from 0.

    Examples
    --------
    >>> series_style(0), series_style(7)
    ({'color': '#0072b2', 'linestyle': '-'}, {'color': '#0072b2', 'linestyle': '--'})
    """
    return {"color": SERIES[number % len(SERIES)], "linestyle": DASHES[number // len(SERIES) % len(DASHES)]}


def legend_label(name: str) -> str:
    """Put a space before a name that starts with an underscore; Matplotlib leaves such names out of legends.

    Examples
    --------
    >>> legend_label("_mine"), legend_label("Gray-world")
    (' _mine', 'Gray-world')
    """
    return f" {name}" if name.startswith("_") else name


def draw_png(draw: Callable[..., None], *arguments: Any) -> bytes:
    """Return the PNG of a figure; `draw(figure, *arguments)` sets its size and draws it."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # `Any`, because Matplotlib's type hints do not describe keyword arguments.
    library: Any = matplotlib
    with library.rc_context(_STYLE):
        figure: Any = Figure(layout="constrained", dpi=_PNG_DPI)
        canvas: Any = FigureCanvasAgg(figure)
        draw(figure, *arguments)
        _write_plain_numbers(figure)
        # Figure.savefig is slower, because it draws everything a second time for the layout.
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())
    return cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGR), _PNG_SETTINGS)[1].tobytes()


def draw_svg(draw: Callable[..., None], *arguments: Any, inches: tuple[float, float] = (7.2, 4.0)) -> bytes:
    """Return the SVG of a figure that `draw(figure, *arguments)` draws, for use in a page (`foundation.pages.figure`).

    The colours `INK`, `FAINT`, `GRID` and `PAPER` become CSS variables, which the page defines. Text is not converted
    to outlines.
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
    for colour, name in _CSS_VARIABLES.items():
        text = re.sub(re.escape(colour), f"var(--{name})", text, flags=re.IGNORECASE)
    return text.encode()


def standalone_svg(svg: bytes) -> bytes:
    """Add the light and dark colours of a page to an SVG of `draw_svg`, so that it can be a file on its own.

    Examples
    --------
    >>> b"--paper" in standalone_svg(b"<svg><path/></svg>")
    True
    """
    colours = (resources.files("foundation") / "templates" / "colours.css").read_text(encoding="utf-8")
    style = f"<style>{colours}svg {{ background: var(--paper); font-family: system-ui, sans-serif }}</style>"
    return re.sub(rb"(<svg\b[^>]*>)", lambda match: match[1] + style.encode(), svg, count=1)


def draw_squares(
    axes: Any,
    page_mm: tuple[float, float],
    positions_mm: npt.NDArray[np.float64],
    side_mm: float,
    values: npt.NDArray[np.float64],
    inches: float,
    **colours: Any,
) -> Any:
    """Draw values (N,) as coloured squares at positions (N, 2) on the chart page.

    `inches` is the approximate width of the axes. `colours` are Matplotlib's keywords `cmap`, `vmin` and `vmax`. Return
    the squares, for a colour bar.
    """
    width, height = page_mm
    # Matplotlib expects the area of a marker in square points; an inch has 72 points.
    points = max(72 * inches / width * side_mm, 1.2)
    axes.set(xlabel="mm", xlim=(0, width), ylim=(height, 0), aspect="equal")
    return axes.scatter(*positions_mm.T, c=values, s=points**2, marker="s", linewidths=0, **colours)


def _write_plain_numbers(figure: Any) -> None:
    # Matplotlib labels logarithmic axes with formulas, which `text.parse_math` switches off.
    from matplotlib.ticker import LogFormatter

    class PlainLogFormatter(LogFormatter):
        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log" and isinstance(axis.get_major_formatter(), LogFormatter):
                axis.set_major_formatter(PlainLogFormatter())
            if axis.get_scale() == "log" and isinstance(axis.get_minor_formatter(), LogFormatter):
                axis.set_minor_formatter(PlainLogFormatter())
