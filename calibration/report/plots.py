"""Plots of the report, each with one or several panels (`foundation.plots.draw_panels`).

Frames are drawn at half size, one pixel per 2×2 block, without interpolation (paper, section 3.3: "simple subsampling
and debayering").
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.budget import Budget
from calibration.causes.gathering import PrintPosition
from calibration.checks.frame_consistency import has_enough_cells
from calibration.measurements import TableMeasurements
from calibration.registration.register import Registration
from calibration.sampling import PhotonTransfer, noise_levels, sites_at
from drivers.raw.rawfile import CHANNELS, Mosaic, frame_black, phases
from experiment.chart.model import Chart
from experiment.framing.pictures import STILL_PX
from experiment.measures.paper import FlatField
from foundation.colorimetry import decode_srgb
from foundation.plots import CHANNEL_INK, FAINT, INK, MARK, PAPER, SERIES, draw_squares

_PAPER_PERCENTILE = 99.5  # Percentile used as paper white; brighter pixels are highlights or hot photosites

_GAMMA = 2.2  # Approximates the sRGB curve for display

_PHOTOGRAPH_WIDTH = 9.6  # Inches, so that no panel fits next to it

_Mask = npt.NDArray[np.bool_]


def viewable(picture: _Image) -> _Image:
    """Return an image (H, W, 3) float32 for display, 0 … 1: each channel relative to paper white, gamma-encoded."""
    white = np.maximum(np.percentile(picture[::4, ::4].reshape(-1, 3), _PAPER_PERCENTILE, axis=0), 1)
    return np.clip(picture / white, 0, 1).astype(np.float32) ** np.float32(1 / _GAMMA)


def draw_registration(panels: Any, picture: _Image, chart: Chart, registration: Registration, window: int) -> None:
    """Draw the frame with the registered chart, and in five more panels magnified areas with patches and samples.

    `picture`: (H, W, 3) float32 counts, half-size frame. `window`: side of a sampling window, px.
    """
    view = viewable(picture)
    axes, *crops = panels
    _show_frame(axes, view)
    for tag in registration.framing.tags:
        outline = np.vstack([tag.corners_px, tag.corners_px[:1]])
        axes.plot(outline[:, 0], outline[:, 1], color=MARK, linewidth=1.4)
    page_w, page_h = chart.page_mm
    for line in _page_lines(chart):
        pixels = registration.to_pixels(line)
        axes.plot(pixels[:, 0], pixels[:, 1], color="white", linewidth=0.5, alpha=0.75)
    edge = registration.lens.to_pixels([(0, 0), (page_w, 0), (page_w, page_h), (0, page_h), (0, 0)])
    axes.plot(edge[:, 0], edge[:, 1], color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    low, high = chart.centres_mm.min(axis=0), chart.centres_mm.max(axis=0)
    areas = [
        ("top left", low),
        ("top right", (high[0], low[1])),
        ("middle", (low + high) / 2),
        ("bottom left", (low[0], high[1])),
        ("bottom right", high),
    ]
    reach = 3.6 * registration.cell_px
    pixels = registration.to_pixels(chart.centres_mm)
    for axes, (name, point) in zip(crops, areas, strict=True):
        nearest = int(((chart.centres_mm - np.asarray(point)) ** 2).sum(axis=1).argmin())
        middle = pixels[nearest]
        _draw_magnified(axes, view, middle, reach, chart, registration, pixels, window)
        axes.set_title(name)


def _show_frame(axes: Any, view: _Image) -> None:
    height, width = view.shape[:2]
    axes.figure.set_size_inches(_PHOTOGRAPH_WIDTH, _PHOTOGRAPH_WIDTH * height / width)
    step = max(1, width // 1200)
    axes.imshow(view[::step, ::step], extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="antialiased")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])


def _page_lines(chart: Chart) -> list[_Array]:
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


def _draw_magnified(
    axes: Any,
    view: _Image,
    middle: _Array,
    reach: float,
    chart: Chart,
    registration: Registration,
    pixels: _Array,
    window: int,
) -> None:
    height, width = view.shape[:2]
    left, top = (max(0, int(value - reach)) for value in middle)
    right, bottom = (min(size, int(value + reach) + 2) for value, size in zip(middle, (width, height), strict=True))
    axes.imshow(
        view[top:bottom, left:right],
        extent=(left - 0.5, right - 0.5, bottom - 0.5, top - 0.5),
        interpolation="nearest",
    )
    near = np.flatnonzero((np.abs(pixels - middle) < reach + registration.cell_px).all(axis=1))
    corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * np.array(chart.cell_mm) / 2
    for cell in near:
        outline = registration.to_pixels(chart.centres_mm[cell] + corner)
        axes.plot(outline[:, 0], outline[:, 1], color="white", linewidth=0.6)
        x, y = np.rint(pixels[cell])
        half = window / 2
        axes.plot(
            x + half * np.array([-1, 1, 1, -1, -1]), y + half * np.array([-1, -1, 1, 1, -1]), color=MARK, linewidth=0.8
        )
    axes.set(
        xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] + reach, middle[1] - reach), xticks=[], yticks=[]
    )


def draw_residuals(panels: Any, chart: Chart, registration: Registration) -> None:
    """Draw the displacement beyond the lens, and its residual in each block of patches."""
    left_axes, right_axes = panels
    page_w, page_h = chart.page_mm
    # The margin is not drawn, because the displacement is only measured at patches and tags.
    half = np.array(chart.cell_mm) / 2
    left_mm, top_mm = (float(value) for value in chart.centres_mm.min(axis=0) - half)
    right_mm, bottom_mm = (float(value) for value in chart.centres_mm.max(axis=0) + half)
    x, y = np.meshgrid(np.linspace(left_mm, right_mm, 120), np.linspace(top_mm, bottom_mm, 80))
    moved = registration.displacement.at(np.column_stack([x.ravel(), y.ravel()]))
    length = np.linalg.norm(moved, axis=1).reshape(x.shape)
    image = left_axes.imshow(
        length, extent=(left_mm, right_mm, bottom_mm, top_mm), cmap="magma", interpolation="bilinear", vmin=0
    )
    left_axes.figure.colorbar(image, ax=left_axes, label="px", shrink=0.75)
    grid = np.s_[4::8, 4::8]
    arrows = moved.reshape(*x.shape, 2)[grid]
    left_axes.quiver(x[grid], y[grid], arrows[..., 0], -arrows[..., 1], color="white", alpha=0.85, width=0.0028)
    left_axes.set(title="displacement of the sheet", xlabel="mm", ylabel="mm", xlim=(0, page_w), ylim=(page_h, 0))
    blocks = registration.blocks
    good = blocks.good
    residual = blocks.residual_px[good]
    largest = float(np.linalg.norm(residual, axis=1).max(initial=1e-3))
    right_axes.quiver(
        blocks.centres_mm[good, 0],
        blocks.centres_mm[good, 1],
        residual[:, 0],
        -residual[:, 1],
        color=INK,
        angles="uv",
        scale=20 * largest,
        width=0.0028,
    )
    right_axes.plot(*blocks.centres_mm[~good].T, "x", color=MARK, label="does not match the chart")
    if (~good).any():
        right_axes.legend(fontsize=8)
    right_axes.set(
        title=f"residual of patch blocks, longest {largest:.3f} px",
        xlabel="mm",
        xlim=(0, page_w),
        ylim=(page_h, 0),
        aspect="equal",
    )


def draw_field(panels: Any, chart: Chart, shape: FlatField) -> None:
    """Draw the flat field of a frame, one panel for each channel."""
    page_w, page_h = chart.page_mm
    x, y = np.meshgrid(np.linspace(0, page_w, 120), np.linspace(0, page_h, 80))
    field = shape.at(np.column_stack([x.ravel(), y.ravel()])).reshape(*x.shape, 3)
    low, high = float(field.min()), float(field.max())
    for channel, axes in enumerate(panels):
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
        axes.set(title="RGB"[channel], xlabel="mm", ylabel="mm")
        axes.grid(visible=False)
        axes.figure.colorbar(image, ax=axes, label="light, mean 1", shrink=0.6)


def draw_chromaticities(panels: Any, codes: _Array, kelvins: _Array, white: _Array, worst: int | None = None) -> None:
    """Draw the rb-chromaticities of the illuminants in their colours, as projected and as recorded.

    `codes`: (L, 3) float64, 8-bit codes. `kelvins`: (L,) float64, temperatures of the black bodies, NaN for other
    illuminants. `white`: (L, 3) float64 counts, the ground truth. `worst`: illuminant to mark with a circle, if any.
    """
    for axes, linear, title in zip(panels, (decode_srgb(codes / 255), white), ("projected", "recorded"), strict=True):
        lit = linear.sum(axis=1) > 0
        rb = linear[:, ::2] / np.maximum(linear.sum(axis=1, keepdims=True), 1e-300)
        colours = np.clip(linear / np.maximum(linear.max(axis=1, keepdims=True), 1e-300), 0, 1) ** (1 / _GAMMA)
        is_body = lit & np.isfinite(kelvins)
        size = 14 if lit.sum() > _MANY_LIGHTS else 30
        axes.plot([0, 1, 0, 0], [0, 0, 1, 0], color=FAINT, linewidth=0.6, zorder=1)
        for shown, edge, width in ((lit & ~is_body, FAINT, 0.3), (is_body, INK, 0.9)):
            axes.scatter(*rb[shown].T, s=size, c=colours[shown], edgecolors=edge, linewidths=width, zorder=3)
        bodies = np.flatnonzero(is_body)[np.argsort(kelvins[is_body], kind="stable")]
        axes.plot(*rb[bodies].T, color=INK, linewidth=0.9, zorder=2)
        last = np.array([np.inf, np.inf])
        for light in bodies:
            # Labels closer than this would overlap.
            if np.abs(rb[light] - last).max() > _LABEL_DISTANCE:
                last = rb[light]
                axes.annotate(
                    f"{kelvins[light]:.0f} K",
                    last,
                    xytext=(-6, -3),
                    textcoords="offset points",
                    ha="right",
                    fontsize=7.5,
                )
        axes.set(title=title, xlabel="r = R / (R + G + B)", ylabel="b = B / (R + G + B)", aspect="equal")
        axes.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
        if worst is not None and lit[worst]:
            _ring(axes, float(rb[worst, 0]), float(rb[worst, 1]), f"illuminant {worst}")


_MANY_LIGHTS = 200  # Number of illuminants from which their marks are smaller

_LABEL_DISTANCE = 0.05  # Smallest distance of two labelled black bodies, in r or b


def draw_budget(panels: Any, budget: Budget, levels: _Array) -> None:
    """Draw the expanded uncertainty of each illuminant by component, and of each patch against its level.

    `levels`: (C, 3) float64, relative to bare paper.
    """
    lights, cells = panels
    expanded = budget.expanded_deg
    order = np.argsort(-expanded, kind="stable")
    heights = expanded * budget.lights_deg**2 / np.maximum((budget.lights_deg**2).sum(axis=0), 1e-18)
    at, base = np.arange(len(order)), np.zeros(len(order))
    for number, (component, height) in enumerate(zip(budget.components, heights[:, order], strict=True)):
        lights.bar(
            at,
            height,
            1.0 if len(order) > _MAX_LABELLED_BARS else 0.8,
            bottom=base,
            color=SERIES[number % len(SERIES)],
            hatch="///" if component.assumed else None,
            edgecolor=PAPER if component.assumed else "none",
            linewidth=0,
            label=f"{component.name} (assumed)" if component.assumed else component.name,
        )
        base += height
    lights.set(title="ground truth", xlabel="illuminants, the worst first", ylabel="degrees, k = 2")
    lights.set_xlim(-0.6, len(at) - 0.4)
    lights.set_ylim(0, 1.45 * lights.get_ylim()[1])  # Space for the legend
    lights.legend(fontsize=8, loc="upper right", ncols=2)
    if len(at) <= _MAX_LABELLED_BARS:
        lights.set_xticks(at, [str(light) for light in order])
    else:
        lights.set_xticks([])
    for channel in range(3):
        uncertainty = 100 * budget.expanded_cells[:, channel]
        cells.plot(
            levels[:, channel],
            uncertainty,
            ".",
            color=CHANNEL_INK[channel],
            markersize=2,
            label="RGB"[channel],
            rasterized=True,
        )
    cells.set(title="patches", xlabel="level, bare paper 1", ylabel="% of the level, k = 2", xscale="log", yscale="log")
    for axis in (cells.xaxis, cells.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    cells.legend(fontsize=8)


_MAX_LABELLED_BARS = 40  # Largest number of illuminants for which bars are separate and numbered


def _ring(axes: Any, x: float, y: float, text: str) -> None:
    axes.plot([x], [y], "o", markersize=11, markerfacecolor="none", markeredgecolor=MARK, markeredgewidth=1.4)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    across, up = (x - left) / (right - left), (y - low) / (high - low)
    axes.annotate(
        text,
        (x, y),
        xytext=(-8 if across > _INWARD_FROM else 8, -14 if up > _INWARD_FROM else 8),
        textcoords="offset points",
        ha="right" if across > _INWARD_FROM else "left",
        color=MARK,
        fontsize=8,
    )


_INWARD_FROM = 0.7  # Beyond this fraction of an axis, labels are placed on the inner side of their point


def _ring_largest(axes: Any, values: Any, table: TableMeasurements, smallest: bool = False) -> None:
    """Circle the frame of the largest (or smallest) value and label it with its file name, unless all are equal."""
    array = np.asarray(values, dtype=np.float64)
    if not len(array) or np.ptp(array) == 0:
        return
    index = int(np.argmin(array) if smallest else np.argmax(array))
    _ring(axes, index, float(array[index]), Path(table.frames[index].record.file).stem)


def draw_frame_values(panels: Any, table: TableMeasurements) -> None:
    """Draw black level, movement, blur, white, deviation of patches and number of references of each frame.

    Rings mark the worst frames.
    """
    frames = table.frames
    black, shift, blur, white, consistency, used = panels
    count = np.arange(len(frames))
    level = np.array([frame.black.mean() for frame in frames])
    blurs, movements = [frame.blur_px for frame in frames], [frame.shift.length_px for frame in frames]
    counts = [frame.paper.references for frame in frames]
    for axes, values, title, unit in (
        (black, level, "black level", "counts"),
        (blur, blurs, "blur σ", "px"),
        (used, counts, "white references used", ""),
        (shift, movements, "movement of the chart", "px"),
    ):
        axes.plot(count, values, ".", color=INK, markersize=3)
        axes.set(title=title, ylabel=unit, xlabel="frame")
    middle = float(np.median(level)) if len(level) else 0.0
    black.set_ylim(middle - max(1.0, float(np.ptp(level))), middle + max(1.0, float(np.ptp(level))))
    _ring_largest(blur, blurs, table)
    used.set_ylim(0, 1.15 * max(counts, default=1))
    _ring_largest(used, counts, table, smallest=True)
    shift.axhline(STILL_PX, color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    shift.set_ylim(0, max(0.12, 1.1 * max(movements, default=0)))
    _ring_largest(shift, movements, table)
    white_numbers = [number for number, frame in enumerate(frames) if frame.record.kind == "white"]
    whites = np.array([frames[number].paper.white for number in white_numbers]).reshape(-1, 3)
    if len(whites):
        for channel in range(3):
            white.plot(
                white_numbers,
                100 * (whites[:, channel] / whites[0, channel] - 1),
                ".-",
                color=CHANNEL_INK[channel],
                label="RGB"[channel],
                linewidth=0.9,
            )
        white.legend(fontsize=8)
    white.axhline(0, color=FAINT, linewidth=0.8, zorder=0)
    white.set(title="bare paper under white", ylabel="change since the first, %", xlabel="frame")
    _draw_consistency(consistency, count, table)


def _draw_consistency(axes: Any, count: npt.NDArray[np.integer], table: TableMeasurements) -> None:
    axes.set(title="deviation from similar patches", ylabel="%", xlabel="frame")
    if not has_enough_cells(len(table.registration.mismatched_cells)):
        axes.text(0.5, 0.5, "too few colours to compare", ha="center", va="center", transform=axes.transAxes)
        return
    scatter = [100 * frame.consistency.scatter for frame in table.frames]
    block = [100 * frame.consistency.block for frame in table.frames]
    axes.plot(count, scatter, ".", color=INK, markersize=3, label="scatter of all patches")
    axes.plot(count, block, "x", color=MARK, markersize=3, label="worst block of patches")
    axes.legend(fontsize=7, loc="upper right")
    axes.set_ylim(bottom=0, top=max(1.5, 1.3 * axes.get_ylim()[1]))
    _ring_largest(axes, scatter, table)
    _ring_largest(axes, block, table)


_MIN_LEVEL = 1.0  # Lowest level drawn on the logarithmic axes, counts

# Percentile of the position errors where the colour scale ends; the outermost patches have much larger errors.
_SCALE_PERCENTILE = 99.0

_Image = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]


def draw_errors(panels: Any, table: TableMeasurements, chart: Chart) -> None:
    """Draw the deviation of patches from their codes' colours, and the uncertainty of their positions, over the print.

    Rings mark the worst patches. On charts with too few colours the first plot contains only a note.
    """
    page_w, page_h = chart.page_mm
    left, right = panels
    side_mm = float(np.mean(chart.cell_mm))
    stains = table.cells.stains
    if stains.is_known:
        percent = 100 * stains.largest_deviation()
        mm = chart.centres_mm[chart.cell_of_colour]
        limit = max(1.0, float(np.abs(percent).max()))
        image = draw_squares(left, chart.page_mm, mm, side_mm, percent, 3.3, cmap="RdBu", vmin=-limit, vmax=limit)
        left.figure.colorbar(image, ax=left, label="%, brighter is positive", shrink=0.8)
        _mark(left, mm[int(np.argmax(np.abs(percent)))])
    else:
        left.text(0.5, 0.5, "too few colours to compare", ha="center", va="center", transform=left.transAxes)
    error = table.registration.uncertainty_px(chart.centres_mm)
    top = max(float(np.percentile(error, _SCALE_PERCENTILE)), 1e-3)
    image = draw_squares(right, chart.page_mm, chart.centres_mm, side_mm, error, 3.3, cmap="cividis", vmin=0, vmax=top)
    right.figure.colorbar(image, ax=right, label="half-size px", shrink=0.8, extend="max")
    _mark(right, chart.centres_mm[int(np.argmax(error))])
    left.set(title="deviation from similar patches", ylabel="mm")
    right.set(title="standard uncertainty of positions")
    for axes in (left, right):
        axes.set(xlabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal")


def _mark(axes: Any, place_mm: _Array) -> None:
    axes.plot(*place_mm, "o", markersize=13, markerfacecolor="none", markeredgecolor="white", markeredgewidth=2.6)
    axes.plot(*place_mm, "o", markersize=13, markerfacecolor="none", markeredgecolor=MARK, markeredgewidth=1.4)


def cell_noise(picture: _Image, chart: Chart, registration: Registration, window: int) -> tuple[_Array, _Array]:
    """Return mean and variance of the samples of each patch inside the frame, both (N, 3) float64.

    `picture`: (H, W, 3) float32 counts above black, half-size frame.
    """
    samples = _samples(picture, registration.to_pixels(chart.centres_mm), window)[1].astype(np.float64)
    return samples.mean(axis=1), samples.var(axis=1, ddof=1)


def _samples(picture: _Image, pixels: _Array, window: int) -> tuple[npt.NDArray[np.intp], _Image]:
    """Return the indices (M,) of patches at pixels (N, 2) inside the frame, and their samples (M, window², 3)."""
    height, width = picture.shape[:2]
    sites = sites_at(pixels, (height, width), window)
    offsets = np.arange(window) - window // 2
    indices = np.flatnonzero(sites.inside)
    samples = picture[sites.rows[indices, None, None] + offsets[:, None], sites.columns[indices, None, None] + offsets]
    return indices, samples.reshape(len(indices), window**2, 3)


def draw_noise(panels: Any, noise: tuple[_Array, _Array], transfer: PhotonTransfer, samples: int) -> None:
    """Draw the photon-transfer curve: variance of one sample against its level, measured and fitted.

    `noise`: mean and variance of each patch, both (N, 3) float64, from `cell_noise`.
    """
    from matplotlib.ticker import LogLocator, StrMethodFormatter

    left, right = panels
    level, variance = noise
    for channel in range(3):
        levels, variances = noise_levels(level[:, channel], variance[:, channel], samples)
        is_drawn = (levels > _MIN_LEVEL) & (variances > 0)
        levels, variances = levels[is_drawn], variances[is_drawn]
        if not len(levels):
            continue
        low, high = float(levels.min()), float(levels.max())
        grid = low * (high / low) ** np.linspace(0, 1, 120)
        model = transfer.variance(np.repeat(grid[:, None], 3, axis=1))[:, channel]
        gain = transfer.gain_e[channel]
        name = f"{'RGB'[channel]}: {gain:.2f} e⁻ per count, read noise {transfer.read_noise[channel]:.1f} counts"
        if len(levels) < _MIN_LEVELS:
            name = f"{'RGB'[channel]}: too few levels to measure the gain"
        left.loglog(levels, variances, ".", color=CHANNEL_INK[channel], markersize=4)
        left.loglog(grid, model, "-", color=CHANNEL_INK[channel], linewidth=0.9, label=name)
        right.semilogx(levels, levels / np.sqrt(variances), ".", color=CHANNEL_INK[channel], markersize=4)
        right.semilogx(grid, grid / np.sqrt(model), "-", color=CHANNEL_INK[channel], linewidth=0.9)
    left.set(title="variance of one sample", xlabel="counts above black", ylabel="counts²")
    right.set(title="signal to noise of one sample", xlabel="counts above black")
    left.legend(fontsize=7.5)
    for axes in (left, right):
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.minorticks_off()


_MIN_LEVELS = 6  # Minimum number of levels for reporting the three parameters of the curve; chosen by judgement

# Smallest radius of a circle, relative to the page width. A circle around a single patch would be too small to see.
_MIN_RADIUS = 0.012

LabelledPosition = tuple[str, PrintPosition]


def numbered_labels(positions: Sequence[LabelledPosition]) -> dict[str, int]:
    """Return the number of each label, from 1."""
    return {label: number for number, label in enumerate(dict.fromkeys(label for label, _ in positions), 1)}


def draw_positions(
    panels: Any, picture: _Image, chart: Chart, registration: Registration, positions: Sequence[LabelledPosition]
) -> None:
    """Draw a frame with circles at positions, with the numbers of `numbered_labels`.

    `picture`: (H, W, 3) float32 counts, half-size frame.
    """
    (axes,) = panels
    height, width = picture.shape[:2]
    numbers = numbered_labels(positions)
    _show_frame(axes, viewable(picture))
    angles = np.linspace(0, 2 * np.pi, 90)
    unit_circle = np.column_stack([np.cos(angles), np.sin(angles)])
    # Deviations at the same position share a circle.
    numbers_by_circle: dict[tuple[float, float, float], list[int]] = {}
    for label, position in positions:
        numbers_by_circle.setdefault((position.x_mm, position.y_mm, position.size_mm), []).append(numbers[label])
    labelled: set[tuple[int, ...]] = set()
    for (x_mm, y_mm, size_mm), shown_numbers in numbers_by_circle.items():
        radius = max(size_mm / 2 * 1.15, _MIN_RADIUS * chart.page_mm[0])
        ring = registration.to_pixels(np.array([x_mm, y_mm]) + radius * unit_circle)
        # A white line below keeps the circle visible on every colour.
        axes.plot(ring[:, 0], ring[:, 1], color="white", linewidth=3.4, alpha=0.9)
        axes.plot(ring[:, 0], ring[:, 1], color=MARK, linewidth=1.8)
        if tuple(shown_numbers) not in labelled:
            labelled.add(tuple(shown_numbers))
            # If part of a circle is outside the frame, the number is placed at the visible part.
            visible = ring[((ring > (0.02 * width, 0.03 * height)) & (ring < (width, height))).all(axis=1)]
            corners = visible if len(visible) else ring
            x, y = corners[np.argmin(corners.sum(axis=1))]
            box = {"facecolor": MARK, "edgecolor": "white", "boxstyle": "round,pad=0.25"}
            text = ", ".join(map(str, shown_numbers))
            axes.text(x, y, text, color="white", weight="bold", fontsize=13, ha="right", va="bottom", bbox=box)


def half_size(mosaic: Mosaic) -> npt.NDArray[np.float32]:
    """Return a frame as linear RGB, (H // 2, W // 2, 3) float32 counts above black, which may be negative."""
    black = frame_black(mosaic)
    blocks = mosaic.block_planes()
    image = np.empty((*blocks.shape[2:], 3), dtype=np.float32)
    for column, channel in enumerate(CHANNELS):
        sites = phases(mosaic)[channel]
        image[..., column] = sum(blocks[site] - np.float32(black[site]) for site in sites) / np.float32(len(sites))
    return image
