"""The report of a run: summary, how the data were treated, error curves, the chromaticity plane, and images.

Images are shown as recorded, corrected by the estimate, and by the truth: made small, white balanced, with the curve of
sRGB. No colour matrix is applied, so the colours are the camera's own: less saturated than a photograph, but a cast
shows as it would there. The exposure is the same for all pictures of an image.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from evaluation.metrics import ErrorKind, percentiles
from evaluation.reports.table_output import table_part
from evaluation.results.result import Result, Run
from evaluation.results.tables import Table, lights_tables, summary_table
from evaluation.scene import MixedScene, Scene
from foundation import pages
from foundation.colorimetry import srgb_codes
from foundation.errors import counted
from foundation.plots import FAINT, legend_label, series_style, svg_of

# Percentile of all methods' errors at which the axis of errors ends: a few wild ones would squeeze the others.
_SHOWN_PERCENTILE = 98

_STEPS = 300  # Points of a curve: as many as a column of a page has pixels, whatever the number of images

_PANELS = 12  # Methods that get a panel of their own: more are too small to be read

_COLUMNS = 3  # Panels beside each other: what a page of 1100 px has room for

# Points that are drawn one by one; more become a picture, for a page of millions of circles opens slowly.
_VECTORS = 3000

_BRIGHTEST_PERCENTILE = 95  # Percentile of all methods' errors at which the scale of colours ends


def error_curves(results: Sequence[Result], kind: ErrorKind) -> bytes:
    """Return the cumulative error curves of methods as SVG: the share of images up to each error."""
    rows = math.ceil(len(results) / 2)
    return svg_of(_draw_curves, results, kind, inches=(8.6, 3.9 + 0.19 * rows))


def _draw_curves(figure: Any, results: Sequence[Result], kind: ErrorKind) -> None:
    axes = figure.subplots()
    every = np.concatenate([result.errors[kind] for result in results])
    end = max(float(percentiles(every, (_SHOWN_PERCENTILE,))[0]), 1e-3)
    for number, result in enumerate(results):
        errors = np.sort(result.errors[kind])
        shares = np.linspace(0, 100, min(len(errors), _STEPS) + 1)
        # The k-th of n sorted errors is reached by k of n images.
        places = np.ceil(shares / 100 * len(errors)).astype(int) - 1
        reached = np.where(places < 0, 0.0, errors[np.maximum(places, 0)])
        axes.plot(reached, shares, label=legend_label(result.method), linewidth=1.6, **series_style(number))
    axes.set(xlim=(0, end), ylim=(0, 100), xlabel=f"{kind} angular error, degrees", ylabel="images up to it, %")
    figure.legend(loc="outside lower left", ncols=2, handlelength=3)


def error_planes(results: Sequence[Result], truths: npt.NDArray[np.float64], kind: ErrorKind) -> bytes:
    """Return the errors over the chromaticity plane as SVG: a panel a method, the first twelve of them.

    `truths`: (N, 3) float64, the true lights, camera RGB of any length.
    """
    shown = results[:_PANELS]
    columns = _columns(len(shown))
    wide, high = (4.6, 3.6) if len(shown) == 1 else (8.6, 0.7 + (7.8 / columns) * math.ceil(len(shown) / columns))
    return svg_of(_draw_planes, shown, truths, kind, inches=(wide, high))


def _columns(panels: int) -> int:
    """Return how many panels stand beside each other: two pairs look better than three and one."""
    return 2 if panels == 4 else min(_COLUMNS, panels)


def _draw_planes(figure: Any, results: Sequence[Result], truths: npt.NDArray[np.float64], kind: ErrorKind) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    shares = truths / truths.sum(axis=1, keepdims=True)
    every = np.concatenate([result.errors[kind] for result in results])
    top = max(float(percentiles(every, (_BRIGHTEST_PERCENTILE,))[0]), 1e-3)
    # Neither end of the scale may vanish, on a light page or on a dark one.
    colours = ListedColormap(colormaps["viridis"](np.linspace(0.15, 0.92, 256)))
    columns = _columns(len(results))
    grid = figure.subplots(math.ceil(len(results) / columns), columns, squeeze=False, sharex=True, sharey=True)
    drawn = None
    for axes, result in zip(grid.flat, results, strict=False):
        errors = result.errors[kind]
        order = np.argsort(errors, kind="stable")  # The largest errors lie on top.
        drawn = axes.scatter(
            shares[order, 0],
            shares[order, 2],
            c=errors[order],
            s=9,
            cmap=colours,
            vmin=0,
            vmax=top,
            linewidths=0,
            rasterized=len(errors) * len(results) > _VECTORS,
        )
        axes.set_title(result.method, fontsize=8.5)
    panels = list(grid.flat)
    for axes in panels[len(results) :]:
        axes.remove()
    for axes in panels[len(results) - columns : len(results)]:
        # The lowest panel of each column has the labels, also above an empty place.
        axes.tick_params(labelbottom=True)
    figure.supxlabel("r = R / (R + G + B) of the true light", fontsize=9)
    figure.supylabel("b = B / (R + G + B)", fontsize=9)
    bar = figure.colorbar(drawn, ax=panels[: len(results)], extend="max", label=f"{kind} error, degrees", shrink=0.8)
    bar.outline.set_edgecolor(FAINT)


_HEIGHT = 170  # Pixels of a picture's height: three beside each other fill half a page

_WIDEST = 300  # Pixels of a picture's width at most: a panorama would make the others tiny

# Percentile of the brightest channel, under the true light, that becomes white: what is above are highlights.
_WHITE_PERCENTILE = 98.0

_GAP = 6  # Pixels between pictures, white on every screen

_MASKED = 0.18  # Linear grey that stands for masked pixels: the middle of a display's range

_HALF = 0.5  # Share of a small pixel that is masked above which it is drawn as masked

# Of the JPEG files: traces of compression are not seen, and a page of a hundred pictures stays below 2 MB.
_QUALITY = 88

_LEAST_GAIN = 1e-6  # Share of the green channel that replaces a light's channel at zero, which cannot be divided by


def developed(scene: Scene, estimates: Sequence[npt.NDArray[np.float64]]) -> list[bytes]:
    """Return a JPEG file for each estimate: the scene as recorded, corrected by the estimate, and by the truth.

    `estimates`: (3,) float64 each, camera RGB of any length.
    """
    image, mask = scene.read()
    linear = image.astype(np.float32)
    if mask is not None:
        # What is masked must not shine into its neighbours when the image is resized, nor set the exposure.
        linear[mask] = 0
    small = _resized(linear)
    truth: npt.NDArray[Any] = scene.truth
    if isinstance(scene, MixedScene):
        field = scene.read_truth_map()
        truth = _resized(np.where(np.isfinite(field), field, np.float32(scene.truth / scene.truth.sum())))
    covered = None if mask is None else _resized(mask.astype(np.float32)) > _HALF
    free = small * _gains(truth)
    free = free.reshape(-1, 3) if covered is None else free[~covered]
    white = float(np.percentile(free.max(axis=1), _WHITE_PERCENTILE)) if len(free) else 0.0

    def seen(light: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        lit = small * _gains(light) / np.float32(white or 1.0)
        if covered is not None:
            lit[covered] = _MASKED
        return srgb_codes(lit)

    raw, right = seen(np.ones(3)), seen(truth)
    gap = np.full((len(small), _GAP, 3), 255, np.uint8)
    return [_jpeg(np.hstack([raw, gap, seen(light), gap, right])) for light in estimates]


def _jpeg(picture: npt.NDArray[np.uint8]) -> bytes:
    import cv2

    codes = np.ascontiguousarray(picture[..., ::-1])
    _, encoded = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return encoded.tobytes()


def _gains(light: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return what corrects for a light (..., 3) and leaves green as it is."""
    given = np.asarray(light, dtype=np.float64)
    floored = np.maximum(given, _LEAST_GAIN * given.max(axis=-1, keepdims=True))
    return (floored[..., 1:2] / floored).astype(np.float32)


