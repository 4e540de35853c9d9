"""The pictures of the report, each drawn on a Matplotlib figure of its own (`foundation.plots.draw_png`).

A frame is drawn at half size, linear camera RGB: one pixel for each 2×2 block, nothing interpolated (the paper's
"simple subsampling and debayering", section 3.3).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.budget import Budget
from calibration.causes.gathering import PrintPlace
from calibration.checks.frame_consistency import has_enough_cells
from calibration.measurements import TableMeasurements
from calibration.registration.register import Registration
from calibration.sampling import PhotonTransfer, noise_levels, sites_at
from drivers.raw.rawfile import CHANNELS, Mosaic, frame_black, phases
from experiment.chart.model import Chart
from experiment.framing.pictures import STILL_PX
from experiment.measures.paper import FlatField
from foundation.colorimetry import decode_srgb
from foundation.plots import CHANNEL_INK, FAINT, INK, MARK, draw_squares

_PAPER_PERCENTILE = 99.5  # What is taken for paper white: brighter are highlights and hot photosites

_GAMMA = 2.2  # Exponent that stands for sRGB's curve where a picture is only looked at
_Mask = npt.NDArray[np.bool_]


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


def draw_budget(figure: Any, budget: Budget, levels: _Array) -> None:
    """Draw the expanded uncertainty of each light by cause, and that of each cell over its level.

    `levels`: (C, 3) float64, bare paper 1.
    """
    figure.set_size_inches(10, 3.7)
    lights, cells = figure.subplots(1, 2, width_ratios=(3, 2))
    expanded = budget.expanded_deg
    order = np.argsort(-expanded, kind="stable")
    shared = expanded * budget.lights_deg**2 / np.maximum((budget.lights_deg**2).sum(axis=0), 1e-18)
    at, base = np.arange(len(order)), np.zeros(len(order))
    for number, (one, height) in enumerate(zip(budget.components, shared[:, order], strict=True)):
        lights.bar(
            at,
            height,
            1.0 if len(order) > _BARS_APART else 0.8,
            bottom=base,
            color=f"C{number}",
            hatch="///" if one.assumed else None,
            edgecolor="white" if one.assumed else "none",
            linewidth=0,
            label=f"{one.name} (assumed)" if one.assumed else one.name,
        )
        base += height
    lights.set(title="ground truth", xlabel="lights, the worst first", ylabel="degrees, k = 2")
    lights.set_xlim(-0.6, len(at) - 0.4)
    lights.legend(frameon=False, fontsize=8)
    if len(at) <= _BARS_APART:
        lights.set_xticks(at, [str(light) for light in order])
    else:
        lights.set_xticks([])
    for channel in range(3):
        off = 100 * budget.expanded_cells[:, channel]
        cells.plot(levels[:, channel], off, ".", color=CHANNEL_INK[channel], markersize=2, label="RGB"[channel])
    cells.set(title="cells", xlabel="level, bare paper 1", ylabel="% of the level, k = 2", xscale="log", yscale="log")
    for axis in (cells.xaxis, cells.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    cells.legend(frameon=False, fontsize=8)


_BARS_APART = 40  # Lights up to which each has a bar of its own, and its number


def _ring(axes: Any, x: float, y: float, text: str) -> None:
    """Ring a point of a plot and name it; at the plot's edges the name is turned inwards."""
    axes.plot([x], [y], "o", markersize=11, markerfacecolor="none", markeredgecolor=MARK, markeredgewidth=1.4)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    across, up = (x - left) / (right - left), (y - low) / (high - low)
    axes.annotate(
        text,
        (x, y),
        xytext=(-8 if across > _EDGE else 8, -14 if up > _EDGE else 8),
        textcoords="offset points",
        ha="right" if across > _EDGE else "left",
        color=MARK,
        fontsize=8,
    )


_EDGE = 0.7  # Share of a plot's width and height beyond which a name would leave it


