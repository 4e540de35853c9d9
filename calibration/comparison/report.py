"""Output of a comparison: text, JSON, and a folder with `report.html`, `comparison.json`, `lights.csv`, `cells.csv`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from calibration.comparison.comparing import (
    ANGLE_FLOOR_DEG,
    CELL_SCORE,
    CellDifferences,
    LightDifferences,
    TableComparison,
    differing_cells,
    differing_lights,
)
from experiment.chart.model import Chart
from foundation.console import json_value
from foundation.files import write_atomic
from foundation.folders import atomic_folder
from foundation.pages import figure, note, page, table, verdict
from foundation.plots import INK, MARK, draw_panels, draw_squares

_ANSWERS = {True: "yes", False: "no"}


def lines(comparison: TableComparison) -> list[str]:
    """Return a comparison as text: warnings, the result of each quantity, and the overall result."""
    texts = [f"{'A, B:':24}{', '.join(map(str, comparison.folders))}"]
    texts += [f"warning: {warning}" for warning in comparison.warnings]
    for answer in comparison.answers:
        same = _ANSWERS[answer.same_within_noise]
        texts += [f"{f'{answer.name}:':24}{answer.said}", f"{'':24}same within noise: {same}"]
    return [*texts, f"{'Same within noise:':24}{_ANSWERS[comparison.same_within_noise]}"]


def comparison_json(comparison: TableComparison) -> dict[str, Any]:
    """Return the content of `comparison.json` (docs/formats.md)."""
    lights, cells = comparison.lights, comparison.cells
    return json_value(
        {
            "format": "crop.comparison",
            "version": 1,
            "same_within_noise": comparison.same_within_noise,
            "tables": comparison.folders,
            "warnings": comparison.warnings,
            "answers": comparison.answers,
            "angle_deg": {"median": np.median(lights.angle_deg), "worst": lights.angle_deg.max()},
            "brightness": {"median": np.median(lights.brightness), "spread": lights.brightness.std()},
            "cells": {name: getattr(cells, name) for name in ("rms", "rms_by_noise", "score", "offset")},
            "differing_lights": differing_lights(lights),
            "differing_cells": differing_cells(cells),
        }
    )


def draw_lights(panels: Any, lights: LightDifferences) -> None:
    """Draw angle, brightness and patch difference of every illuminant, with the limits for equal LUTs."""
    differences = (
        (lights.angle_deg, ANGLE_FLOOR_DEG, "angle between whites, °"),
        (100 * lights.brightness, 0, "brightness, B / A − 1, %"),
        (lights.cell_score, CELL_SCORE, "patches, RMS in units of noise"),
    )
    for axes, (values, line, title) in zip(panels, differences, strict=True):
        axes.plot(lights.one, values, ".", color=INK, markersize=3)
        axes.axhline(line, color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
        axes.set(title=title, xlabel="illuminant of A")


def draw_map(panels: Any, chart: Chart, cells: CellDifferences) -> None:
    """Draw the mean differences of the patches on the print, in the channel that differs most."""
    (axes,) = panels
    deviation = np.nan_to_num(cells.mean - cells.offset)
    largest = 100 * np.take_along_axis(deviation, np.abs(deviation).argmax(axis=1)[:, None], axis=1)[:, 0]
    reach = max(0.5, float(np.percentile(np.abs(largest), 99)))
    centres_mm, side_mm = chart.centres_mm[chart.cell_of_colour], float(np.mean(chart.cell_mm))
    image = draw_squares(axes, chart.page_mm, centres_mm, side_mm, largest, 6.0, cmap="RdBu", vmin=-reach, vmax=reach)
    axes.figure.colorbar(image, ax=axes, label="B / A − 1, %", shrink=0.8, extend="both")


def write_comparison(comparison: TableComparison, folder: Path, chart: Chart | None = None) -> None:
    """Write a comparison into a new folder, completely or not at all; with a map of the print if `chart` is given."""
    (first, second), cells, same = comparison.folders, comparison.cells, comparison.same_within_noise
    pictures = [
        figure(draw_panels(draw_lights, comparison.lights, inches=[(3.3, 3.0)] * 3), "Differences by illuminant.")
    ]
    if chart is not None:
        caption = "Differences of patches on the print. Noise appears as fine grain, stains and shadows as shapes."
        pictures.append(figure(draw_panels(draw_map, chart, cells, inches=[(7.2, 5.4)]), caption))
    answers = [(_ANSWERS[answer.same_within_noise], answer.name, answer.said) for answer in comparison.answers]
    outcome, sentence = ("accept", "The same within noise.") if same else ("remark", "The difference exceeds noise.")
    elements = [
        verdict(outcome, sentence),
        *(note(f"Note: {warning}.") for warning in comparison.warnings),
        table("Same within noise", ("", "quantity", "measured"), answers, (False, False, False)),
        *pictures,
    ]
    columns = {"colour": np.arange(len(cells.mean)), "lights": cells.lights.max(axis=1)}
    for name in ("mean", "noise"):
        columns |= dict(zip((f"{name}_{letter}" for letter in "rgb"), getattr(cells, name).T, strict=True))
    with atomic_folder(folder, "the comparison") as partial:
        _write_columns(partial / "lights.csv", vars(comparison.lights))
        _write_columns(partial / "cells.csv", columns)
        write_atomic(partial / "report.html", page(f"{first.name} and {second.name} compared", elements))
        write_atomic(partial / "comparison.json", json.dumps(comparison_json(comparison), indent=2) + "\n")


def _write_columns(path: Path, columns: dict[str, Any]) -> None:
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, "%.6g", delimiter=",", header=",".join(columns), comments="")
