"""The pictures of the report, each drawn on a Matplotlib figure of its own and returned as PNG.

Matplotlib is imported where a picture is made, and through its objects only: no window, no state left behind.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.checks.frame_consistency import has_enough_cells
from calibration.figures.table_figures import TableFigures
from calibration.registration.register import Registration
from calibration.sampling import rim_difference, sample_noise, sites_at
from experiment.chart.model import Chart
from experiment.framing.movement import STILL_PX
from experiment.measures.flat_field import FlatField
from experiment.measures.stains import Stains
from foundation.srgb import decode_srgb

INK, FAINT, MARK = "#22262b", "#8a929c", "#e8502a"
"""Colours of text and data, of axes, and of what is marked."""

WORST_CELLS = 20
"""Cells that are shown magnified: two rows of ten."""

CHANNEL_INK = ("#c8382e", "#2f8f46", "#2f62c8")
"""Colours of lines of R, G and B."""
_DPI = 110
"""Pictures 10 inches wide fill the page's 1100 pixels."""

_PAPER_PERCENTILE = 99.5
"""What is taken for paper white: brighter are highlights and hot photosites."""

_GAMMA = 2.2
"""Exponent that stands for sRGB's curve where a picture is only looked at."""

_Image = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


def png_of(draw: Callable[..., None], *arguments: Any) -> bytes:
    """Return the PNG of a figure that `draw(figure, *arguments)` fills, one of the functions below."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Matplotlib's own types leave the keyword arguments of every method unknown.
    style: Any = {
        "font.size": 9,
        "axes.edgecolor": FAINT,
        "axes.labelcolor": INK,
        "xtick.color": INK,
        "ytick.color": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 10,
    }
    library: Any = matplotlib
    with library.rc_context(style):
        figure: Any = Figure(layout="constrained", dpi=_DPI)
        FigureCanvasAgg(figure)
        draw(figure, *arguments)
        stream = BytesIO()
        figure.savefig(stream, format="png")
    return stream.getvalue()


def viewable(picture: _Image) -> _Image:
    """Return an image (H, W, 3) float32 to look at, 0 … 1: each channel to its paper white, sRGB's curve roughly."""
    white = np.maximum(np.percentile(picture[::4, ::4].reshape(-1, 3), _PAPER_PERCENTILE, axis=0), 1)
    return np.clip(picture / white, 0, 1).astype(np.float32) ** np.float32(1 / _GAMMA)


def draw_registration(figure: Any, picture: _Image, chart: Chart, registration: Registration, window: int) -> None:
    """Draw the frame with the registered chart over it, and magnified parts with the cells and their samples.

    `picture` (H, W, 3) float32 counts is the frame at half size, `window` the pixels along a window's side.
    """
    height, width = picture.shape[:2]
    figure.set_size_inches(10, 10 * height / width + 2.4)
    whole, crops = figure.subfigures(2, 1, height_ratios=(10 * height / width, 2.4))
    shown = viewable(picture)
    step = max(1, width // 1400)
    axes = whole.subplots()
    axes.imshow(shown[::step, ::step], extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="antialiased")
    for tag in registration.framing.tags:
        outline = np.vstack([tag.corners_px, tag.corners_px[:1]])
        axes.plot(outline[:, 0], outline[:, 1], color=MARK, linewidth=1.4)
    page_w, page_h = chart.page_mm
    for line in _page_lines(chart):
        places = registration.to_pixels(line)
        axes.plot(places[:, 0], places[:, 1], color="white", linewidth=0.5, alpha=0.75)
    edge = registration.lens.to_pixels([(0, 0), (page_w, 0), (page_w, page_h), (0, page_h), (0, 0)])
    axes.plot(edge[:, 0], edge[:, 1], color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    low, high = chart.centres_mm.min(axis=0), chart.centres_mm.max(axis=0)
    spots = [
        ("top left", low),
        ("top right", (high[0], low[1])),
        ("middle", (low + high) / 2),
        ("bottom left", (low[0], high[1])),
        ("bottom right", high),
    ]
    reach = 3.6 * registration.cell_px
    places = registration.to_pixels(chart.centres_mm)
    for axes, (name, spot) in zip(crops.subplots(1, len(spots)), spots, strict=True):
        nearest = int(((chart.centres_mm - np.asarray(spot)) ** 2).sum(axis=1).argmin())
        middle = places[nearest]
        _magnified(axes, shown, middle, reach, chart, registration, places, window)
        axes.set_title(name)


def _page_lines(chart: Chart) -> list[_Array]:
    """Return lines over the cells, every tenth cell or so, as points in mm."""
    low, high = chart.centres_mm.min(axis=0), chart.centres_mm.max(axis=0)
    cell = np.array(chart.cell_mm)
    lines: list[_Array] = []
    along = np.linspace(0, 1, 60)[:, None]
    for axis in (0, 1):
        count = round(float((high[axis] - low[axis]) / cell[axis])) + 1
        for number in range(0, count + 1, 10):
            start, end = low - cell / 2, high + cell / 2
            start[axis] = end[axis] = start[axis] + number * cell[axis]
            lines.append(start + along * (end - start))
    return lines


def _magnified(
    axes: Any,
    shown: _Image,
    middle: _Array,
    reach: float,
    chart: Chart,
    registration: Registration,
    places: _Array,
    window: int,
) -> None:
    """Draw part of the frame with the outlines of cells and of their samples."""
    height, width = shown.shape[:2]
    left, top = (max(0, int(value - reach)) for value in middle)
    right, bottom = (min(size, int(value + reach) + 2) for value, size in zip(middle, (width, height), strict=True))
    axes.imshow(
        shown[top:bottom, left:right],
        extent=(left - 0.5, right - 0.5, bottom - 0.5, top - 0.5),
        interpolation="nearest",
    )
    near = np.flatnonzero((np.abs(places - middle) < reach + registration.cell_px).all(axis=1))
    corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * np.array(chart.cell_mm) / 2
    for cell in near:
        outline = registration.to_pixels(chart.centres_mm[cell] + corner)
        axes.plot(outline[:, 0], outline[:, 1], color="white", linewidth=0.6)
        x, y = np.rint(places[cell])
        half = window / 2
        axes.plot(
            x + half * np.array([-1, 1, 1, -1, -1]), y + half * np.array([-1, -1, 1, 1, -1]), color=MARK, linewidth=0.8
        )
    axes.set(
        xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] + reach, middle[1] - reach), xticks=[], yticks=[]
    )


