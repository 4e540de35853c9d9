"""Picture of a check: the frame with tags, maps of light, sharpness and print, and every finding.

Matplotlib is imported only when a picture is drawn, and pyplot is not used.
"""

from __future__ import annotations

import io
import textwrap
from typing import Any

import cv2
import numpy as np

from acquisition.check.findings import CheckReport
from acquisition.check.trial import Trial
from calibration.measurements import TableMeasurements
from experiment.chart.model import Chart
from experiment.framing.finding import annotated_png
from experiment.framing.homography import project
from experiment.framing.sharpness import MAX_BLUR_PX, edge_blurs

# Colours of the grades, dark enough to be read on white.
COLOURS = {"fault": "#b42318", "remark": "#b54708", "not checked": "#667085", "good": "#027a48"}

_LINE = 150  # Number of characters in a line of the findings.


def check_png(trial: Trial, chart: Chart, report: CheckReport) -> bytes:
    """Return the picture of a check as PNG; without a detected chart, only the frame with detected tags."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = _verdict_lines(report)
    frame_inches, text_inches = 10.2, 0.19 * len(lines) + 0.3
    figure: Any = Figure(figsize=(15, frame_inches + text_inches), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, height_ratios=[frame_inches / 2, frame_inches / 2, text_inches])
    _draw_frame(figure.add_subplot(grid[0, 0]), trial, chart)
    map_axes = [figure.add_subplot(grid[position]) for position in ((0, 1), (1, 0), (1, 1))]
    if trial.table is None:
        for axes in map_axes:
            axes.axis("off")
            axes.text(0.5, 0.5, "not measured: the chart was not detected", ha="center", color="0.4")
    else:
        _draw_light(map_axes[0], trial.table, chart)
        _draw_sharpness(map_axes[1], trial.table, chart)
        _draw_print(map_axes[2], trial.table, chart)
    axes = figure.add_subplot(grid[2, :])
    axes.axis("off")
    for number, (line, grade) in enumerate(lines):
        y = 1 - (number + 0.5) / len(lines)
        axes.text(
            0, y, line, family="monospace", fontsize=9, color=COLOURS[grade], va="center", transform=axes.transAxes
        )
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100, metadata={"Software": None})
    return stream.getvalue()


def _verdict_lines(report: CheckReport) -> list[tuple[str, str]]:
    lines: list[tuple[str, str]] = []
    for finding in report.sorted():
        lines += [(line, finding.grade) for line in textwrap.wrap(finding.line(), _LINE, subsequent_indent=36 * " ")]
    return lines


def _draw_frame(axes: Any, trial: Trial, chart: Chart) -> None:
    png = annotated_png(trial.white, chart, None if trial.table is None else trial.table.registration.framing)
    image = np.asarray(cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
    axes.imshow(image[..., ::-1])
    axes.set_title("white frame with detected tags")
    axes.set_xticks([])
    axes.set_yticks([])


def _page(axes: Any, chart: Chart, title: str) -> None:
    width, height = chart.page_mm
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    axes.set_xlabel("mm on the print")
    axes.set_title(title)


def _draw_light(axes: Any, table: TableMeasurements, chart: Chart) -> None:
    width, height = chart.page_mm
    x, y = np.linspace(0, width, 90), np.linspace(0, height, 60)
    grid_x, grid_y = np.meshgrid(x, y)
    points = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    green = table.frames[0].paper.field.at(points)[:, 1].reshape(grid_x.shape)
    share = green / green.max()
    image = axes.contourf(x, y, share, levels=np.linspace(0, 1, 21), cmap="viridis")
    lines = axes.contour(x, y, share, levels=np.arange(0.1, 1, 0.1), colors="white", linewidths=0.8)
    axes.clabel(lines, fmt=_per_cent, fontsize=8)
    axes.figure.colorbar(image, ax=axes, shrink=0.8, label="share of the maximum")
    _page(axes, chart, "flat field of lens and projector, green")


def _per_cent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _draw_sharpness(axes: Any, table: TableMeasurements, chart: Chart) -> None:
    framing = table.registration.framing
    edges_px, sigma = edge_blurs(framing)
    points = project(np.asarray(np.linalg.inv(framing.homography), dtype=np.float64), edges_px)
    marks = axes.scatter(
        points[:, 0], points[:, 1], c=sigma, s=380, cmap="RdYlGn_r", vmin=0.3, vmax=MAX_BLUR_PX + 0.3, edgecolors="0.3"
    )
    if len(points) <= 60:
        for (x, y), value in zip(points, sigma, strict=True):
            axes.text(x, y, f"{value:.2f}", ha="center", va="center", fontsize=7)
    axes.figure.colorbar(marks, ax=axes, shrink=0.8, label="σ, half-size px")
    _page(axes, chart, "blur of the printed edges")


def _draw_print(axes: Any, table: TableMeasurements, chart: Chart) -> None:
    stains = table.cells.stains
    if not stains.is_known:
        _page(axes, chart, "print: cannot be measured on a chart of few colours")
        return
    points, deviation_percent = stains.places_mm, 100 * stains.largest_deviation()
    size = float(np.clip(90_000 / len(points), 4.5, 120))
    marks = axes.scatter(
        points[:, 0], points[:, 1], c=deviation_percent, s=size, marker="s", cmap="RdBu", vmin=-6, vmax=6, linewidths=0
    )
    stained = points[stains.stained]
    axes.scatter(stained[:, 0], stained[:, 1], s=2 * size, facecolors="none", edgecolors="#d400ff", linewidths=1)
    axes.figure.colorbar(marks, ax=axes, shrink=0.8, label="deviation from the prediction, %")
    _page(axes, chart, "print: surroundings of patches, deviation from their printed colours")
