"""The pictures of a comparison's page, drawn as those of a table's report are (`foundation.plots.png_of`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.comparison.answers import ANGLE_FLOOR_DEG, CELL_SCORE
from calibration.comparison.values import CellDifferences, LightDifferences
from experiment.chart.model import Chart
from foundation.plots import FAINT, INK, MARK

_CHANNEL_INK = ("#c8382e", "#2f8f46", "#2f62c8")


def draw_lights(figure: Any, lights: LightDifferences) -> None:
    """Draw angle, brightness and cells of every light against what noise alone gives."""
    figure.set_size_inches(10, 3.1)
    angle, brightness, cells = figure.subplots(1, 3)
    number = lights.one
    angle.plot(number, lights.angle_deg, ".", color=INK, markersize=3, label="seen")
    angle.plot(number, lights.angle_noise_deg, "_", color=MARK, markersize=4, label="noise alone, RMS")
    angle.axhline(ANGLE_FLOOR_DEG, color=FAINT, linewidth=0.7, linestyle=(0, (4, 3)))
    angle.set(title="angle between whites", ylabel="°", xlabel="light of A")
    angle.set_ylim(bottom=0)
    angle.legend(frameon=False, fontsize=8)
    brightness.plot(number, 100 * lights.brightness, ".", color=INK, markersize=3, label="as measured")
    brightness.plot(
        number, 100 * lights.brightness_left, ".", color=MARK, markersize=3, label="without drift and median"
    )
    brightness.axhline(0, color=FAINT, linewidth=0.7)
    brightness.set(title="brightness, B over A", ylabel="%", xlabel="light of A")
    brightness.legend(frameon=False, fontsize=8)
    cells.plot(number, lights.cell_score, ".", color=INK, markersize=3)
    cells.axhline(1, color=FAINT, linewidth=0.7)
    cells.axhline(CELL_SCORE, color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    cells.set(title="cells, RMS in units of noise", xlabel="light of A")


def draw_cells(figure: Any, cells: CellDifferences) -> None:
    """Draw the distribution of the cells' mean differences, channel by channel, and of the same in units of noise."""
    figure.set_size_inches(10, 3.1)
    share, score = figure.subplots(1, 2)
    for channel in range(3):
        known = np.isfinite(cells.mean[:, channel])
        if not known.any():
            continue
        mean, noise = cells.mean[known, channel], cells.noise[known, channel]
        share.hist(100 * mean, bins=80, histtype="step", color=_CHANNEL_INK[channel], label="RGB"[channel])
        score.hist(
            np.clip((mean - cells.offset[channel]) / noise, -8, 8), bins=80, range=(-8, 8), histtype="step",
            color=_CHANNEL_INK[channel], density=True,
        )  # fmt: skip
    at = np.linspace(-8, 8, 200)
    score.plot(at, np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi), color=FAINT, linewidth=0.9, label="noise alone")
    share.set(title="mean difference of cells over the lights", xlabel="%, B over A", ylabel="cells")
    share.set_yscale("log")
    score.set(title="the same in units of its noise", xlabel="standard errors")
    for axes in (share, score):
        axes.legend(frameon=False, fontsize=8)


def draw_map(figure: Any, chart: Chart, cells: CellDifferences) -> None:
    """Draw the cells' mean differences where they lie on the print, in the channel that differs most."""
    page_w, page_h = chart.page_mm
    figure.set_size_inches(10, 8.6 * page_h / page_w)
    axes = figure.subplots()
    filled = np.nan_to_num(cells.mean - cells.offset)
    largest = np.take_along_axis(filled, np.abs(filled).argmax(axis=1)[:, None], axis=1)[:, 0]
    reach = max(0.5, 100 * float(np.percentile(np.abs(largest), 99)))
    # A marker's size is an area in points: of a cell, with the axes about 8.2 inches wide.
    side = 72 * 8.2 / page_w * float(np.mean(chart.cell_mm))
    image = axes.scatter(
        *chart.centres_mm[chart.cell_of_colour].T, c=100 * largest, s=side**2, marker="s", linewidths=0, cmap="RdBu",
        vmin=-reach, vmax=reach,
    )  # fmt: skip
    axes.set(xlabel="mm", ylabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal")
    figure.colorbar(image, ax=axes, label="B over A, %", shrink=0.8, extend="both")
