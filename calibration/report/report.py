"""The table's report: one page that shows by eye what the figures claim, and the same figures for programs.

`report.json` holds figures, limits and verdict. `report.html` opens with the verdict and holds everything: its figures
are embedded, so it can be mailed. What it shows: the registered grid over the frame, what the tags and cells still ask
for, the shape of the light, the lights as planned and as the camera saw them (the paper's three figures of
chromaticities), the course of the session, and the worst cells as pictures.

Matplotlib is imported where figures are made, and through its objects only: no window, no state left behind.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from acquisition.chart.model import Chart
from acquisition.session.folder import Session
from calibration.checks.likeness import can_tell
from calibration.checks.stains import Stains
from calibration.pipeline.result import BuildResult
from calibration.radiometry.paper import MAX_BLACK_DRIFT
from calibration.registration.register import Registration
from calibration.report.mosaic import half_size
from calibration.sampling.samples import noise_of, rim_against_middle, sites_at
from calibration.verdict.verdict import Judged, Verdict, bleed, grey_tints_deg, largest_window, report_json, shown
from drivers.raw.rawfile import read_raw
from foundation.files import write_whole
from foundation.srgb import decode_srgb

NAME = "report.html"
JSON_NAME = "report.json"
_WORST = 20
_DPI = 110
_INK, _FAINT, _MARK = "#22262b", "#8a929c", "#e8502a"
_CHANNEL_INK = ("#c8382e", "#2f8f46", "#2f62c8")

_Image = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]


def write_report(result: BuildResult, session: Session, folder: Path) -> None:
    """Write `report.html` and `report.json` into a table's folder; costs some seconds.

    Parameters
    ----------
    result
        What the build found.
    session
        The session; the frame that was registered is read again for its pictures.
    folder
        Where the page is written.
    """
    chart = session.chart
    picture = half_size(read_raw(session.folder / result.registered_file))
    lights = np.array([[light.colour.red, light.colour.green, light.colour.blue] for light in session.illuminations])
    black_body = np.array([light.kind == "blackbody" for light in session.illuminations], dtype=np.bool_)
    seen = f"seen by the {result.camera}"
    figures = [
        (
            "The chart as registered",
            _grid_caption(result),
            _drawn(_grid, picture, chart, result.registration, result.window),
        ),
        (
            "What the registration leaves",
            "Left: how far the cells moved the map from what the tags and the lens alone say, which is the paper's "
            "waviness. Right: what each block of cells would still ask for, magnified; a healthy registration shows "
            "short arrows without order.",
            _drawn(_residuals, chart, result.registration),
        ),
        (
            "The light on the print",
            "Shape of the light under the frame that was registered, from its white references; it is divided out of "
            f"samples and ground truth. Each contour is 2 %. {_primaries_told(result)}",
            _drawn(_field, chart, result),
        ),
        *_print_drawn(chart, result.stains),
        (
            "The lights",
            "rb-chromaticities of the lights as projected, as the camera sees them on bare paper (the ground truth), "
            "and the latter in their colours. Rings are black bodies.",
            _drawn(_chromaticities, lights, black_body, result.white, seen),
        ),
        (
            "The course of the session",
            "Black level, movement of the chart, bare paper under white, and how far cells are off what their codes "
            "give under each light, frame by frame: all of them where the focus goes, part of the print where a hand "
            "or a shadow lies on it.",
            _drawn(_course, result),
        ),
        (
            "The worst cells",
            f"The {_WORST} cells whose rim and middle differ most under white, in standard deviations, each between "
            "its neighbours; the frame is the samples.",
            _drawn(_worst, picture, chart, result.registration, result.window),
        ),
    ]
    write_whole(folder / NAME, _page(result, figures))
    write_whole(folder / JSON_NAME, json.dumps(report_json(result), indent=2) + "\n")


def _page(result: BuildResult, figures: Sequence[tuple[str, str, bytes]]) -> str:
    title = f"Table of {result.lights} lights, {result.camera}"
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td><td class='note'>{html.escape(note)}</td></tr>"
        for name, value, note in summary(result)
    )
    unfit = "".join(f"<tr><td>{cell.colour}</td><td>{html.escape(cell.cause)}</td></tr>" for cell in result.unfit[:200])
    more = f"<p>and {len(result.unfit) - 200} more in lut.json</p>" if len(result.unfit) > 200 else ""
    cells = (
        f"<h2>Cells unfit for use</h2><table><tr><th>colour</th><th>cause</th></tr>{unfit}</table>{more}"
        if result.unfit
        else "<h2>Cells unfit for use</h2><p>None.</p>"
    )
    pictures = "".join(
        f"<figure><h2>{html.escape(heading)}</h2><img alt='{html.escape(heading)}' "
        f"src='data:image/png;base64,{base64.b64encode(png).decode()}'><figcaption>{html.escape(caption)}"
        "</figcaption></figure>"
        for heading, caption, png in figures
    )
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title><style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: {_INK}; max-width: 1100px; margin: 2rem auto; padding: 0 1rem }}
h1 {{ font-size: 1.6rem; margin-bottom: .2rem }} h2 {{ font-size: 1.15rem; margin: 2.2rem 0 .6rem }}
table {{ border-collapse: collapse; font-size: .95rem }} th {{ text-align: left; font-weight: 600 }}
td, th {{ padding: .25rem 1.2rem .25rem 0; border-bottom: 1px solid #e3e6ea; vertical-align: top }}
td {{ font-variant-numeric: tabular-nums }} .note, figcaption {{ color: #5b636d; font-size: .9rem }}
.verdict {{ font-size: 1.15rem; font-weight: 600; padding: .5rem .8rem; margin: 1rem 0; border-left: 6px solid }}
.accept {{ border-color: #2f8f46 }} .remark {{ border-color: #d9a400 }} .refuse {{ border-color: #c8382e }}
td.accept, td.remark, td.refuse {{
  border-color: #e3e6ea; border-left: 4px solid; padding-left: .6rem; white-space: nowrap }}
td.accept {{ border-left-color: #2f8f46 }} td.remark {{ border-left-color: #d9a400 }}
td.refuse {{ border-left-color: #c8382e; font-weight: 600 }}
td.number {{ white-space: nowrap }} figure {{ margin: 0 }} img {{ max-width: 100%; height: auto }}
</style></head><body>
<h1>{html.escape(title)}</h1><p class="note">Session {html.escape(result.session.name)}</p>
{_verdict(result.verdict)}<h2>Figures</h2><table>{rows}</table>{pictures}{cells}</body></html>
"""