def _ring_largest(axes: Any, values: Any, table: TableMeasurements, least: bool = False) -> None:
    """Ring the frame of the largest value, or the least, unless all are alike; its name is that of its file."""
    seen = np.asarray(values, dtype=np.float64)
    if not len(seen) or np.ptp(seen) == 0:
        return
    at = int(np.argmin(seen) if least else np.argmax(seen))
    _ring(axes, at, float(seen[at]), Path(table.frames[at].record.file).stem)


def draw_course(figure: Any, table: TableMeasurements) -> None:
    """Draw black, movement, blur, white, the cells' deviations and the references used, frame by frame.

    The worst frame of each is ringed and named.
    """
    frames = table.frames
    figure.set_size_inches(10, 5.4)
    (black, shift, blur), (white, consistency, used) = figure.subplots(2, 3)
    count = np.arange(len(frames))
    level = np.array([frame.black.mean() for frame in frames])
    blurs, moved = [frame.blur_px for frame in frames], [frame.shift.length_px for frame in frames]
    counts = [frame.paper.references for frame in frames]
    for axes, values, title, unit in (
        (black, level, "black level", "counts"),
        (blur, blurs, "blur σ", "px"),
        (used, counts, "white references used", ""),
        (shift, moved, "movement of the chart", "px"),
    ):
        axes.plot(count, values, ".", color=INK, markersize=3)
        axes.set(title=title, ylabel=unit, xlabel="frame")
    middle = float(np.median(level)) if len(level) else 0.0
    black.set_ylim(middle - max(1.0, float(np.ptp(level))), middle + max(1.0, float(np.ptp(level))))
    _ring_largest(blur, blurs, table)
    used.set_ylim(0, 1.15 * max(counts, default=1))
    _ring_largest(used, counts, table, least=True)
    shift.axhline(STILL_PX, color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    shift.set_ylim(0, max(0.12, 1.1 * max(moved, default=0)))
    _ring_largest(shift, moved, table)
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
    _draw_consistency(consistency, count, table)


def _draw_consistency(axes: Any, count: npt.NDArray[np.integer], table: TableMeasurements) -> None:
    axes.set(title="cells off their codes' colours", ylabel="%", xlabel="frame")
    if not has_enough_cells(len(table.registration.mismatched_cells)):
        axes.text(0.5, 0.5, "too few colours to compare", ha="center", va="center", transform=axes.transAxes)
        return
    scatter = [100 * frame.consistency.scatter for frame in table.frames]
    block = [100 * frame.consistency.block for frame in table.frames]
    axes.plot(count, scatter, ".", color=INK, markersize=3, label="scatter of all cells")
    axes.plot(count, block, "x", color=MARK, markersize=3, label="worst block of cells")
    axes.legend(frameon=False, fontsize=7, loc="upper right")
    axes.set_ylim(bottom=0, top=max(1.5, 1.3 * axes.get_ylim()[1]))
    _ring_largest(axes, scatter, table)
    _ring_largest(axes, block, table)


_LEAST_LEVEL = 1.0  # Counts from which on a level is drawn: the axes are logarithmic

# Of the errors of places, where the scale ends: the outermost cells are known much worse than all others.
_SHOWN_PERCENTILE = 99.0

_Image = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]