def draw_residuals(figure: Any, chart: Chart, registration: Registration) -> None:
    """Draw the displacement beyond the lens, and what is left of it in each block of cells."""
    figure.set_size_inches(10, 3.9)
    left, right = figure.subplots(1, 2)
    page_w, page_h = chart.page_mm
    # The map is measured where cells and tags are; the sheet's bare margin is extrapolation and not worth a look.
    half = np.array(chart.cell_mm) / 2
    left_mm, top_mm = (float(value) for value in chart.centres_mm.min(axis=0) - half)
    right_mm, bottom_mm = (float(value) for value in chart.centres_mm.max(axis=0) + half)
    x, y = np.meshgrid(np.linspace(left_mm, right_mm, 120), np.linspace(top_mm, bottom_mm, 80))
    moved = registration.displacement.at(np.column_stack([x.ravel(), y.ravel()]))
    length = np.linalg.norm(moved, axis=1).reshape(x.shape)
    image = left.imshow(
        length, extent=(left_mm, right_mm, bottom_mm, top_mm), cmap="magma", interpolation="bilinear", vmin=0
    )
    figure.colorbar(image, ax=left, label="px", shrink=0.75)
    every = np.s_[4::8, 4::8]
    arrows = moved.reshape(*x.shape, 2)[every]
    left.quiver(x[every], y[every], arrows[..., 0], -arrows[..., 1], color="white", alpha=0.85, width=0.0028)
    left.set(title="displacement beyond the lens", xlabel="mm", ylabel="mm", xlim=(0, page_w), ylim=(page_h, 0))
    blocks = registration.blocks
    good = blocks.good
    residual = blocks.residual_px[good]
    largest = float(np.linalg.norm(residual, axis=1).max(initial=1e-3))
    arrows = right.quiver(
        blocks.centres_mm[good, 0],
        blocks.centres_mm[good, 1],
        residual[:, 0],
        -residual[:, 1],
        color=INK,
        angles="uv",
        scale=20 * largest,
        width=0.0028,
    )
    right.quiverkey(arrows, 0.9, 1.04, largest, f"{largest:.3f} px", labelpos="W")
    right.plot(*blocks.centres_mm[~good].T, "x", color=MARK, label="does not match the chart")
    if (~good).any():
        right.legend(frameon=False, fontsize=8)
    right.set_title("residual of cell blocks", loc="left")
    right.set(xlabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal")


def draw_field(figure: Any, chart: Chart, shape: FlatField) -> None:
    """Draw the flat field of a frame, channel by channel."""
    figure.set_size_inches(10, 2.9)
    page_w, page_h = chart.page_mm
    x, y = np.meshgrid(np.linspace(0, page_w, 120), np.linspace(0, page_h, 80))
    field = shape.at(np.column_stack([x.ravel(), y.ravel()])).reshape(*x.shape, 3)
    low, high = float(field.min()), float(field.max())
    grid = figure.subplots(1, 3, sharey=True)
    image: Any = None
    for channel, axes in enumerate(grid):
        image = axes.imshow(
            field[..., channel],
            extent=(0, page_w, page_h, 0),
            cmap="cividis",
            vmin=low,
            vmax=high,
            interpolation="bilinear",
        )
        levels = np.arange(np.floor(low * 50) / 50, high + 0.02, 0.02)
        axes.contour(x, y, field[..., channel], levels=levels, colors="white", linewidths=0.5, alpha=0.7)
        axes.set(title="RGB"[channel], xlabel="mm")
    grid[0].set_ylabel("mm")
    figure.colorbar(image, ax=list(grid), label="light, mean 1", shrink=0.85)


def draw_print(figure: Any, chart: Chart, stains: Stains) -> None:
    """Draw how far the print is from its codes' colours, cell by cell."""
    page_w, page_h = chart.page_mm
    figure.set_size_inches(10, 8.6 * page_h / page_w)
    axes = figure.subplots()
    places = chart.centres_mm[chart.cell_of_colour]
    # A marker's size is an area in points: of a cell, with the axes about 8.2 inches wide.
    side = 72 * 8.2 / page_w * float(np.mean(chart.cell_mm))
    image = axes.scatter(
        *places.T, c=100 * stains.largest_deviation(), s=side**2, marker="s", linewidths=0, cmap="RdBu", vmin=-3, vmax=3
    )
    axes.plot(*places[stains.stained].T, "x", color=INK, markersize=max(3.0, 0.5 * side), markeredgewidth=0.8)
    axes.set(xlabel="mm", ylabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal")
    figure.colorbar(image, ax=axes, label="deviation, %; brighter is positive", shrink=0.8, extend="both")


def draw_chromaticities(
    figure: Any, codes: _Array, black_body: _Mask, white: _Array, seen: str, worst: int | None = None
) -> None:
    """Draw the rb-chromaticities of the lights, as projected and as the camera sees them (the paper's figures).

    `codes`: (L, 3) float64, 8-bit codes of the lights. `black_body`: (L,) bool, which lights are black bodies. `white`:
    (L, 3) float64 counts, the ground truth. `worst`: number of the light whose ground truth is known worst, which is
    ringed; None for no ring.
    """
    figure.set_size_inches(10, 3.7)
    planned = decode_srgb(codes / 255)
    panels = figure.subplots(1, 3)
    for axes, linear, title, coloured in (
        (panels[0], planned, "as projected", False),
        (panels[1], white, seen, False),
        (panels[2], white, f"{seen}, in colour", True),
    ):
        lit = linear.sum(axis=1) > 0
        r, _, b = (linear[lit] / linear[lit].sum(axis=1, keepdims=True)).T
        body = black_body[lit]
        colour = linear[lit] / linear[lit].max(axis=1, keepdims=True)
        colour = np.clip(colour, 0, 1) ** (1 / _GAMMA)
        size = 14 if lit.sum() > 200 else 30
        plain: Any = colour if coloured else INK
        axes.plot([0, 1, 0, 0], [0, 0, 1, 0], color="0.8", linewidth=0.8, zorder=1)
        axes.scatter(r[~body], b[~body], s=size, c=plain[~body] if coloured else plain, linewidths=0, zorder=2)
        axes.scatter(
            r[body],
            b[body],
            s=size,
            facecolors=colour[body] if coloured else "white",
            edgecolors=MARK,
            linewidths=1.1,
            zorder=3,
        )
        if worst is not None and lit[worst]:
            share = linear[worst] / linear[worst].sum()
            _ring(axes, float(share[0]), float(share[2]), f"light {worst}")
        axes.set(title=title, xlabel="r", aspect="equal", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    panels[0].set_ylabel("b")


def _ring(axes: Any, x: float, y: float, text: str) -> None:
    """Ring a point of a plot and name it."""
    axes.plot([x], [y], "o", markersize=11, markerfacecolor="none", markeredgecolor=MARK, markeredgewidth=1.4)
    axes.annotate(text, (x, y), xytext=(8, 8), textcoords="offset points", color=MARK, fontsize=8)


def _ring_largest(axes: Any, values: Any, figures: TableFigures, least: bool = False) -> None:
    """Ring the frame of the largest value, or the least, unless all are alike; its name is that of its file."""
    seen = np.asarray(values, dtype=np.float64)
    if not len(seen) or np.ptp(seen) == 0:
        return
    at = int(np.argmin(seen) if least else np.argmax(seen))
    _ring(axes, at, float(seen[at]), Path(figures.frames[at].record.file).stem)


def draw_course(figure: Any, figures: TableFigures) -> None:
    """Draw black, movement, blur, white, the cells' deviations and the references used, frame by frame.

    The worst frame of each is ringed and named.
    """
    frames = figures.frames
    figure.set_size_inches(10, 5.4)
    (black, shift, blur), (white, consistency, used) = figure.subplots(2, 3)
    count = np.arange(len(frames))
    level = np.array([frame.black.mean() for frame in frames])
    black.plot(count, level, ".", color=INK, markersize=3)
    black.set(title="black level", ylabel="counts", xlabel="frame")
    middle = float(np.median(level)) if len(level) else 0.0
    black.set_ylim(middle - max(1.0, float(np.ptp(level))), middle + max(1.0, float(np.ptp(level))))
    blurs = [frame.blur_px for frame in frames]
    blur.plot(count, blurs, ".", color=INK, markersize=3)
    blur.set(title="blur σ", ylabel="px", xlabel="frame")
    _ring_largest(blur, blurs, figures)
    counts = [frame.paper.references for frame in frames]
    used.plot(count, counts, ".", color=INK, markersize=3)
    used.set(title="white references used", xlabel="frame", ylim=(0, 1.15 * max(counts, default=1)))
    _ring_largest(used, counts, figures, least=True)
    moved = [frame.shift.length_px for frame in frames]
    shift.plot(count, moved, ".", color=INK, markersize=3)
    shift.axhline(STILL_PX, color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    shift.set(
        title="movement of the chart", ylabel="px", xlabel="frame", ylim=(0, max(0.12, 1.1 * max(moved, default=0)))
    )
    _ring_largest(shift, moved, figures)
    at = [number for number, frame in enumerate(frames) if frame.record.kind == "white"]
    whites = np.array([frames[number].paper.white for number in at]).reshape(-1, 3)
    if len(whites):
        for channel in range(3):
            white.plot(
                at,
                100 * (whites[:, channel] / whites[0, channel] - 1),
                ".-",
                color=CHANNEL_INK[channel],
                label="RGB"[channel],
                linewidth=0.9,
            )
        white.legend(frameon=False, fontsize=8)
    white.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    white.set(title="bare paper under white", ylabel="change since the first, %", xlabel="frame")
    _draw_consistency(consistency, count, figures)


def _draw_consistency(axes: Any, count: npt.NDArray[np.integer], figures: TableFigures) -> None:
    axes.set(title="cells off their codes' colours", ylabel="%", xlabel="frame")
    if not has_enough_cells(len(figures.registration.mismatched_cells)):
        axes.text(0.5, 0.5, "too few colours to compare", ha="center", va="center", transform=axes.transAxes)
        return
    axes.plot(
        count,
        [100 * frame.consistency.scatter for frame in figures.frames],
        ".",
        color=INK,
        markersize=3,
        label="scatter of all cells",
    )
    axes.plot(
        count,
        [100 * frame.consistency.block for frame in figures.frames],
        "x",
        color=MARK,
        markersize=3,
        label="worst block of cells",
    )
    axes.legend(frameon=False, fontsize=7, loc="upper right")
    axes.set_ylim(bottom=0, top=max(1.5, 1.3 * axes.get_ylim()[1]))
    _ring_largest(axes, [100 * frame.consistency.scatter for frame in figures.frames], figures)
    if any(frame.consistency.block for frame in figures.frames):
        _ring_largest(axes, [100 * frame.consistency.block for frame in figures.frames], figures)


def draw_worst_cells(figure: Any, picture: _Image, chart: Chart, registration: Registration, window: int) -> None:
    """Draw the cells whose rim and middle differ most, magnified.

    `picture` is (H, W, 3) float32 counts; all parameters are those of `draw_registration`.
    """
    figure.set_size_inches(10, 3.1)
    height, width = picture.shape[:2]
    places = registration.to_pixels(chart.centres_mm)
    sites = sites_at(places, (height, width), window)
    offsets = np.arange(window) - window // 2
    at = np.flatnonzero(sites.inside)
    samples = picture[sites.rows[at, None, None] + offsets[:, None], sites.columns[at, None, None] + offsets]
    samples = samples.reshape(len(at), window**2, 3)
    difference, sigma = rim_difference(samples, sample_noise(samples))
    score = (difference / np.maximum(sigma, 1e-6)).max(axis=1)
    shown = viewable(picture)
    order = np.argsort(-score)[:WORST_CELLS]
    for axes, index in zip(figure.subplots(2, WORST_CELLS // 2).ravel(), order, strict=False):
        cell = int(at[index])
        _magnified(axes, shown, places[cell], 0.95 * registration.cell_px, chart, registration, places, window)
        red, green, blue = chart.rgb[cell]
        axes.set_title(f"{red} {green} {blue}\n{score[index]:.1f} σ", fontsize=8)