_CLASSES = {"accept": "accept", "accept with remarks": "remark", "refuse": "refuse"}


def _verdict(verdict: Verdict) -> str:
    """Return the verdict and its table, the worst rows first."""
    order = ("refuse", "accept with remarks", "accept")
    rows = "".join(_judged(row) for row in sorted(verdict.rows, key=lambda row: order.index(row.outcome)))
    said = {
        "accept": "Accepted: every figure is within its limit.",
        "accept with remarks": f"Accepted with remarks: {len(verdict.remarks)} of {len(verdict.rows)} figures.",
        "refuse": f"Refused: {len(verdict.refused)} of {len(verdict.rows)} figures are beyond what can be used.",
    }[verdict.outcome]
    return (
        f"<p class='verdict {_CLASSES[verdict.outcome]}'>{said}</p><table><tr><th></th><th>figure</th><th>measured</th>"
        f"<th>accepted</th><th>refused beyond</th><th>why</th></tr>{rows}</table>"
    )


def _judged(row: Judged) -> str:
    limit, name = row.threshold, _CLASSES[row.outcome]
    refuse = "" if limit.refuse is None else shown(limit.refuse, limit.unit)
    remedy = f". <b>{html.escape(limit.remedy)}</b>" if row.outcome != "accept" and limit.remedy else ""
    return (
        f"<tr><td class='{name}'>{name}</td><th>{html.escape(limit.title)}</th>"
        f"<td class='number'>{html.escape(shown(row.value, limit.unit))}</td>"
        f"<td class='number note'>{limit.sense} {html.escape(shown(limit.accept, limit.unit))}</td>"
        f"<td class='number note'>{html.escape(refuse)}</td>"
        f"<td class='note' title='{html.escape(limit.source, quote=True)}'>{html.escape(limit.why)}{remedy}</td></tr>"
    )