def _resized(array: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    import cv2

    height, width = array.shape[:2]
    scale = min(_HEIGHT / height, _WIDEST / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(array, size, interpolation=way), dtype=np.float32)


WORST, MIDDLE = 3, 2  # Images shown of each method: its largest errors, and those nearest to its median

MOST_SHOWN = 12  # Methods of which images are shown: with more the page would be too large to be mailed

_DEFINITIONS = (
    "Recovery error: angle between estimated and true light. Reproduction error: angle between white and a white "
    "surface after correction. Tri.: (Q1 + 2 Q2 + Q3) / 4. Best and worst 25%: mean of the errors up to the 25th and "
    "from the 75th percentile. Avg.: geometric mean of mean, median, trimean, best and worst 25%. Percentiles as "
    "MATLAB's prctile (Hazen)."
)


def chosen_images(result: Result, kind: ErrorKind) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the numbers of the images with the largest errors, and of those nearest to the median.

    Examples
    --------
    >>> errors = {"recovery": np.array([4.0, 1, 3, 2, 9, 8, 7])}
    >>> chosen_images(Result("M", np.ones((7, 3)), errors, np.zeros(7, bool)), "recovery")
    ((4, 5, 6), (0, 2))
    """
    errors = result.errors[kind]
    worst = tuple(int(number) for number in np.argsort(-errors, kind="stable")[:WORST])
    # Of an even number of images the two in the middle are equally far, and rounding must not choose between them.
    nearest = np.argsort(np.round(np.abs(errors - np.median(errors)), 9), kind="stable")
    return worst, tuple([int(number) for number in nearest if int(number) not in worst][:MIDDLE])


def run_page(run: Run, kind: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> str:
    """Return the text of `report.html`."""
    kinds: tuple[ErrorKind, ErrorKind] = ("reproduction", "recovery")
    ordered = kinds if kind == "reproduction" else kinds[::-1]
    tables = [summary_table(run.subject, run.results, each, with_further=True) for each in ordered]
    # What is said of images without a light holds for both tables.
    tables[1] = Table(tables[1].title, tables[1].columns, tables[1].rows)
    parts = [
        pages.paragraph(
            f"{counted(len(run.subject.images), 'image')}, read from {run.location} (layout {run.layout})."
        ),
        *map(pages.paragraph, run.notes),
        *map(table_part, tables),
        *map(table_part, lights_tables(run.subject, run.results, kind)),
        pages.note(_DEFINITIONS),
        pages.heading("What was done to the images"),
        table_part(Table("Applied before a method sees an image", ("What", "How"), tuple(run.treatment.items()))),
        pages.heading("Cumulative error curves"),
        pages.figure(
            error_curves(run.results, kind),
            f"The share of images whose {kind} error is not larger than the value below; the higher, the better. The "
            f"axis ends at the 98th percentile of {'all methods together' if len(run.results) > 1 else 'the errors'}.",
            "Cumulative error curves",
        ),
        pages.heading("Errors over the chromaticity plane"),
        pages.figure(
            error_planes(run.results, run.truths, kind),
            "Each point is the true light of an image; its colour is the method's error on it."
            + _left_out(run.results),
            "Errors over chromaticities",
        ),
        *_images(run, kind, pictures),
        pages.heading("Methods"),
        table_part(Table("As they were run", ("Method", "Class", "Settings"), tuple(map(_method, run.methods)))),
        pages.note(f"Data set {run.data_sha256[:16]}…, {run.software}"),
    ]
    return pages.page(f"{run.subject.name}: {len(run.results)} method{'s' * (len(run.results) > 1)}", parts)


def _left_out(results: Sequence[Result]) -> str:
    """Return the sentence on the methods after the first `MOST_SHOWN`, of which nothing is shown."""
    names = [result.method for result in results[MOST_SHOWN:]]
    return f" Shown are the first {MOST_SHOWN} of {len(results)} methods, without {', '.join(names)}." if names else ""


def _images(run: Run, kind: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> list[Markup]:
    if not pictures:
        return []
    found = [
        pages.heading("Images"),
        pages.paragraph(
            "From left to right: as recorded, corrected by the estimate, corrected by the truth. Linear camera RGB "
            "without a colour matrix, the same exposure in each row, the curve of sRGB; masked pixels are grey."
            + _left_out(run.results)
        ),
    ]
    for number, result in enumerate(run.results[:MOST_SHOWN]):
        worst, middle = chosen_images(result, kind)
        rows = [
            part
            for title, places in (("Largest errors", worst), ("Nearest to the median", middle))
            if places
            for part in (
                pages.heading(title, 3),
                pages.row([_image(run, number, place, kind, pictures) for place in places]),
            )
        ]
        found.append(pages.fold(result.method, rows, open_at_first=number == 0))
    return found


def _image(run: Run, number: int, place: int, kind: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> Markup:
    result, image = run.results[number], run.subject.images[place]
    cause = (result.causes or {}).get(place, "")
    words = [f"{image}: {result.errors[kind][place]:.2f}°"]
    if result.guessed[place]:
        words.append(f"{cause or 'no light'}: taken as grey")
    if run.subject.mixed[place]:
        words.append("several lights: one estimate for the whole image, the truth by pixel")
    return pages.figure(pictures[number, place], "; ".join(words), f"{image} as recorded, by {result.method}, by truth")


def _method(method: Mapping[str, Any]) -> tuple[str, str, str]:
    settings: Mapping[str, Any] = method.get("settings", method.get("estimates", {}))
    told = ", ".join(f"{name} {_short(value)}" for name, value in settings.items())
    return str(method.get("name", "")), str(method.get("class", "estimates of another program")), told


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
