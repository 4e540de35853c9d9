"""A comparison in lines of text, and for programs."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.comparison.answers import differing_cells, differing_lights
from calibration.comparison.values import ComparedTable, TableComparison
from foundation.errors import first_of

FORMAT = "crop.comparison"
VERSION = 1
"""`format` and `version` of `comparison.json` (docs/formats.md)."""

_MOST_CELLS = 100
"""Cells that are listed in the JSON; all of them are in `cells.csv`."""

_ANSWERS = {True: "yes", False: "no", None: "not known"}


def lines(comparison: TableComparison) -> list[str]:
    """Return what a comparison found, for people: both tables, warnings, each answer, geometry, colours."""
    cells = comparison.cells
    named = [f"{name}  {_described(table)}" for name, table in (("A", comparison.one), ("B", comparison.other))]
    told = [*named, *(f"warning: {warning}" for warning in comparison.warnings)]
    told += [
        f"{f'{answer.name}:':24}{answer.said}\n{'':24}same within noise: {_ANSWERS[answer.same]}"
        for answer in comparison.answers
    ]
    gains = " / ".join(f"{100 * (gain - 1):+.3f} %" for gain in comparison.lights.gains.tolist())
    told.append(f"{'B over A, R / G / B:':24}{gains}, median of the lights")
    told.append(f"{'chart in the frame:':24}{geometry_text(comparison)}")
    told += [
        f"{f'{group.name} cells:':24}{group.cells}, mean {100 * group.mean:+.3f} %, spread {100 * group.spread:.3f} %, "
        f"worst {100 * group.worst:+.2f} % (colour {group.worst_colour})"
        for group in comparison.groups
        if group.cells
    ]
    for name, unfit in (("A", cells.unfit_one), ("B", cells.unfit_other)):
        if unfit:
            told.append(f"{f'unfit in {name} only:':24}{len(unfit)} cells: {first_of(unfit)}")
    return [*told, f"{'Same within noise:':24}{_ANSWERS[comparison.same]}"]


def geometry_text(comparison: TableComparison) -> str:
    """Return how the chart lay elsewhere, in words."""
    found = comparison.geometry
    if found is None:
        return "not known; tables of this software say in report.json where the chart lay"
    x, y = found.shift_px
    return (
        f"{x:+.2f}, {y:+.2f} px elsewhere (right, down), turned by {found.turned_deg:+.3f}°, "
        f"{100 * found.scale:+.3f} % larger, bent by {found.bent_px:.2f} px RMS"
    )


def comparison_json(comparison: TableComparison) -> dict[str, Any]:
    """Return the content of `comparison.json`; what is not known is null."""
    lights, cells = comparison.lights, comparison.cells
    geometry = comparison.geometry
    return {
        "format": FORMAT,
        "version": VERSION,
        "same_within_noise": comparison.same,
        "tables": [_table_json(table) for table in (comparison.one, comparison.other)],
        "warnings": list(comparison.warnings),
        "answers": [
            {"name": answer.name, "same_within_noise": answer.same, "said": answer.said}
            for answer in comparison.answers
        ],
        "angle_deg": _summary(lights.angle_deg) | {"noise": _number(_median(lights.angle_noise_deg))},
        "brightness": _summary(lights.brightness) | {"noise": _number(_median(lights.brightness_noise))},
        "brightness_left": _summary(lights.brightness_left),
        "gains": _numbers(lights.gains),
        "cells": {
            "rms": _number(cells.rms),
            "rms_by_noise": _number(cells.predicted_rms),
            "beyond_noise": _number(cells.beyond_noise),
            "score": _number(cells.score),
            "offset": _numbers(cells.offset),
            "compared": int((cells.lights > 0).any(axis=1).sum()),
            "differing": differing_cells(cells)[:_MOST_CELLS].tolist(),
            "differing_count": len(differing_cells(cells)),
            "unfit_in_one_only": [len(cells.unfit_one), len(cells.unfit_other)],
        },
        "differing_lights": lights.one[differing_lights(lights)].tolist(),
        "colours": [
            {
                "name": group.name,
                "cells": group.cells,
                "mean": _number(group.mean),
                "spread": _number(group.spread),
                "worst": _number(group.worst),
                "worst_colour": group.worst_colour if group.cells else None,
            }
            for group in comparison.groups
        ],
        "geometry": None
        if geometry is None
        else {
            "shift_px": list(geometry.shift_px),
            "turned_deg": geometry.turned_deg,
            "scale": geometry.scale,
            "bent_px": geometry.bent_px,
        },
    }


def lights_csv(comparison: TableComparison) -> str:
    """Return `lights.csv`: a row a light, B over A; empty where something is not known."""
    lights = comparison.lights
    columns = {
        "light": lights.one,
        "light_of_b": lights.other,
        "angle_deg": lights.angle_deg,
        "angle_noise_deg": lights.angle_noise_deg,
        "angle_score": lights.angle_score,
        "brightness": lights.brightness,
        "brightness_left": lights.brightness_left,
        "brightness_noise": lights.brightness_noise,
        "cell_rms": lights.cell_rms,
        "cell_noise": lights.cell_noise,
        "cell_score": lights.cell_score,
    }
    return _csv(columns)


def cells_csv(comparison: TableComparison) -> str:
    """Return `cells.csv`: a row a colour, B over A less 1, each over its light's white; empty where it is not known."""
    cells = comparison.cells
    columns: dict[str, npt.NDArray[Any]] = {"colour": np.arange(len(cells.mean)), "lights": cells.lights.max(axis=1)}
    for name, values in (
        ("mean", cells.mean),
        ("spread", cells.spread),
        ("noise", cells.noise),
        ("worst", cells.worst_share),
        ("worst_light", cells.worst_light),
    ):
        columns |= {f"{name}_{letter}": values[:, channel] for channel, letter in enumerate("rgb")}
    return _csv(columns)


def _described(table: ComparedTable) -> str:
    corrected = ", the lamp's drift taken out" if table.drift_corrected else ""
    return f"{table.place}: {table.camera}, {table.lights} lights, {table.samples} samples a cell{corrected}"


def _table_json(table: ComparedTable) -> dict[str, Any]:
    return {
        "place": str(table.place),
        "camera": table.camera,
        "software": table.software,
        "lights": table.lights,
        "samples": table.samples,
        "drift_corrected": table.drift_corrected,
    }


def _summary(values: npt.NDArray[np.float64]) -> dict[str, Any]:
    return {
        "mean": _number(float(values.mean())),
        "median": _number(float(np.median(values))),
        "spread": _number(float(values.std())),
        "worst": _number(float(values[np.abs(values).argmax()])),
    }


def _csv(columns: dict[str, npt.NDArray[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*(column.tolist() for column in columns.values()), strict=True):
        writer.writerow(
            [value if isinstance(value, int) else f"{value:.6g}" if value == value else "" for value in row]
        )
    return text.getvalue()


def _median(values: npt.NDArray[np.float64]) -> float:
    return float(np.nanmedian(values)) if np.isfinite(values).any() else float("nan")


def _numbers(values: npt.NDArray[np.float64]) -> list[float | None]:
    return [_number(value) for value in values.tolist()]


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if np.isfinite(value) else None