def summary(result: BuildResult) -> list[tuple[str, str, str]]:
    """Return the figures that say how good a table is: name, value, what is usual."""
    registration = result.registration
    tags = len(registration.framing.tags)
    plain = registration.framing.field is not None
    found = "the chart has none" if plain else f"{tags} of {tags + len(registration.framing.missing)}"
    share = result.white_error / np.maximum(result.white, 1e-9)
    brightest = result.white.max(axis=1) if len(result.white) else np.zeros(1)
    black = np.mean([figures.black for figures in result.frames], axis=0)
    return [
        ("Lights", str(result.lights), "every one with an accepted frame"),
        ("Frame registered", result.registered_file, ""),
        ("Tags found", found, ""),
        ("Cell", f"{registration.cell_px:.1f} px", "at least 8 for 25 pixels inside it"),
        ("Window", f"{result.window}×{result.window} samples", _window_note(result)),
        ("Blur", f"σ {registration.blur_px:.2f} px", "about 0.6 is sharp"),
        (
            "Outline of the field" if plain else "Tags' corners",
            f"{registration.marks_rms_px:.3f} px RMS",
            "across, against the final map" if plain else "0.09 is the detector's own error",
        ),
        (
            "Waviness",
            f"{registration.lens_residual_px:.2f} px RMS",
            f"of the {'outline' if plain else 'tags'} against a plane seen through a lens",
        ),
        ("Blocks of cells", f"{registration.block_rms_px:.3f} px RMS", "movement they still ask for"),
        ("Colours agree", f"{registration.agreement:.4f}", "correlation of cells and chart; another chart has about 0"),
        *_course_told(result),
        ("Black level", f"{black.mean():.2f} counts", f"drift {result.black_drift:.2f}, {MAX_BLACK_DRIFT:g} is usual"),
        ("Saturation", f"{result.white_level} in the table", f"bare paper reaches {brightest.max():.0f}"),
        ("Darkest light", f"{brightest.min():.0f}", "its strongest channel on bare paper"),
        ("Ground truth", f"± {np.median(share):.2%} a channel, median", "standard error of the mean of the references"),
        (
            "Noise of a sample",
            " / ".join(f"{value:.2%}" for value in result.noise.tolist()),
            "R, G, B, of paper under white",
        ),
        ("Linearity", *_linearity(result)),
        *_light_figures(result),
        ("Cells unfit", str(len(result.unfit)), "listed in lut.json, never filled"),
    ]


def _course_told(result: BuildResult) -> list[tuple[str, str, str]]:
    """Return how chart and lamp changed from frame to frame; a frame alone, as a check reads, tells neither."""
    told: list[tuple[str, str, str]] = []
    if len(result.frames) > 1:
        anew = sum(figures.registered for figures in result.frames)
        told.append(("Chart moved", f"{result.largest_shift_px:.3f} px at most", f"{anew} frames registered anew"))
    if sum(figures.record.kind == "white" for figures in result.frames) > 1:
        told.append(("White drift", f"{result.white_drift:.2%}", "between white frames; at most 1 % is usual"))
    return told


def _percents(values: npt.NDArray[np.floating]) -> str:
    return " / ".join(f"{value:.2%}" for value in values.tolist())


