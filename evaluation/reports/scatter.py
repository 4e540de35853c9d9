"""The scatter of two methods' errors, an image a point."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.plots import FAINT, INK, SERIES, svg_of

FLOOR_DEG: Final = 0.01
"""Smaller errors are drawn here: a logarithmic axis has no zero, and no ground truth is known as well."""

_DECADE: Final = 10.0
"""Points on the two axes stay apart by at least this factor, so that close errors do not fill the figure."""


def error_scatter(
    one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], names: tuple[str, str], marked: dict[int, str]
) -> bytes:
    """Return a figure as SVG: the error of the other against that of the one, with the line where they are equal.

    `one`, `other`: (N,) float64 each, degrees, in the same order of images.
    """

    def draw(figure: Any) -> None:
        x, y = np.maximum(one, FLOOR_DEG), np.maximum(other, FLOOR_DEG)
        low, high = float(min(x.min(), y.min())) / 1.15, float(max(x.max(), y.max())) * 1.15
        middle = np.sqrt(low * high)
        low, high = min(low, middle / _DECADE**0.5), max(high, middle * _DECADE**0.5)
        axes = figure.add_subplot()
        axes.plot([low, high], [low, high], color=FAINT, linewidth=1, zorder=1)
        for colour, chosen in ((SERIES[0], one <= other), (SERIES[1], one > other)):
            axes.scatter(x[chosen], y[chosen], s=14, color=colour, alpha=0.55, linewidths=0, zorder=2)
        places = np.array(list(marked), dtype=np.int64)
        axes.scatter(x[places], y[places], s=34, facecolors="none", edgecolors=INK, linewidths=0.8, zorder=3)
        for place, name in marked.items():
            left = x[place] > middle
            axes.annotate(
                name,
                (x[place], y[place]),
                xytext=(-5 if left else 5, 3),
                textcoords="offset points",
                ha="right" if left else "left",
                fontsize=7,
                color=INK,
            )
        axes.set(
            xscale="log",
            yscale="log",
            xlim=(low, high),
            ylim=(low, high),
            aspect="equal",
            xlabel=f"{names[0]}: error, degrees",
            ylabel=f"{names[1]}: error, degrees",
        )
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:g}")

    return svg_of(draw, inches=(5.6, 5.4))
