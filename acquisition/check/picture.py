"""The picture of a check: the frame with tags and their blur, maps of light, sharpness and print, and every verdict.

Matplotlib is imported where the picture is made, and through its objects only.
"""

from __future__ import annotations

import io
import textwrap
from typing import Any

import numpy as np
import numpy.typing as npt

from acquisition.check.findings import GRADES, CheckReport
from acquisition.check.frames import ChartMeasurements, CheckFrames
from acquisition.check.light_and_print import Spot, light_share
from experiment.chart.model import Chart
from experiment.framing.finding import annotated_png
from experiment.framing.sharpness import MAX_BLUR_PX

COLOURS = {"fault": "#b42318", "remark": "#b54708", "not checked": "#667085", "good": "#027a48"}
"""Of the grades: dark enough to be read on white."""

_LINE = 150
"""Letters to a line of verdicts."""


def check_png(seen: CheckFrames, figures: ChartMeasurements | None, chart: Chart, report: CheckReport) -> bytes:
    """Return the picture of a check as PNG bytes; without a chart, the frame with what was looked for."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = _verdict_lines(report)
    frame_in, text_in = 10.2, 0.19 * len(lines) + 0.3
    figure: Any = Figure(figsize=(15, frame_in + text_in), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, height_ratios=[frame_in / 2, frame_in / 2, text_in])
    _draw_frame(figure.add_subplot(grid[0, 0]), seen, figures, chart)
    places = [figure.add_subplot(grid[place]) for place in ((0, 1), (1, 0), (1, 1))]
    if figures is None:
        for axes in places:
            axes.axis("off")
            axes.text(0.5, 0.5, "not measured: the chart was not found", ha="center", color="0.4")
    else:
        _draw_light(places[0], figures, chart)
        _draw_sharpness(places[1], figures, chart)
        _draw_print(places[2], figures, chart)
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
    """Return the verdicts as lines, faults first, each with its grade."""
    lines: list[tuple[str, str]] = []
    for grade in GRADES:
        for finding in report.of(grade):
            text = f"{grade:<12}{finding.name:<17}{finding.sentence()}"
            wrapped = textwrap.wrap(text, _LINE, subsequent_indent=29 * " ") or [text]
            lines += [(line, grade) for line in wrapped]
    return lines


def _draw_frame(axes: Any, seen: CheckFrames, figures: ChartMeasurements | None, chart: Chart) -> None:
    import cv2

    shot = seen.whites[0]
    png = annotated_png(shot.mosaic, chart, None if figures is None else figures.placed.framing)
    image = np.asarray(cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
    axes.imshow(image[..., ::-1])
    axes.set_title(f"white at {shot.shutter_s:.4g} s, with what was found of the chart")
    axes.set_xticks([])
    axes.set_yticks([])
    if figures is not None and figures.state is not None:
        for spot in figures.state.spots:
            to_pixels = figures.placed.place.to_pixels
            axes.add_patch(_outline(np.array([to_pixels([place])[0] for place in _rim_mm(spot, 0.0)]), 6.0))


def _rim_mm(spot: Spot, least_mm: float) -> npt.NDArray[np.float64]:
    """Return (N, 2) mm, an ellipse about a spot: a circle, or along a crease; its half axes are no less than given."""
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    along, across = (max(side / 2, least_mm) for side in (spot.size_mm, spot.width_mm))
    angle = np.radians(spot.angle_deg)
    x, y = along * np.cos(turn), across * np.sin(turn)
    turned = [x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)]
    return np.stack(turned, axis=1) + np.array(spot.centre_mm)


def _outline(rim: npt.NDArray[np.float64], least: float) -> Any:
    """Return the outline through points (N, 2), made as large as can be seen."""
    from matplotlib.patches import Polygon

    middle = rim.mean(axis=0)
    reach = float(np.linalg.norm(rim - middle, axis=1).max())
    shown = middle + (rim - middle) * max(1.0, least / max(reach, 1e-9))
    return Polygon(shown, closed=True, fill=False, edgecolor="#d400ff", linewidth=2)


def _page(axes: Any, chart: Chart, title: str) -> None:
    width, height = chart.page_mm
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    axes.set_xlabel("mm on the print")
    axes.set_title(title)


def _draw_light(axes: Any, figures: ChartMeasurements, chart: Chart) -> None:
    width, height = chart.page_mm
    if figures.light is None:
        _page(axes, chart, "light: not measured, too few white references")
        return
    x, y = np.linspace(0, width, 90), np.linspace(0, height, 60)
    grid_x, grid_y = np.meshgrid(x, y)
    points = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    share = light_share(figures.light, points)[:, 1].reshape(grid_x.shape)
    image = axes.contourf(x, y, share, levels=np.linspace(0, 1, 21), cmap="viridis")
    lines = axes.contour(x, y, share, levels=np.arange(0.1, 1, 0.1), colors="white", linewidths=0.8)
    axes.clabel(lines, fmt=_per_cent, fontsize=8)
    axes.figure.colorbar(image, ax=axes, shrink=0.8, label="of the brightest place")
    _page(axes, chart, "light of lens and projector, green")


def _per_cent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _draw_sharpness(axes: Any, figures: ChartMeasurements, chart: Chart) -> None:
    points, sigma = figures.blur.points_mm, figures.blur.sigma_px
    worst = MAX_BLUR_PX
    marks = axes.scatter(
        points[:, 0], points[:, 1], c=sigma, s=380, cmap="RdYlGn_r", vmin=0.3, vmax=worst + 0.3, edgecolors="0.3"
    )
    if len(points) <= 60:
        for (x, y), value in zip(points, sigma, strict=True):
            axes.text(x, y, f"{value:.2f}", ha="center", va="center", fontsize=7)
    axes.figure.colorbar(marks, ax=axes, shrink=0.8, label="σ, half-size px")
    _page(axes, chart, "blur of printed edges")


def _draw_print(axes: Any, figures: ChartMeasurements, chart: Chart) -> None:
    state = figures.state
    if state is None:
        _page(axes, chart, "print: not judged, its light is not known")
        return
    known = np.isfinite(state.deviation)
    points, value = state.points_mm[known], state.deviation[known]
    size = float(np.clip(90_000 / max(len(points), 1), 4.5, 120))
    marks = axes.scatter(
        points[:, 0], points[:, 1], c=100 * value, s=size, marker="s", cmap="RdBu", vmin=-6, vmax=6, linewidths=0
    )
    for spot in state.spots:
        axes.add_patch(_outline(_rim_mm(spot, 3.0), 0.0))
        axes.annotate(str(spot), spot.centre_mm, xytext=(0, 14), textcoords="offset points", ha="center", fontsize=8)
    axes.figure.colorbar(marks, ax=axes, shrink=0.8, label="%, seen over expected")
    what = "references" if state.by_references else "cells' surroundings"
    _page(axes, chart, f"print: {what} against their codes' colours")
