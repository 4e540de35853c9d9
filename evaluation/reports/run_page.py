"""The report of a run: summary, how the data were treated, error curves, the chromaticity plane, and images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from evaluation.metrics import ErrorKind
from evaluation.reports.error_figures import error_curves, error_planes
from evaluation.reports.page import table_part
from evaluation.results.result import Result
from evaluation.results.run import Run
from evaluation.results.summary_tables import lights_tables, summary_table
from evaluation.results.tables import Table
from foundation import pages
from foundation.errors import counted

WORST, MIDDLE = 3, 2
"""Images shown of each method: its largest errors, and those nearest to its median."""

MOST_SHOWN = 12
"""Methods of which images are shown: with more the page would be too large to be mailed."""

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
    nearest = np.argsort(np.abs(errors - np.median(errors)), kind="stable")
    return worst, tuple([int(number) for number in nearest if int(number) not in worst][:MIDDLE])


def run_page(run: Run, kind: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> str:
    """Return the text of `report.html`."""
    kinds: tuple[ErrorKind, ErrorKind] = ("reproduction", "recovery")
    ordered = kinds if kind == "reproduction" else kinds[::-1]
    tables = [summary_table(run.subject, run.results, each, further=True) for each in ordered]
    # What is said of images without a light holds for both tables.
    tables[1] = Table(tables[1].title, tables[1].columns, tables[1].rows)
    parts = [
        pages.paragraph(f"{counted(len(run.subject.images), 'image')}, read from {run.place} (layout {run.layout})."),
        *map(pages.paragraph, run.notes),
        *map(table_part, tables),
        *map(table_part, lights_tables(run.subject, run.results, kind)),
        pages.note(_DEFINITIONS),
        pages.heading("What was done to the images"),
        table_part(_treatment(run)),
        pages.heading("Cumulative error curves"),
        pages.figure(error_curves(run.results, kind), _curves_caption(run.results, kind), "Cumulative error curves"),
        pages.heading("Errors over the chromaticity plane"),
        pages.figure(
            error_planes(run.results, run.truths, kind), _planes_caption(run.results), "Errors over chromaticities"
        ),
        *_images(run, kind, pictures),
        pages.heading("Methods"),
        table_part(_methods(run)),
        pages.note(f"Data set {run.data_sha256[:16]}…, {run.software}"),
    ]
    return pages.page(f"{run.subject.name}: {len(run.results)} method{'s' * (len(run.results) > 1)}", parts)


def _treatment(run: Run) -> Table:
    return Table("Applied before a method sees an image", ("What", "How"), tuple(run.treatment.items()))


def _curves_caption(results: Sequence[Result], kind: ErrorKind) -> str:
    return (
        f"The share of images whose {kind} error is not larger than the value below; the higher, the better. The axis "
        f"ends at the 98th percentile of {'all methods together' if len(results) > 1 else 'the errors'}."
    )


def _planes_caption(results: Sequence[Result]) -> str:
    return f"Each point is the true light of an image; its colour is the method's error on it.{_left_out(results)}"


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


def _methods(run: Run) -> Table:
    rows = tuple(
        (str(method.get("name", "")), str(method.get("class", "estimates of another program")), _settings_text(method))
        for method in run.methods
    )
    return Table("As they were run", ("Method", "Class", "Settings"), rows)


def _settings_text(method: Mapping[str, Any]) -> str:
    settings: Mapping[str, Any] = method.get("settings", method.get("estimates", {}))
    return ", ".join(f"{name} {_short(value)}" for name, value in settings.items())


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
