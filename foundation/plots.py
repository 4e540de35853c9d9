"""Draw Matplotlib figures as SVG for a page, or as PDF or SVG for a paper. Equal data give equal bytes.

Matplotlib is imported when a figure is drawn. Only its object interface is used, so there are no windows and no global
state.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from importlib import resources
from io import BytesIO
from typing import Any, Literal

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

PANEL = (4.4, 3.4)  # Size of a panel, inches, for `draw_panels`

DASHES = ("-", "--", ":", "-.")  # Line styles; the style changes after every seven series

# Variables of `templates/colours.css` that replace the colours of an SVG.
_CSS_VARIABLES = {INK: "ink", FAINT: "faint", GRID: "grid", PAPER: "paper"}

# Resolution of raster images in an SVG, pixels per inch: sharp on a screen with twice the usual resolution.
_RASTER_DPI = 180

_MAX_RASTER_PX = 1300  # Largest width of a raster image, so that a page with photographs stays below a few megabytes

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

# TrueType fonts in a PDF, because many journals refuse Matplotlib's default, Type 3. Outlines in an SVG.
_PAPER_STYLE = {"figure.facecolor": "white", "pdf.fonttype": 42, "svg.fonttype": "path"}


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


# Use of a vector figure: SVG in a page, or a file for a paper.
FigureForm = Literal["page", "pdf", "svg"]


def draw_svg(
    draw: Callable[..., None],
    *arguments: Any,
    inches: tuple[float, float] = (7.2, 4.0),
    form: FigureForm = "page",
) -> bytes:
    """Return a vector figure that `draw(figure, *arguments)` draws.

    For a page (`foundation.pages.figure`), the colours `INK`, `FAINT`, `GRID` and `PAPER` become CSS variables, which
    the page defines, and text is not converted to outlines. A file for a paper has a white background and contains its
    fonts.
    """
    return _draw_figures(lambda figures: draw(figures[0], *arguments), [inches], form)[0]


def draw_panels(draw: Callable[..., None], *arguments: Any, inches: Sequence[tuple[float, float]]) -> tuple[bytes, ...]:
    """Return one SVG for each panel that `draw(panels, *arguments)` draws. A phone shows the panels below each other.

    `panels` are axes, each on its own figure of the size in `inches`. Two panels of size `PANEL` fit next to each other
    on a page, one on a phone.
    """
    return _draw_figures(lambda figures: draw([figure.add_subplot() for figure in figures], *arguments), inches)


def _draw_figures(
    draw: Callable[[list[Any]], None], inches: Sequence[tuple[float, float]], form: FigureForm = "page"
) -> tuple[bytes, ...]:
    import matplotlib
    from matplotlib.figure import Figure

    # `Any`, because Matplotlib's type hints do not describe keyword arguments.
    library: Any = matplotlib
    with library.rc_context(_STYLE if form == "page" else _STYLE | _PAPER_STYLE):
        figures: list[Any] = [Figure(figsize=size, layout="constrained") for size in inches]
        draw(figures)
        return tuple(_to_file(figure, form) for figure in figures)


def _to_file(figure: Any, form: FigureForm) -> bytes:
    _write_plain_numbers(figure)
    stream = BytesIO()
    dpi = min(_RASTER_DPI, _MAX_RASTER_PX / figure.get_figwidth())
    date = {"CreationDate": None} if form == "pdf" else {"Date": None}
    figure.savefig(stream, format="pdf" if form == "pdf" else "svg", dpi=dpi, metadata=date)
    if form != "page":
        return stream.getvalue()
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
    axes.grid(visible=False)
    axes.set(xlabel="mm", xlim=(0, width), ylim=(height, 0), aspect="equal")
    return axes.scatter(*positions_mm.T, c=values, s=points**2, marker="s", linewidths=0, rasterized=True, **colours)


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
