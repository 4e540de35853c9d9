"""Forest plots: ratios with their intervals, each on a line, of several statistics side by side.

The form is that of meta-analyses (S. Lewis and M. Clarke, "Forest plots: trying to see the wood and the trees", BMJ
322, 2001): a diamond for the whole, a square for each part of it, a line at 1, and a logarithmic axis, on which 2 and
1/2 are equally far from 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from foundation.plots import FAINT, INK, series_style, svg_of

_LINE_INCHES: Final = 0.24
"""Height of a line: a label of 9 points and some air."""

_WIDEST: Final = 4.0
"""An interval is drawn up to this factor beyond the outermost ratio, so that a wide one does not squeeze the others."""

_NARROWEST: Final = 1.25
"""The axis reaches from 1 over this to this at least: else differences that mean nothing would fill the figure."""

_ROUND: Final = (1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0, 9.0)
"""Round numbers of a decade: dense about 1 on both sides."""

_MOST_TICKS: Final = 6
"""Numbers on an axis at most: a panel is two inches wide."""

Interval = tuple[float, float, float]
"""A ratio and the ends of its interval; NaN where it is not known."""


@dataclass(frozen=True)
class ForestLine:
    """A line of a forest plot.

    - `label`: what stands to the left.
    - `ratios`: for each panel; none for a line that heads those below it.
    - `series`: number of its colour, counted from 0; lines that belong together share one.
    - `whole`: whether it is of the whole, and not of a part.
    """

    label: str
    ratios: tuple[Interval, ...] = ()
    series: int = 0
    whole: bool = True


def forest_plot(lines: Sequence[ForestLine], panels: Sequence[str]) -> bytes:
    """Return a forest plot as SVG."""
    return svg_of(_draw, lines, panels, inches=(8.8, 0.9 + _LINE_INCHES * len(lines)))


def _draw(figure: Any, lines: Sequence[ForestLine], panels: Sequence[str]) -> None:
    grid = figure.subplots(1, len(panels), squeeze=False, sharey=True, sharex=True)[0]
    low, high = _range(lines)
    for number, (axes, title) in enumerate(zip(grid, panels, strict=True)):
        axes.axvline(1, color=FAINT, linewidth=1, zorder=1)
        for place, line in enumerate(lines):
            if line.ratios:
                _draw_ratio(axes, place, line, line.ratios[number])
        axes.set(title=title, xscale="log", xlim=(low, high), xlabel="ratio")
        ticks = round_numbers(low, high)
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0, labelcolor=INK)
    grid[0].set_yticks(range(len(lines)), [line.label for line in lines])
    for text, line in zip(grid[0].get_yticklabels(), lines, strict=True):
        text.set(fontweight="normal" if line.ratios else "bold", color=INK if line.whole else FAINT)
    grid[0].set_ylim(len(lines) - 0.5, -0.5)


def _draw_ratio(axes: Any, place: int, line: ForestLine, ratio: Interval) -> None:
    value, low, high = ratio
    if not _positive(value):
        return
    colour = series_style(line.series)["color"]
    if _positive(low) and _positive(high):
        width, shown = (1.8, 1.0) if line.whole else (1.0, 0.7)
        axes.plot([low, high], [place, place], color=colour, linewidth=width, alpha=shown, zorder=2)
    marker, size = ("D", 6.5) if line.whole else ("s", 4)
    axes.plot([value], [place], marker, color=colour, markersize=size, markeredgewidth=0, zorder=3)


def _range(lines: Sequence[ForestLine]) -> tuple[float, float]:
    """Return the ends of the axis: all ratios, and intervals as far as they leave those room."""
    values = [ratio[0] for line in lines for ratio in line.ratios if _positive(ratio[0])]
    ends = [end for line in lines for ratio in line.ratios for end in ratio[1:] if _positive(end)]
    least, most = min([1 / _NARROWEST, *values]), max([_NARROWEST, *values])
    low = max(min([least, *ends]), least / _WIDEST)
    high = min(max([most, *ends]), most * _WIDEST)
    return low / 1.03, high * 1.03


def round_numbers(low: float, high: float) -> list[float]:
    """Return round numbers from `low` to `high`, which 1 lies between, far enough apart to be read in a panel.

    Examples
    --------
    >>> round_numbers(0.75, 1.3), round_numbers(0.6, 2.2)
    ([0.8, 0.9, 1.0, 1.1, 1.25], [0.8, 1.0, 1.25, 2.0])
    """
    apart = (high / low) ** (1 / _MOST_TICKS)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    known = {round(part * 10.0**power, 12) for power in powers for part in _ROUND}
    ticks = [1.0]
    for tick in sorted(known):
        if ticks[-1] * apart <= tick <= high:
            ticks.append(tick)
    for tick in sorted(known, reverse=True):
        if low <= tick <= ticks[0] / apart:
            ticks.insert(0, tick)
    return ticks


def _positive(number: float) -> bool:
    return math.isfinite(number) and number > 0