def _light_figures(result: BuildResult) -> list[tuple[str, str, str]]:
    """Return what dark frames, primaries, greys and noise say."""
    told: list[tuple[str, str, str]] = []
    if len(result.at_zero):
        worst = int(np.argmax(result.at_zero))
        told.append(
            (
                "Samples at 0",
                f"{result.at_zero.mean():.3%}, {result.at_zero[worst]:.2%} under light {worst}",
                "no light within the noise; what was below is cut, and the mean of such cells a little high",
            )
        )
    white = [figures.paper.white for figures in result.frames if figures.record.kind == "white"]
    dark = result.darkness
    if dark.files and white:
        counts = " / ".join(f"{value:.2f}" for value in dark.light.tolist())
        share = _percents(dark.light / np.mean(white, axis=0))
        told.append(
            (
                "Light while black is shown",
                f"{counts} counts, {share} of white",
                f"leak and ambient light on bare paper, {len(dark.files)} dark frames; "
                + ("not subtracted" if result.subtracted is None else "subtracted from samples and ground truth"),
            )
        )
    if result.off_codes_deg is not None:
        worst = int(np.argmax(result.off_codes_deg))
        told.append(
            (
                "Lights and their codes",
                f"{result.off_codes_deg[worst]:.2f}° at most, light {worst}",
                "angle of a white from what its codes give by a smooth model through all lights, beyond four standard "
                "errors",
            )
        )
    if result.added is not None:
        told.append(("Red + green + blue − white", _percents(result.added), "of white; 0 where light adds"))
    tints = zip(result.grey_names, grey_tints_deg(result).tolist(), strict=True)
    if result.grey_names:
        shown_tints = ", ".join(f"{name}: {angle:.2f}°" for name, angle in tints)
        told.append(("Tint of the greys", shown_tints, "angle to bare paper's camera RGB; 0 is a neutral print"))
    if result.transfer is not None:
        transfer = result.transfer
        gain = " / ".join(f"{value:.2f}" for value in transfer.gain_e.tolist())
        read = " / ".join(f"{value:.1f}" for value in transfer.read_noise.tolist())
        told.append(
            (
                "Photon transfer",
                f"{gain} e⁻ a count, {read} counts of read noise",
                f"R, G, B of half-size pixels; {int(transfer.noisy.sum())} cells noisier than the curve",
            )
        )
    measured = "measured" if result.saturated else "as the raw files state it; no photosite reached it"
    told.append(("Saturation's source", measured, "a statement may be too high; samples do not suffer"))
    return told


def _linearity(result: BuildResult) -> tuple[str, str]:
    """Return what the series of exposures said."""
    if result.linearity is None:
        return "not measured", "a series of exposures of the chart, given with --linearity, tells"
    low, high = result.linearity.covered
    return (
        f"{result.linearity.worst:.2%} off a line at most",
        f"{len(result.linearity.files)} exposures, {low:.0%} to {high:.0%} of saturation; 1 % is usual",
    )


def _window_note(result: BuildResult) -> str:
    """Return what windows the cells allow."""
    registration = result.registration
    largest = largest_window(registration.cell_px, registration.blur_px)
    share = bleed(registration.cell_px, registration.blur_px, result.window)
    if result.window > largest:
        allowed = f"{largest}×{largest} would stay below" if largest else "no window stays below"
        return f"larger than these cells allow: {share:.2g} of the worst sample's light is from beyond; {allowed} 0.2 %"
    return f"up to {largest}×{largest} at most 0.2 % of a sample's light is from beyond its cell"


def _grid_caption(result: BuildResult) -> str:
    return (
        f"{result.registered_file}, contrast stretched, with the tags as found; below, magnified: the outline of "
        f"every cell and the pixels of its {result.window**2} samples, in the corners and in the middle."
    )


def _drawn(draw: Callable[..., Any], *arguments: Any) -> bytes:
    """Return the PNG of a figure that `draw(figure, …)` fills."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Matplotlib's own types leave the keyword arguments of every method unknown.
    style: Any = {
        "font.size": 9,
        "axes.edgecolor": _FAINT,
        "axes.labelcolor": _INK,
        "xtick.color": _INK,
        "ytick.color": _INK,
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


def _stretched(picture: _Image) -> _Image:
    """Return an image for the eye, 0 … 1: each channel to its paper white, sRGB's curve roughly."""
    white = np.maximum(np.percentile(picture[::4, ::4].reshape(-1, 3), 99.5, axis=0), 1)
    return np.clip(picture / white, 0, 1).astype(np.float32) ** np.float32(1 / 2.2)


