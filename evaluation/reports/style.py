"""The looks of pages and figures: colours of light and dark screens, and what draws a figure as SVG.

The series colours are those of M. Okabe and K. Ito, "Color universal design", 2008, which the colour-blind tell apart;
black and yellow, which vanish on a dark and a light screen, are replaced by grey and left out. Line styles change with
every round of the colours.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from io import BytesIO
from typing import Any

INK, FAINT, GRID, PAPER = "#22262b", "#5b636d", "#e3e6ea", "#fdfdfe"
"""Colours of text, of axes and notes, of rules, and of the page itself; an SVG's are exchanged on a dark screen."""

_DARK = {INK: "#e4e7eb", FAINT: "#a3abb5", GRID: "#3a4048", PAPER: "#16191d"}
_NAMES = {INK: "ink", FAINT: "faint", GRID: "grid", PAPER: "paper"}

SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f8790")
"""Colours of series, in the order of their use."""

_RASTER_DPI = 180
"""Resolution of what is drawn as a picture within an SVG, pixels an inch: sharp on a screen of twice the usual."""

DASHES = ("-", "--", ":", "-.")
"""Line styles: the first for the first round of colours, and so on."""


def _variables(colours: dict[str, str]) -> str:
    return "; ".join(f"--{_NAMES[light]}: {colour}" for light, colour in colours.items())


CSS_VARIABLES = (
    f":root {{ color-scheme: light dark; {_variables({colour: colour for colour in _NAMES})} }}\n"
    f"@media (prefers-color-scheme: dark) {{ :root {{ {_variables(_DARK)} }} }}"
)
"""The colours as CSS variables, for the style sheet of a page."""


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


def svg_of(draw: Callable[..., None], *arguments: Any, inches: tuple[float, float] = (7.2, 4.0)) -> bytes:
    """Return the SVG of a figure that `draw(figure, *arguments)` fills, with Matplotlib; the same bytes every time.

    `INK`, `FAINT`, `GRID` and `PAPER` in it become the page's colours of that name, which a dark screen exchanges, so
    the SVG is to stand in a page (`page.figure_part`). Text stays text, as it is written: "$" begins no mathematics.
    Logarithmic axes have plain numbers. No window is opened and no state left behind.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    # Matplotlib's own types leave the keyword arguments of every method unknown.
    style: Any = {
        "font.size": 9,
        "axes.edgecolor": FAINT,
        "axes.labelcolor": INK,
        "axes.facecolor": "none",
        "figure.facecolor": "none",
        "text.color": INK,
        "xtick.color": FAINT,
        "ytick.color": FAINT,
        "xtick.labelcolor": INK,
        "ytick.labelcolor": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 10,
        "axes.titlelocation": "left",
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": GRID,
        "legend.frameon": False,
        "svg.fonttype": "none",
        # Names of methods, images and data sets are the user's.
        "text.parse_math": False,
        # Names of parts come from a hash; without a salt of its own each run draws another.
        "svg.hashsalt": "crop",
    }
    library: Any = matplotlib
    with library.rc_context(style):
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
