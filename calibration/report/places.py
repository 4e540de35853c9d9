"""Pictures of what is beyond its limit: the frame with the places circled, and what the field leaves of references."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.causes.place_evidence import PrintPlace
from calibration.figures.frame_figures import FrameFigures
from calibration.registration.register import Registration
from calibration.report.plots import FAINT, INK, MARK, viewable
from experiment.chart.model import Chart

_LEAST_CIRCLE = 0.012
"""Radius of a circle at least, as a share of the page's width: one about a single cell is not seen in a thumbnail."""

_WINDOW = 2
"""Pixels about a reference's middle, to each side, that are averaged for the picture: those of the table's samples."""

_Image = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]

LabelledPlace = tuple[str, PrintPlace]
"""What is said of a place, in few words, and the place."""


def draw_places(figure: Any, picture: _Image, chart: Chart, registration: Registration, places: Any) -> None:
    """Draw a frame with places circled and numbered as their list below the picture.

    `picture`: (H, W, 3) float32 counts, the frame at half size.
    """
    height, width = picture.shape[:2]
    numbers = {label: number for number, label in enumerate(dict.fromkeys(label for label, _ in places), 1)}
    legend = 0.22 * len(numbers) + 0.1
    figure.set_size_inches(10, 10 * height / width + legend)
    axes, below = figure.subplots(2, 1, height_ratios=(10 * height / width, legend))
    step = max(1, width // 1200)
    axes.imshow(
        viewable(picture)[::step, ::step],
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        interpolation="antialiased",
    )
    turn = np.linspace(0, 2 * np.pi, 90)
    unit = np.column_stack([np.cos(turn), np.sin(turn)])
    # Figures that see the same thing share its circle.
    shared: dict[tuple[float, float, float], list[int]] = {}
    for label, place in places:
        shared.setdefault((place.x_mm, place.y_mm, place.size_mm), []).append(numbers[label])
    named: set[tuple[int, ...]] = set()
    for (x_mm, y_mm, size_mm), here in shared.items():
        radius = max(size_mm / 2 * 1.15, _LEAST_CIRCLE * chart.page_mm[0])
        ring = registration.to_pixels(np.array([x_mm, y_mm]) + radius * unit)
        # A white line below keeps the circle visible on every colour.
        axes.plot(ring[:, 0], ring[:, 1], color="white", linewidth=3.4, alpha=0.9)
        axes.plot(ring[:, 0], ring[:, 1], color=MARK, linewidth=1.8)
        if tuple(here) not in named:
            named.add(tuple(here))
            x, y = ring[np.argmin(ring[:, 0] + ring[:, 1])]
            box = {"facecolor": MARK, "edgecolor": "white", "boxstyle": "round,pad=0.25"}
            axes.text(x, y, ", ".join(map(str, here)), color="white", weight="bold", ha="right", va="bottom", bbox=box)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    below.axis("off")
    for row, (label, number) in enumerate(numbers.items()):
        below.text(0.01, 1 - (row + 0.5) / len(numbers), f"{number}   {label}", va="center", transform=below.transAxes)


def reference_residuals(picture: _Image, places_mm: _Array, registration: Registration, frame: FrameFigures) -> _Array:
    """Return how far references are from a frame's field, (N,) shares, in its strongest channel; NaN beyond the frame.

    `picture`: (H, W, 3) float32 counts above black, the frame at half size. `places_mm`: (N, 2) float64 mm, the white
    references.
    """
    height, width = picture.shape[:2]
    columns, rows = np.rint(registration.to_pixels(places_mm)).astype(np.int64).T
    channel = int(np.argmax(frame.paper.white))
    inside = (columns >= _WINDOW) & (columns < width - _WINDOW) & (rows >= _WINDOW) & (rows < height - _WINDOW)
    offsets = np.arange(-_WINDOW, _WINDOW + 1)
    seen = np.full(len(places_mm), np.nan)
    parts = picture[rows[inside, None, None] + offsets[:, None], columns[inside, None, None] + offsets, channel]
    seen[inside] = parts.mean(axis=(1, 2), dtype=np.float64)
    return seen / (frame.paper.field.at(places_mm)[:, channel] * frame.paper.white[channel]) - 1


def draw_reference_residuals(figure: Any, chart: Chart, places_mm: _Array, residual: _Array) -> None:
    """Draw what the field leaves of the white references, over the page and against the distance from its middle.

    `places_mm`: (N, 2) float64 mm. `residual`: (N,) shares, as `reference_residuals` returned them.
    """
    page_w, page_h = chart.page_mm
    figure.set_size_inches(10, 3.6)
    left, right = figure.subplots(1, 2)
    percent = 100 * residual
    limit = max(1.0, float(np.nanpercentile(np.abs(percent), 99)))
    dots = left.scatter(
        *places_mm.T, c=percent, s=14, cmap="RdBu", vmin=-limit, vmax=limit, edgecolors=FAINT, linewidths=0.3
    )
    left.set(xlabel="mm", ylabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal", facecolor="#f2f3f5")
    figure.colorbar(dots, ax=left, label="%, brighter is positive", shrink=0.8, extend="both")
    away = np.linalg.norm(places_mm - np.array([page_w, page_h]) / 2, axis=1)
    right.axhline(0, color=FAINT, linewidth=0.8)
    right.plot(away, percent, ".", color=INK, markersize=3)
    right.set(xlabel="mm from the page's middle", ylabel="%")
    reach = max(1.0, 1.1 * float(np.nanmax(np.abs(percent))))
    right.set_ylim(-reach, reach)