def draw_errors(figure: Any, table: TableMeasurements, chart: Chart) -> None:
    """Draw how far cells are off their codes' colours, and how well their places are known, over the print.

    The worst cell of each is ringed. Where the first is not known, on small charts, it is left empty and says so.
    """
    page_w, page_h = chart.page_mm
    figure.set_size_inches(10, 0.2 + 4.6 * page_h / page_w)
    left, right = figure.subplots(1, 2)
    side_mm = float(np.mean(chart.cell_mm))
    stains = table.cells.stains
    if stains.known:
        off = 100 * stains.largest_deviation()
        places = chart.centres_mm[chart.cell_of_colour]
        limit = max(1.0, float(np.abs(off).max()))
        image = draw_squares(left, chart.page_mm, places, side_mm, off, 4.1, cmap="RdBu", vmin=-limit, vmax=limit)
        figure.colorbar(image, ax=left, label="%, brighter is positive", shrink=0.8)
        _mark(left, places[int(np.argmax(np.abs(off)))])
    else:
        left.text(0.5, 0.5, "too few colours to compare", ha="center", va="center", transform=left.transAxes)
    error = table.registration.uncertainty_px(chart.centres_mm)
    most = max(float(np.percentile(error, _SHOWN_PERCENTILE)), 1e-3)
    image = draw_squares(right, chart.page_mm, chart.centres_mm, side_mm, error, 4.1, cmap="cividis", vmin=0, vmax=most)
    figure.colorbar(image, ax=right, label="half-size px", shrink=0.8, extend="max")
    _mark(right, chart.centres_mm[int(np.argmax(error))])
    left.set(title="colour of cells against their codes", ylabel="mm")
    right.set(title="standard error of cells' places")
    for axes in (left, right):
        axes.set(xlabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal", facecolor="#f2f3f5")


def _mark(axes: Any, place_mm: _Array) -> None:
    axes.plot(*place_mm, "o", markersize=13, markerfacecolor="none", markeredgecolor="white", markeredgewidth=2.6)
    axes.plot(*place_mm, "o", markersize=13, markerfacecolor="none", markeredgecolor=MARK, markeredgewidth=1.4)


def cell_noise(picture: _Image, chart: Chart, registration: Registration, window: int) -> tuple[_Array, _Array]:
    """Return mean and variance of the samples of each cell that is in the frame, both (N, 3) float64.

    `picture`: (H, W, 3) float32 counts above black, the frame at half size.
    """
    samples = _samples(picture, registration.to_pixels(chart.centres_mm), window)[1].astype(np.float64)
    return samples.mean(axis=1), samples.var(axis=1, ddof=1)


def _samples(picture: _Image, places: _Array, window: int) -> tuple[npt.NDArray[np.intp], _Image]:
    """Return which cells at places (N, 2) lie in the frame, (M,), and their samples (M, window², 3)."""
    height, width = picture.shape[:2]
    sites = sites_at(places, (height, width), window)
    offsets = np.arange(window) - window // 2
    at = np.flatnonzero(sites.inside)
    samples = picture[sites.rows[at, None, None] + offsets[:, None], sites.columns[at, None, None] + offsets]
    return at, samples.reshape(len(at), window**2, 3)


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
        if lit.sum() < _LEAST_LEVELS:
            name = f"{'RGB'[channel]}: too few levels for the camera's gain"
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


_LEAST_LEVELS = 6  # Levels from which on the curve's three parameters are told as the camera's (chosen: twice as many)

# Radius of a circle at least, as a share of the page's width: one about a single cell is not seen in a thumbnail.
_LEAST_CIRCLE = 0.012

LabelledPlace = tuple[str, PrintPlace]  # What is said of a place, in few words, and the place


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
            # Of a circle that reaches beyond the frame the number stands at what is seen of it.
            seen = ring[((ring > (0.02 * width, 0.03 * height)) & (ring < (width, height))).all(axis=1)]
            corners = seen if len(seen) else ring
            x, y = corners[np.argmin(corners.sum(axis=1))]
            box = {"facecolor": MARK, "edgecolor": "white", "boxstyle": "round,pad=0.25"}
            axes.text(x, y, ", ".join(map(str, here)), color="white", weight="bold", ha="right", va="bottom", bbox=box)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    below.axis("off")
    for row, (label, number) in enumerate(numbers.items()):
        below.text(0.01, 1 - (row + 0.5) / len(numbers), f"{number}   {label}", va="center", transform=below.transAxes)


def half_size(mosaic: Mosaic) -> npt.NDArray[np.float32]:
    """Return a frame as linear RGB, (H // 2, W // 2, 3) float32 counts above black; noise makes some negative.

    An odd last row or column is dropped.
    """
    black = frame_black(mosaic)
    blocks = mosaic.block_planes()
    image = np.empty((*blocks.shape[2:], 3), dtype=np.float32)
    for column, channel in enumerate(CHANNELS):
        places = phases(mosaic)[channel]
        image[..., column] = sum(blocks[place] - np.float32(black[place]) for place in places) / np.float32(len(places))
    return image
