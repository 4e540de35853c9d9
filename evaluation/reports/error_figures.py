"""Figures of angular errors: how many images are below each, and which lights they belong to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.metrics import ErrorKind, percentiles
from evaluation.results.result import Result
from foundation.plots import FAINT, legend_label, series_style, svg_of

_SHOWN_PERCENTILE = 98
"""Percentile of all methods' errors at which the axis of errors ends: a few wild ones would squeeze the others."""

_STEPS = 300
"""Points of a curve: as many as a column of a page has pixels, whatever the number of images."""

_PANELS = 12
"""Methods that get a panel of their own: more are too small to be read."""

_COLUMNS = 3
"""Panels beside each other: what a page of 1100 px has room for."""

_VECTORS = 3000
"""Points that are drawn one by one; more become a picture, for a page of millions of circles opens slowly."""

_BRIGHTEST_PERCENTILE = 95
"""Percentile of all methods' errors at which the scale of colours ends."""


def error_curves(results: Sequence[Result], kind: ErrorKind) -> bytes:
    """Return the cumulative error curves of methods as SVG: the share of images up to each error."""
    rows = math.ceil(len(results) / 2)
    return svg_of(_draw_curves, results, kind, inches=(8.6, 3.9 + 0.19 * rows))


def _draw_curves(figure: Any, results: Sequence[Result], kind: ErrorKind) -> None:
    axes = figure.subplots()
    every = np.concatenate([result.errors[kind] for result in results])
    end = max(float(percentiles(every, (_SHOWN_PERCENTILE,))[0]), 1e-3)
    for number, result in enumerate(results):
        errors = np.sort(result.errors[kind])
        shares = np.linspace(0, 100, min(len(errors), _STEPS) + 1)
        # The k-th of n sorted errors is reached by k of n images.
        places = np.ceil(shares / 100 * len(errors)).astype(int) - 1
        reached = np.where(places < 0, 0.0, errors[np.maximum(places, 0)])
        axes.plot(reached, shares, label=legend_label(result.method), linewidth=1.6, **series_style(number))
    axes.set(xlim=(0, end), ylim=(0, 100), xlabel=f"{kind} angular error, degrees", ylabel="images up to it, %")
    figure.legend(loc="outside lower left", ncols=2, handlelength=3)


def error_planes(results: Sequence[Result], truths: npt.NDArray[np.float64], kind: ErrorKind) -> bytes:
    """Return the errors over the chromaticity plane as SVG: a panel a method, the first twelve of them.

    `truths`: (N, 3) float64, the true lights, camera RGB of any length.
    """
    shown = results[:_PANELS]
    columns = _columns(len(shown))
    wide, high = (4.6, 3.6) if len(shown) == 1 else (8.6, 0.7 + (7.8 / columns) * math.ceil(len(shown) / columns))
    return svg_of(_draw_planes, shown, truths, kind, inches=(wide, high))


def _columns(panels: int) -> int:
    """Return how many panels stand beside each other: two pairs look better than three and one."""
    return 2 if panels == 4 else min(_COLUMNS, panels)


def _draw_planes(figure: Any, results: Sequence[Result], truths: npt.NDArray[np.float64], kind: ErrorKind) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    shares = truths / truths.sum(axis=1, keepdims=True)
    every = np.concatenate([result.errors[kind] for result in results])
    top = max(float(percentiles(every, (_BRIGHTEST_PERCENTILE,))[0]), 1e-3)
    # Neither end of the scale may vanish, on a light page or on a dark one.
    colours = ListedColormap(colormaps["viridis"](np.linspace(0.15, 0.92, 256)))
    columns = _columns(len(results))
    grid = figure.subplots(math.ceil(len(results) / columns), columns, squeeze=False, sharex=True, sharey=True)
    drawn = None
    for axes, result in zip(grid.flat, results, strict=False):
        errors = result.errors[kind]
        order = np.argsort(errors, kind="stable")  # The largest errors lie on top.
        drawn = axes.scatter(
            shares[order, 0],
            shares[order, 2],
            c=errors[order],
            s=9,
            cmap=colours,
            vmin=0,
            vmax=top,
            linewidths=0,
            rasterized=len(errors) * len(results) > _VECTORS,
        )
        axes.set_title(result.method, fontsize=8.5)
    panels = list(grid.flat)
    for axes in panels[len(results) :]:
        axes.remove()
    for axes in panels[max(0, len(results) - columns) : len(results)]:
        # The lowest panel of each column has the labels, also above an empty place.
        axes.tick_params(labelbottom=True)
    figure.supxlabel("r = R / (R + G + B) of the true light", fontsize=9)
    figure.supylabel("b = B / (R + G + B)", fontsize=9)
    bar = figure.colorbar(drawn, ax=panels[: len(results)], extend="max", label=f"{kind} error, degrees", shrink=0.8)
    bar.outline.set_edgecolor(FAINT)