def _grid(figure: Any, picture: _Image, chart: Chart, registration: Registration, window: int) -> None:
    height, width = picture.shape[:2]
    figure.set_size_inches(10, 10 * height / width + 2.4)
    whole, crops = figure.subfigures(2, 1, height_ratios=(10 * height / width, 2.4))
    shown = _stretched(picture)
    step = max(1, width // 1400)
    axes = whole.subplots()
    axes.imshow(shown[::step, ::step], extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="antialiased")
    for tag in registration.framing.tags:
        outline = np.vstack([tag.corners_px, tag.corners_px[:1]])
        axes.plot(outline[:, 0], outline[:, 1], color=_MARK, linewidth=1.4)
    page_w, page_h = chart.page_mm
    for line in _page_lines(chart):
        places = registration.to_pixels(line)
        axes.plot(places[:, 0], places[:, 1], color="white", linewidth=0.5, alpha=0.75)
    edge = registration.lens.to_pixels([(0, 0), (page_w, 0), (page_w, page_h), (0, page_h), (0, 0)])
    axes.plot(edge[:, 0], edge[:, 1], color=_MARK, linewidth=0.8, linestyle=(0, (4, 3)))
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
            x + half * np.array([-1, 1, 1, -1, -1]), y + half * np.array([-1, -1, 1, 1, -1]), color=_MARK, linewidth=0.8
        )
    axes.set(
        xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] + reach, middle[1] - reach), xticks=[], yticks=[]
    )


