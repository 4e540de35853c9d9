"""The pictures that a scientist looks at first beside chart and lights: where samples err, and the sensor's noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.figures.table_figures import TableFigures
from calibration.radiometry.photon_transfer import PhotonTransfer, noise_levels
from calibration.registration.register import Registration
from calibration.report.plots import CHANNEL_INK, FAINT, INK, MARK
from calibration.sampling import sites_at
from experiment.chart.model import Chart

_LEAST_LEVEL = 1.0
"""Counts from which on a level is drawn: the axes are logarithmic."""

_SHOWN_PERCENTILE = 99.0
"""Of the errors of places, where the scale ends: the outermost cells are known much worse than all others."""

_Image = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]


def draw_errors(figure: Any, figures: TableFigures, chart: Chart) -> None:
    """Draw how far cells are off their codes' colours, and how well their places are known, over the print.

    The worst cell of each is ringed. Where the first is not known, on small charts, it is left empty and says so.
    """
    page_w, page_h = chart.page_mm
    figure.set_size_inches(10, 0.2 + 4.6 * page_h / page_w)
    left, right = figure.subplots(1, 2)
    side = 72 * 4.1 / page_w * float(np.mean(chart.cell_mm))
    stains = figures.cells.stains
    if stains.known:
        off = 100 * stains.largest_deviation()
        places = chart.centres_mm[chart.cell_of_colour]
        limit = max(1.0, float(np.abs(off).max()))
        image = left.scatter(
            *places.T, c=off, s=max(side, 1.2) ** 2, marker="s", linewidths=0, cmap="RdBu", vmin=-limit, vmax=limit
        )
        figure.colorbar(image, ax=left, label="%, brighter is positive", shrink=0.8)
        _mark(left, places[int(np.argmax(np.abs(off)))])
    else:
        left.text(0.5, 0.5, "too few colours to compare", ha="center", va="center", transform=left.transAxes)
    error = figures.registration.uncertainty_px(chart.centres_mm)
    image = right.scatter(
        *chart.centres_mm.T, c=error, s=max(side, 1.2) ** 2, marker="s", linewidths=0, cmap="cividis", vmin=0,
        vmax=max(float(np.percentile(error, _SHOWN_PERCENTILE)), 1e-3),
    )  # fmt: skip
    figure.colorbar(image, ax=right, label="half-size px", shrink=0.8, extend="max")
    _mark(right, chart.centres_mm[int(np.argmax(error))])
    left.set(title="colour of cells against their codes", ylabel="mm")
    right.set(title="standard error of cells' places")
    for axes in (left, right):
        axes.set(xlabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal", facecolor="#f2f3f5")


def _mark(axes: Any, place_mm: _Array) -> None:
    """Ring a place on the print."""
    axes.plot(*place_mm, "o", markersize=13, markerfacecolor="none", markeredgecolor="white", markeredgewidth=2.6)
    axes.plot(*place_mm, "o", markersize=13, markerfacecolor="none", markeredgecolor=MARK, markeredgewidth=1.4)


def cell_noise(picture: _Image, chart: Chart, registration: Registration, window: int) -> tuple[_Array, _Array]:
    """Return mean and variance of the samples of each cell that is in the frame, both (N, 3) float64.

    `picture`: (H, W, 3) float32 counts above black, the frame at half size.
    """
    height, width = picture.shape[:2]
    sites = sites_at(registration.to_pixels(chart.centres_mm), (height, width), window)
    offsets = np.arange(window) - window // 2
    at = np.flatnonzero(sites.inside)
    samples = picture[sites.rows[at, None, None] + offsets[:, None], sites.columns[at, None, None] + offsets]
    flat = samples.reshape(len(at), window**2, 3).astype(np.float64)
    return flat.mean(axis=1), flat.var(axis=1, ddof=1)


def draw_noise(figure: Any, noise: tuple[_Array, _Array], transfer: PhotonTransfer, samples: int) -> None:
    """Draw the photon-transfer curve: the variance of one sample over its level, measured and fitted.

    `noise`: mean and variance of each cell, both (N, 3) float64, as `cell_noise` returns them.
    """
    from matplotlib.ticker import LogLocator, StrMethodFormatter

    figure.set_size_inches(10, 3.9)
    left, right = figure.subplots(1, 2)
    level, variance = noise
    for channel in range(3):
        at, seen = noise_levels(level[:, channel], variance[:, channel], samples)
        lit = (at > _LEAST_LEVEL) & (seen > 0)
        if not lit.any():
            continue
        low, high = float(at[lit].min()), float(at[lit].max())
        grid = low * (high / low) ** np.linspace(0, 1, 120)
        model = transfer.variance(np.repeat(grid[:, None], 3, axis=1))[:, channel]
        gain = transfer.gain_e[channel]
        name = f"{'RGB'[channel]}: {gain:.2f} e⁻ a count, read {transfer.read_noise[channel]:.1f} counts"
        left.loglog(at[lit], seen[lit], ".", color=CHANNEL_INK[channel], markersize=4)
        left.loglog(grid, model, "-", color=CHANNEL_INK[channel], linewidth=0.9, label=name)
        right.semilogx(at[lit], at[lit] / np.sqrt(seen[lit]), ".", color=CHANNEL_INK[channel], markersize=4)
        right.semilogx(grid, grid / np.sqrt(model), "-", color=CHANNEL_INK[channel], linewidth=0.9)
    left.set(title="variance of one sample", xlabel="counts above black", ylabel="counts²")
    right.set(title="signal to noise of one sample", xlabel="counts above black")
    left.legend(frameon=False, fontsize=8, labelcolor=INK)
    for axes in (left, right):
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.minorticks_off()
        axes.grid(color=FAINT, alpha=0.25, linewidth=0.5)
