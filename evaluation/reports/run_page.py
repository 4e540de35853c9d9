"""HTML report of a run: statistics, treatment of the data, error curves, chromaticities, and images.

Images are shown as recorded, corrected by the estimate, and corrected by the ground truth: reduced, white balanced,
with the sRGB curve and equal exposure. No colour matrix is applied, so colours are less saturated than in a photograph,
but a colour cast is visible.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, cast

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
from foundation.plots import FAINT, FigureForm, draw_svg, legend_label, series_style

# The axis of errors ends at this percentile of the errors of all methods, because outliers would compress the curves.
_AXIS_PERCENTILE = 98

_STEPS = 300  # Points of a curve: about one for each pixel of its width on the page

_MAX_PANELS = 12  # Largest number of methods with a panel; more panels would be too small to read

_MAX_COLUMNS = 3  # Panels in a row, for a page width of 1100 px

# Largest number of points drawn as vectors. More are drawn as a bitmap, because a page with millions of circles opens
# slowly.
_MAX_VECTOR_POINTS = 3000

_MIN_REACH = 0.01  # Smallest half range of an axis, used for data sets with one illuminant

_SCALE_PERCENTILE = 95  # The colour scale ends at this percentile of the errors of all methods


def error_curves(results: Sequence[Result], metric: ErrorKind, form: FigureForm = "page") -> bytes:
    """Return the cumulative error curves of methods: fraction of images up to each error."""
    rows = math.ceil(len(results) / 2)
    return draw_svg(_draw_curves, results, metric, inches=(8.6, 3.9 + 0.19 * rows), form=form)


def _draw_curves(figure: Any, results: Sequence[Result], metric: ErrorKind) -> None:
    axes = figure.subplots()
    all_errors = np.concatenate([result.errors[metric] for result in results])
    axis_end = max(float(percentiles(all_errors, (_AXIS_PERCENTILE,))[0]), 1e-3)
    for number, result in enumerate(results):
        errors = np.sort(result.errors[metric])
        shares = np.linspace(0, 100, min(len(errors), _STEPS) + 1)
        # The error of k of n images is at most the k-th of the n sorted errors.
        indices = np.ceil(shares / 100 * len(errors)).astype(int) - 1
        reached_errors = np.where(indices < 0, 0.0, errors[np.maximum(indices, 0)])
        axes.plot(reached_errors, shares, label=legend_label(result.method), linewidth=1.6, **series_style(number))
    axes.set(xlim=(0, axis_end), ylim=(0, 100), xlabel=f"x: {metric} angular error, degrees")
    axes.set_ylabel("share of images with error ≤ x, %")
    figure.legend(loc="outside lower left", ncols=2, handlelength=3)


def error_planes(
    results: Sequence[Result],
    truths: npt.NDArray[np.float64],
    metric: ErrorKind,
    black_bodies: Mapping[float, tuple[float, float, float]] = MappingProxyType({}),
    form: FigureForm = "page",
) -> bytes:
    """Return the errors over the chromaticity plane, one panel for each of the first twelve methods.

    `truths`: (N, 3) float64, ground truths, camera RGB of any scale. `black_bodies`: camera RGB by temperature, K.
    """
    drawn = results[:_MAX_PANELS]
    columns = _column_count(len(drawn))
    # Panels are squares, with a title above each.
    width, height = (
        (4.6, 3.9) if len(drawn) == 1 else (8.6, 0.5 + (7.0 / columns + 0.2) * math.ceil(len(drawn) / columns))
    )
    return draw_svg(_draw_planes, drawn, truths, metric, black_bodies, inches=(width, height), form=form)


def _column_count(panels: int) -> int:
    # Four panels in two rows of two look better than three and one.
    return 2 if panels == 4 else min(_MAX_COLUMNS, panels)


def _draw_planes(
    figure: Any,
    results: Sequence[Result],
    truths: npt.NDArray[np.float64],
    metric: ErrorKind,
    black_bodies: Mapping[float, tuple[float, float, float]],
) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    kelvins = sorted(black_bodies)
    colours = np.vstack([truths, *(black_bodies[kelvin] for kelvin in kelvins)])
    rb = (colours / colours.sum(axis=1, keepdims=True))[:, ::2]
    truth_rb, locus = rb[: len(truths)], rb[len(truths) :]
    # Both axes have the same scale, so that equal distances look equal.
    middle, reach = (rb.max(axis=0) + rb.min(axis=0)) / 2, max(0.6 * float(np.ptp(rb, axis=0).max()), _MIN_REACH)
    limits = np.stack([middle - reach, middle + reach])
    all_errors = np.concatenate([result.errors[metric] for result in results])
    scale_end = max(float(percentiles(all_errors, (_SCALE_PERCENTILE,))[0]), 1e-3)
    # Both ends of the colour scale must be visible on a light and on a dark page.
    colours = ListedColormap(colormaps["viridis"](np.linspace(0.15, 0.92, 256)))
    columns = _column_count(len(results))
    grid = figure.subplots(math.ceil(len(results) / columns), columns, squeeze=False, sharex=True, sharey=True)
    points = None
    for axes, result in zip(grid.flat, results, strict=False):
        errors = result.errors[metric]
        order = np.argsort(errors, kind="stable")  # The largest errors lie on top.
        points = axes.scatter(
            *truth_rb[order].T,
            c=errors[order],
            s=9,
            cmap=colours,
            vmin=0,
            vmax=scale_end,
            linewidths=0,
            rasterized=len(errors) * len(results) > _MAX_VECTOR_POINTS,
        )
        axes.set_title(result.method, fontsize=8.5)
        axes.set(xlim=limits[:, 0], ylim=limits[:, 1], aspect="equal")
        if len(kelvins) > 1:
            axes.plot(*locus.T, color=FAINT, linewidth=0.9, zorder=1)
            for end, offset, side in ((0, (-5, -8), "right"), (-1, (5, -2), "left")):
                text = f"{kelvins[end]:.0f} K"
                axes.annotate(text, locus[end], offset, textcoords="offset points", ha=side, fontsize=7, color=FAINT)
    panels = list(grid.flat)
    for axes in panels[len(results) :]:
        axes.remove()
    for axes in panels[len(results) - columns : len(results)]:
        # The lowest panel of each column has tick labels, even if the position below it is empty.
        axes.tick_params(labelbottom=True)
    figure.supxlabel("r = R / (R + G + B) of the ground truth", fontsize=9)
    figure.supylabel("b = B / (R + G + B)", fontsize=9)
    bar = figure.colorbar(points, ax=panels[: len(results)], extend="max", label=f"{metric} error, degrees", shrink=0.8)
    bar.outline.set_edgecolor(FAINT)


_PICTURE_HEIGHT = 170  # Height of a picture, px: three next to each other fill half a page

_MAX_PICTURE_WIDTH = 300  # Largest width of a picture, px; a panorama would make the pictures next to it tiny

# After correction by the ground truth, this percentile of the pixels' largest channels becomes white.
_WHITE_PERCENTILE = 98.0

_GAP = 6  # White gap between pictures, px

_MASK_GREY = 0.18  # Linear grey of masked pixels: the middle of a display's range

_MIN_MASKED_SHARE = 0.5  # A reduced pixel is drawn as masked if more than this fraction of it is masked

# JPEG quality: artefacts are invisible, and a page of a hundred pictures stays below 2 MB.
_JPEG_QUALITY = 88

_MIN_CHANNEL = 1e-6  # Replaces a channel of 0 before division, relative to the largest channel


def developed_pictures(scene: Scene, estimates: Sequence[npt.NDArray[np.float64]]) -> list[bytes]:
    """Return a JPEG file for each estimate: the scene as recorded, corrected by the estimate, and by the ground truth.

    `estimates`: (3,) float64 each, camera RGB of any scale.
    """
    image, mask = scene.read()
    linear = image.astype(np.float32)
    if mask is not None:
        # Masked pixels must not influence their neighbours in resizing, nor the exposure.
        linear[mask] = 0
    reduced = _resized(linear)
    truth: npt.NDArray[Any] = scene.truth
    if isinstance(scene, MixedScene):
        field = scene.read_truth_map()
        truth = _resized(np.where(np.isfinite(field), field, np.float32(scene.truth / scene.truth.sum())))
    is_masked = None if mask is None else _resized(mask.astype(np.float32)) > _MIN_MASKED_SHARE
    balanced = reduced * _gains(truth)
    balanced = balanced.reshape(-1, 3) if is_masked is None else balanced[~is_masked]
    white = float(np.percentile(balanced.max(axis=1), _WHITE_PERCENTILE)) if len(balanced) else 0.0

    def display_codes(light: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        lit = reduced * _gains(light) / np.float32(white or 1.0)
        if is_masked is not None:
            lit[is_masked] = _MASK_GREY
        return srgb_codes(lit)

    as_recorded, correct = display_codes(np.ones(3)), display_codes(truth)
    gap = np.full((len(reduced), _GAP, 3), 255, np.uint8)
    return [_encode_jpeg(np.hstack([as_recorded, gap, display_codes(light), gap, correct])) for light in estimates]


def _encode_jpeg(picture: npt.NDArray[np.uint8]) -> bytes:
    import cv2

    codes = np.ascontiguousarray(picture[..., ::-1])
    _, encoded = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return encoded.tobytes()


def _gains(light: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    # Gains that make the illuminant grey and leave green unchanged.
    channels = np.asarray(light, dtype=np.float64)
    floored = np.maximum(channels, _MIN_CHANNEL * channels.max(axis=-1, keepdims=True))
    return (floored[..., 1:2] / floored).astype(np.float32)


def _resized(array: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    import cv2

    height, width = array.shape[:2]
    scale = min(_PICTURE_HEIGHT / height, _MAX_PICTURE_WIDTH / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(array, size, interpolation=interpolation), dtype=np.float32)


WORST_IMAGES, MEDIAN_IMAGES = 3, 2  # Images shown of each method: largest errors, and nearest to the median error

MAX_METHODS = 12  # Largest number of methods with images; more would make the page too large for an e-mail

_DEFINITIONS = (
    "Recovery error: angle between estimated and true illuminant. Reproduction error: angle between white and a white "
    "surface after correction. Tri.: (Q1 + 2 Q2 + Q3) / 4. Best 25%: mean of the errors up to the 25th percentile. "
    "Worst 25%: mean of the errors from the 75th percentile. Avg.: geometric mean of mean, median, trimean, best 25% "
    "and worst 25%. Worst 5%: mean of the errors from the 95th percentile. Percentiles as in MATLAB's prctile (Hazen)."
)


def chosen_images(result: Result, metric: ErrorKind) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the indices of the images with the largest errors, and of those nearest to the median error.

    Examples
    --------
    >>> errors = {"recovery": np.array([4.0, 1, 3, 2, 9, 8, 7])}
    >>> chosen_images(Result("M", np.ones((7, 3)), errors, np.zeros(7, bool)), "recovery")
    ((4, 5, 6), (0, 2))
    """
    errors = result.errors[metric]
    worst = tuple(int(number) for number in np.argsort(-errors, kind="stable")[:WORST_IMAGES])
    # With an even number of images, two are equally far from the median. Rounding errors must not choose between them.
    nearest = np.argsort(np.round(np.abs(errors - np.median(errors)), 9), kind="stable")
    return worst, tuple([int(number) for number in nearest if int(number) not in worst][:MEDIAN_IMAGES])