def _residuals(figure: Any, chart: Chart, registration: Registration) -> None:
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
        color=_INK,
        angles="uv",
        scale=20 * largest,
        width=0.0028,
    )
    right.quiverkey(arrows, 0.9, 1.04, largest, f"{largest:.3f} px", labelpos="W")
    right.plot(*blocks.centres_mm[~good].T, "x", color=_MARK, label="does not look like the chart")
    if (~good).any():
        right.legend(frameon=False, fontsize=8)
    right.set_title("blocks of cells, left over", loc="left")
    right.set(xlabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal")


def _primaries_told(result: BuildResult) -> str:
    if result.primaries is None:
        return "No frames of red, green and blue alone tell whether these light the print alike."
    return (
        f"Red, green and blue differ by up to {result.primaries.difference:.1%} in how they light it; what that is for "
        "each cell by its colour is divided out too."
    )


def _field(figure: Any, chart: Chart, result: BuildResult) -> None:
    figure.set_size_inches(10, 2.9)
    named = [figures for figures in result.frames if figures.record.file == result.registered_file]
    shape = (named or list(result.frames))[0].paper.field
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


def _print_drawn(chart: Chart, stains: Stains) -> list[tuple[str, str, bytes]]:
    """Return the picture of the print, or none where nothing can be told of it: a clean sheet would be a claim."""
    if not stains.tells:
        return []
    caption = (
        "How far cells and their surroundings are off what their codes give elsewhere on the sheet, in the channel "
        "that is off most. Noise is a fine grain of some tenths of a per cent; stains, folds and shadows have a "
        "shape. Crosses are cells listed for it."
    )
    return [("The print", caption, _drawn(_print, chart, stains))]


def _print(figure: Any, chart: Chart, stains: Stains) -> None:
    page_w, page_h = chart.page_mm
    figure.set_size_inches(10, 8.6 * page_h / page_w)
    axes = figure.subplots()
    places = chart.centres_mm[chart.cell_of_colour]
    # A marker's size is an area in points: of a cell, with the axes about 8.2 inches wide.
    side = 72 * 8.2 / page_w * float(np.mean(chart.cell_mm))
    image = axes.scatter(
        *places.T, c=100 * stains.largest(), s=side**2, marker="s", linewidths=0, cmap="RdBu", vmin=-3, vmax=3
    )
    axes.plot(*places[stains.stained].T, "x", color=_INK, markersize=max(3.0, 0.5 * side), markeredgewidth=0.8)
    axes.set(xlabel="mm", ylabel="mm", xlim=(0, page_w), ylim=(page_h, 0), aspect="equal")
    figure.colorbar(image, ax=axes, label="% off, brighter > 0", shrink=0.8, extend="both")


def _chromaticities(figure: Any, codes: _Array, black_body: npt.NDArray[np.bool_], white: _Array, seen: str) -> None:
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
        colour = np.clip(colour, 0, 1) ** (1 / 2.2)
        size = 14 if lit.sum() > 200 else 30
        plain: Any = colour if coloured else _INK
        axes.plot([0, 1, 0, 0], [0, 0, 1, 0], color="0.8", linewidth=0.8, zorder=1)
        axes.scatter(r[~body], b[~body], s=size, c=plain[~body] if coloured else plain, linewidths=0, zorder=2)
        axes.scatter(
            r[body],
            b[body],
            s=size,
            facecolors=colour[body] if coloured else "white",
            edgecolors=_MARK,
            linewidths=1.1,
            zorder=3,
        )
        axes.set(title=title, xlabel="r", aspect="equal", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    panels[0].set_ylabel("b")


def _course(figure: Any, result: BuildResult) -> None:
    figure.set_size_inches(10, 5)
    (black, shift), (white, like) = figure.subplots(2, 2)
    count = np.arange(len(result.frames))
    level = np.array([figures.black.mean() for figures in result.frames])
    black.plot(count, level, ".", color=_INK, markersize=3)
    black.set(title="black level", ylabel="counts", xlabel="frame")
    middle = float(np.median(level)) if len(level) else 0.0
    black.set_ylim(middle - max(1.0, float(np.ptp(level))), middle + max(1.0, float(np.ptp(level))))
    moved = [figures.shift.length_px for figures in result.frames]
    shift.plot(count, moved, ".", color=_INK, markersize=3)
    shift.axhline(0.1, color=_MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    shift.set(
        title="movement of the chart", ylabel="px", xlabel="frame", ylim=(0, max(0.12, 1.1 * max(moved, default=0)))
    )
    at = [number for number, figures in enumerate(result.frames) if figures.record.kind == "white"]
    whites = np.array([result.frames[number].paper.white for number in at]).reshape(-1, 3)
    if len(whites):
        for channel in range(3):
            white.plot(
                at,
                100 * (whites[:, channel] / whites[0, channel] - 1),
                ".-",
                color=_CHANNEL_INK[channel],
                label="RGB"[channel],
                linewidth=0.9,
            )
        white.legend(frameon=False, fontsize=8)
    white.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    white.set(title="bare paper under white", ylabel="% of the first", xlabel="frame")
    _draw_likeness(like, count, result)


def _draw_likeness(axes: Any, count: npt.NDArray[np.integer], result: BuildResult) -> None:
    axes.set(title="cells off what their codes give", ylabel="%", xlabel="frame")
    if not can_tell(len(result.registration.strangers)):
        axes.text(0.5, 0.5, "too few colours to tell", ha="center", va="center", transform=axes.transAxes)
        return
    axes.plot(
        count,
        [100 * figures.likeness.scatter for figures in result.frames],
        ".",
        color=_INK,
        markersize=3,
        label="all cells",
    )
    axes.plot(
        count,
        [100 * figures.likeness.block for figures in result.frames],
        "x",
        color=_MARK,
        markersize=3,
        label="worst part",
    )
    axes.legend(frameon=False, fontsize=8)
    axes.set_ylim(bottom=0, top=max(1.5, axes.get_ylim()[1]))


def _worst(figure: Any, picture: _Image, chart: Chart, registration: Registration, window: int) -> None:
    figure.set_size_inches(10, 3.1)
    height, width = picture.shape[:2]
    places = registration.to_pixels(chart.centres_mm)
    sites = sites_at(places, (height, width), window)
    offsets = np.arange(window) - window // 2
    at = np.flatnonzero(sites.inside)
    samples = picture[sites.rows[at, None, None] + offsets[:, None], sites.columns[at, None, None] + offsets]
    samples = samples.reshape(len(at), window**2, 3)
    difference, sigma = rim_against_middle(samples, noise_of(samples))
    score = (difference / np.maximum(sigma, 1e-6)).max(axis=1)
    shown = _stretched(picture)
    order = np.argsort(-score)[:_WORST]
    for axes, index in zip(figure.subplots(2, _WORST // 2).ravel(), order, strict=False):
        cell = int(at[index])
        _magnified(axes, shown, places[cell], 0.95 * registration.cell_px, chart, registration, places, window)
        red, green, blue = chart.rgb[cell]
        axes.set_title(f"{red} {green} {blue}\n{score[index]:.1f} σ", fontsize=8)
