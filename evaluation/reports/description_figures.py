"""Figures of data sets: their luminance, chroma, lights and noise, one set or two beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.plots import FAINT, GRID, SERIES, legend_label, svg_of

_FAINTEST: Final = 0.4
"""Power of a share of cells at which it is drawn: rare colours stay visible beside frequent greys."""

_POINTS: Final = 3000
"""Lights drawn of a set at most: more make no other cloud, and a page too large to mail."""


def luminance_figure(names: Sequence[str], shares: Sequence[npt.NDArray[np.float64]], edges: Sequence[float]) -> bytes:
    """Return the distribution of luminance as SVG.

    `shares`: for each (B,) float64, the share of cells in each bin. `edges`: (B + 1,) float, the bins' edges: decimal
    logarithm of luminance over the 99th percentile.
    """

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for number, (name, share) in enumerate(zip(names, shares, strict=True)):
            # The first bin holds all that is darker.
            axes.stairs(
                100 * share, np.power(10.0, edges), label=legend_label(name), color=SERIES[number], linewidth=1.5
            )
        axes.set(xscale="log", xlabel="luminance over its 99th percentile in the image", ylabel="cells, %")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_ylim(bottom=0)
        axes.legend(loc="upper left")

    return svg_of(draw, inches=(7.2, 3.2))


def chroma_figure(names: Sequence[str], shares: Sequence[npt.NDArray[np.float64]], edges: Sequence[float]) -> bytes:
    """Return the histograms of chroma in the plane of ln(R/G) and ln(B/G) as SVG, side by side.

    `shares`: for each (B, B) float64, the share of cells, by ln(R/G) and ln(B/G). `edges`: (B + 1,) float, the bins'
    edges along both.
    """

    def draw(figure: Any) -> None:
        from matplotlib.colors import LinearSegmentedColormap, to_rgba

        top = max(float(share.max()) for share in shares) ** _FAINTEST
        for number, (name, share) in enumerate(zip(names, shares, strict=True)):
            axes = figure.add_subplot(1, len(shares), number + 1)
            clear, full = (to_rgba(SERIES[number], alpha) for alpha in (0, 1))
            axes.imshow(
                share.T**_FAINTEST,
                origin="lower",
                extent=(edges[0], edges[-1], edges[0], edges[-1]),
                cmap=LinearSegmentedColormap.from_list(f"set{number}", [clear, full]),
                vmin=0,
                vmax=top,
                interpolation="nearest",
            )
            axes.axhline(0, color=FAINT, linewidth=0.6)
            axes.axvline(0, color=FAINT, linewidth=0.6)
            axes.set(title=name, xlabel="ln(R/G)", ylabel="ln(B/G)")

    return svg_of(draw, inches=(3.8 * len(shares), 3.8))


def lights_figure(names: Sequence[str], lights: Sequence[npt.NDArray[np.float64]]) -> bytes:
    """Return the lights of sets in the plane of the chromaticities r and b as SVG.

    `lights`: for each (L, 3) float64, linear camera RGB with r + g + b = 1.
    """

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for number, (name, given) in enumerate(zip(names, lights, strict=True)):
            some = given[:: -(-len(given) // _POINTS)]
            axes.scatter(
                some[:, 0], some[:, 2], s=9, alpha=0.5, linewidths=0, color=SERIES[number], label=legend_label(name)
            )
        axes.set(xlabel="r = R / (R + G + B)", ylabel="b = B / (R + G + B)", aspect="equal")
        axes.legend(loc="upper right")

    return svg_of(draw, inches=(5.4, 4.6))


def noise_figure(
    names: Sequence[str],
    measured: Sequence[npt.NDArray[np.float64]],
    curves: Sequence[tuple[float, float] | None],
    unit: str,
) -> bytes:
    """Return noise against signal as SVG, with the fitted photon-transfer curves.

    `measured`: for each (N, 2) float64: signal and standard deviation of levels. `curves`: for each the read noise and
    the gain of variance = read² + gain · signal, or None.
    """

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for number, (name, levels, curve) in enumerate(zip(names, measured, curves, strict=True)):
            axes.plot(levels[:, 0], levels[:, 1], "o", markersize=4, color=SERIES[number], label=legend_label(name))
            if curve is not None:
                signal = np.exp(np.linspace(np.log(levels[0, 0]), np.log(levels[-1, 0]), 100, dtype=np.float64))
                axes.plot(signal, np.sqrt(curve[0] ** 2 + curve[1] * signal), color=SERIES[number], linewidth=1)
        axes.set(xscale="log", yscale="log", xlabel=f"signal, {unit} = 1", ylabel="standard deviation")
        axes.grid(visible=True, which="major", color=GRID)
        axes.legend(loc="upper left")

    return svg_of(draw, inches=(5.4, 4.0))