def run_page(run: Run, metric: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> str:
    """Return the text of `report.html`."""
    kinds: tuple[ErrorKind, ErrorKind] = ("reproduction", "recovery")
    ordered = kinds if metric == "reproduction" else kinds[::-1]
    tables = [summary_table(run.subject, run.results, name, with_further=True) for name in ordered]
    # Notes are removed from the second table, because they are the same for both.
    tables[1] = Table(tables[1].title, tables[1].columns, tables[1].rows)
    elements = [
        pages.paragraph(f"{counted(len(run.subject.images), 'image')} from {run.location} (layout {run.layout})."),
        *map(pages.paragraph, run.notes),
        *map(table_part, tables),
        *map(table_part, lights_tables(run.subject, run.results, metric)),
        pages.note(_DEFINITIONS),
        pages.heading("Treatment of the images"),
        table_part(Table("Applied before a method receives an image", ("What", "How"), tuple(run.treatment.items()))),
        pages.heading("Cumulative error curves"),
        pages.figure(
            error_curves(run.results, metric),
            f"Share of the images with a {metric} error of at most x; higher is better. The axis ends at the 98th "
            f"percentile of {'all methods together' if len(run.results) > 1 else 'the errors'}.",
            "Cumulative error curves",
        ),
        pages.heading("Errors over the chromaticity plane"),
        pages.figure(
            error_planes(run.results, run.truths, metric, run.black_bodies),
            "Each point is the ground truth of an image; its colour is the error."
            + (" The line joins the black bodies among the illuminants." if len(run.black_bodies) > 1 else "")
            + _omitted_methods_text(run.results),
            "Errors over chromaticities",
        ),
        *_image_elements(run, metric, pictures),
        pages.heading("Methods"),
        table_part(Table("Methods of this run", ("Method", "Class", "Settings"), tuple(map(_method_row, run.methods)))),
        pages.note(f"Data set {run.data_sha256[:16]}…, {run.software}"),
    ]
    return pages.page(f"{run.subject.name}: {len(run.results)} method{'s' * (len(run.results) > 1)}", elements)


def _omitted_methods_text(results: Sequence[Result]) -> str:
    # Methods after the first `MAX_METHODS` have neither panels nor images.
    names = [result.method for result in results[MAX_METHODS:]]
    return f" Only {MAX_METHODS} of {len(results)} methods are shown, without {', '.join(names)}." if names else ""


def _image_elements(run: Run, metric: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> list[Markup]:
    if not pictures:
        return []
    elements = [
        pages.heading("Images"),
        pages.paragraph(
            "From left to right: as recorded, corrected by the estimate, corrected by the ground truth. "
            "Linear camera RGB without a colour matrix, equal exposure in each row, sRGB curve; masked pixels are grey."
            + _omitted_methods_text(run.results)
        ),
    ]
    for number, result in enumerate(run.results[:MAX_METHODS]):
        worst, middle = chosen_images(result, metric)
        rows = [
            element
            for title, indices in (("Largest errors", worst), ("Nearest to the median", middle))
            if indices
            for element in (
                pages.heading(title, 3),
                pages.row([_figure(run, number, index, metric, pictures) for index in indices]),
            )
        ]
        elements.append(pages.fold(result.method, rows, is_open=number == 0))
    return elements


def _figure(run: Run, number: int, index: int, metric: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> Markup:
    result, image = run.results[number], run.subject.images[index]
    cause = (result.causes or {}).get(index, "")
    captions = [f"{image}: {result.errors[metric][index]:.2f}°"]
    if result.guessed[index]:
        captions.append(f"{cause or 'no estimate'}: grey is used")
    if run.subject.mixed[index]:
        captions.append("several illuminants: one estimate for the whole image, ground truth by pixel")
    description = f"{image} as recorded, by {result.method}, by ground truth"
    return pages.figure(pictures[number, index], "; ".join(captions), description)


def _method_row(method: Mapping[str, Any]) -> tuple[str, str, str]:
    settings: Mapping[str, Any] = method.get("settings", method.get("estimates", {}))
    settings_text = ", ".join(f"{name} {_plain_text(value)}" for name, value in settings.items())
    return str(method.get("name", "")), str(method.get("class", "estimates of another program")), settings_text


def _plain_text(value: Any) -> str:
    match value:
        case None | bool():
            text = {None: "none", True: "yes", False: "no"}[value]
        case Mapping():
            parts = cast("Mapping[str, Any]", value).items()
            text = f"({', '.join(f'{name} {_plain_text(part)}' for name, part in parts)})"
        case list():
            text = f"({', '.join(map(_plain_text, cast('list[Any]', value)))})"
        case _:
            text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
