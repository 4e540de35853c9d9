"""A comparison in lines of text, for programs, and as a page with pictures and tables.

The files are `report.html`, `comparison.json`, `lights.csv` and `cells.csv`.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from calibration.comparison.comparing import (
    ANGLE_FLOOR_DEG,
    CELL_SCORE,
    CellDifferences,
    ComparedTable,
    LightDifferences,
    TableComparison,
    differing_cells,
    differing_lights,
)
from experiment.chart.model import Chart
from foundation.errors import first_of
from foundation.files import write_whole
from foundation.folders import whole_folder
from foundation.pages import figure, heading, note, page, table, verdict
from foundation.plots import CHANNEL_INK, FAINT, INK, MARK, draw_squares, png_of
from foundation.records import to_plain

FORMAT = "crop.comparison"

VERSION = 1
"""`format` and `version` of `comparison.json` (docs/formats.md)."""

_MOST_CELLS = 100
"""Cells that are listed in the JSON; all of them are in `cells.csv`."""

_ANSWERS = {True: "yes", False: "no", None: "not known"}

_VERDICTS: dict[bool | None, tuple[Literal["accept", "remark"], str]] = {
    True: ("accept", "The same within noise."),
    False: ("remark", "They differ by more than noise."),
    None: ("remark", "Whether they are the same within noise cannot be said of everything."),
}


def lines(comparison: TableComparison) -> list[str]:
    """Return what a comparison found, for people: both tables, warnings, each answer, geometry, colours."""
    cells = comparison.cells
    named = [f"{name}  {_described(table)}" for name, table in (("A", comparison.one), ("B", comparison.other))]
    found = [*named, *(f"warning: {warning}" for warning in comparison.warnings)]
    found += [
        f"{f'{answer.name}:':24}{answer.said}\n{'':24}same within noise: {_ANSWERS[answer.same]}"
        for answer in comparison.answers
    ]
    gains = " / ".join(f"{100 * (gain - 1):+.3f} %" for gain in comparison.lights.gains.tolist())
    found.append(f"{'B over A, R / G / B:':24}{gains}, median of the lights")
    found.append(f"{'chart in the frame:':24}{geometry_text(comparison)}")
    found += [
        f"{f'{group.name} cells:':24}{group.cells}, mean {100 * group.mean:+.3f} %, spread {100 * group.spread:.3f} %, "
        f"worst {100 * group.worst:+.2f} % (colour {group.worst_colour})"
        for group in comparison.groups
        if group.cells
    ]
    for name, unfit in (("A", cells.unfit_one), ("B", cells.unfit_other)):
        if unfit:
            found.append(f"{f'unfit in {name} only:':24}{len(unfit)} cells: {first_of(unfit)}")
    return [*found, f"{'Same within noise:':24}{_ANSWERS[comparison.same]}"]


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
    return {
        "format": FORMAT,
        "version": VERSION,
        "same_within_noise": comparison.same,
        "tables": [to_plain(table) for table in (comparison.one, comparison.other)],
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
        "geometry": None if comparison.geometry is None else to_plain(comparison.geometry),
    }


def lights_csv(comparison: TableComparison) -> str:
    """Return `lights.csv`: a row a light, B over A; empty where something is not known."""
    lights = comparison.lights
    measured = (
        "angle_deg", "angle_noise_deg", "angle_score", "brightness", "brightness_left", "brightness_noise", "cell_rms",
        "cell_noise", "cell_score",
    )  # fmt: skip
    columns = {"light": lights.one, "light_of_b": lights.other}
    columns |= {name: getattr(lights, name) for name in measured}
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
    return f"{table.place}: {table.camera}, {table.lights} lights, {table.samples} samples a cell{_drift(table, ', ')}"


def _drift(table: ComparedTable, joint: str = "") -> str:
    return f"{joint}the lamp's drift taken out" if table.drift_corrected else ""


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


def draw_lights(figure: Any, lights: LightDifferences) -> None:
    """Draw angle, brightness and cells of every light against what noise alone gives."""
    figure.set_size_inches(10, 3.1)
    angle, brightness, cells = figure.subplots(1, 3)
    number = lights.one
    angle.plot(number, lights.angle_deg, ".", color=INK, markersize=3, label="seen")
    angle.plot(number, lights.angle_noise_deg, "_", color=MARK, markersize=4, label="noise alone, RMS")
    angle.axhline(ANGLE_FLOOR_DEG, color=FAINT, linewidth=0.7, linestyle=(0, (4, 3)))
    angle.set(title="angle between whites", ylabel="°", xlabel="light of A")
    angle.set_ylim(bottom=0)
    angle.legend(frameon=False, fontsize=8)
    brightness.plot(number, 100 * lights.brightness, ".", color=INK, markersize=3, label="as measured")
    brightness.plot(
        number, 100 * lights.brightness_left, ".", color=MARK, markersize=3, label="without drift and median"
    )
    brightness.axhline(0, color=FAINT, linewidth=0.7)
    brightness.set(title="brightness, B over A", ylabel="%", xlabel="light of A")
    brightness.legend(frameon=False, fontsize=8)
    cells.plot(number, lights.cell_score, ".", color=INK, markersize=3)
    cells.axhline(1, color=FAINT, linewidth=0.7)
    cells.axhline(CELL_SCORE, color=MARK, linewidth=0.8, linestyle=(0, (4, 3)))
    cells.set(title="cells, RMS in units of noise", xlabel="light of A")


def draw_cells(figure: Any, cells: CellDifferences) -> None:
    """Draw the distribution of the cells' mean differences, channel by channel, and of the same in units of noise."""
    figure.set_size_inches(10, 3.1)
    share, score = figure.subplots(1, 2)
    for channel in range(3):
        known = np.isfinite(cells.mean[:, channel])
        if not known.any():
            continue
        mean, noise = cells.mean[known, channel], cells.noise[known, channel]
        share.hist(100 * mean, bins=80, histtype="step", color=CHANNEL_INK[channel], label="RGB"[channel])
        score.hist(
            np.clip((mean - cells.offset[channel]) / noise, -8, 8), bins=80, range=(-8, 8), histtype="step",
            color=CHANNEL_INK[channel], density=True,
        )  # fmt: skip
    at = np.linspace(-8, 8, 200)
    score.plot(at, np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi), color=FAINT, linewidth=0.9, label="noise alone")
    share.set(title="mean difference of cells over the lights", xlabel="%, B over A", ylabel="cells")
    share.set_yscale("log")
    score.set(title="the same in units of its noise", xlabel="standard errors")
    for axes in (share, score):
        axes.legend(frameon=False, fontsize=8)


def draw_map(figure: Any, chart: Chart, cells: CellDifferences) -> None:
    """Draw the cells' mean differences where they lie on the print, in the channel that differs most."""
    page_w, page_h = chart.page_mm
    figure.set_size_inches(10, 8.6 * page_h / page_w)
    axes = figure.subplots()
    filled = np.nan_to_num(cells.mean - cells.offset)
    largest = np.take_along_axis(filled, np.abs(filled).argmax(axis=1)[:, None], axis=1)[:, 0]
    reach = max(0.5, 100 * float(np.percentile(np.abs(largest), 99)))
    places, side_mm = chart.centres_mm[chart.cell_of_colour], float(np.mean(chart.cell_mm))
    image = draw_squares(axes, chart.page_mm, places, side_mm, 100 * largest, 8.2, cmap="RdBu", vmin=-reach, vmax=reach)
    axes.set_ylabel("mm")
    figure.colorbar(image, ax=axes, label="B over A, %", shrink=0.8, extend="both")


def write_comparison(comparison: TableComparison, folder: Path, chart: Chart | None = None) -> None:
    """Write a comparison into a new folder, whole or not at all."""
    pictures = _pictures(comparison, chart)
    with whole_folder(folder, "the comparison") as partial:
        write_whole(partial / "lights.csv", lights_csv(comparison))
        write_whole(partial / "cells.csv", cells_csv(comparison))
        for picture in pictures:
            write_whole(partial / picture.file, picture.png)
        write_whole(partial / "report.html", comparison_page(comparison, pictures))
        write_whole(partial / "comparison.json", json.dumps(comparison_json(comparison), indent=2) + "\n")


def comparison_page(comparison: TableComparison, pictures: Sequence[_Picture]) -> str:
    """Return the text of `report.html`."""
    tables = comparison.one, comparison.other
    kind, sentence = _VERDICTS[comparison.same]
    shown = [(heading(each.title), figure(each.png, each.caption, each.title, wide=True)) for each in pictures]
    return page(
        f"{tables[0].place.name} and {tables[1].place.name} compared",
        [
            table(
                "The tables",
                ("", "place", "camera", "lights", "samples", "drift", "software"),
                [
                    (name, str(one.place), one.camera, str(one.lights), str(one.samples), _drift(one), one.software)
                    for name, one in zip("AB", tables, strict=True)
                ],
                (False, False, False, True, True, False, False),
            ),
            verdict(kind, sentence),
            *(note(f"Note: {warning}.") for warning in comparison.warnings),
            table(
                "Same within noise",
                ("", "of", "seen"),
                [
                    *((_ANSWERS[answer.same], answer.name, answer.said) for answer in comparison.answers),
                    ("", "chart in the frame", geometry_text(comparison)),
                ],
                (False, False, False),
            ),
            *(part for parts in shown for part in parts),
            heading("By colour"),
            table(
                "Mean differences of cells, B over A",
                ("cells", "number", "mean", "spread", "worst", "its colour"),
                [
                    (
                        group.name,
                        str(group.cells),
                        f"{100 * group.mean:+.3f} %",
                        f"{100 * group.spread:.3f} %",
                        f"{100 * group.worst:+.2f} %",
                        str(group.worst_colour),
                    )
                    for group in comparison.groups
                    if group.cells
                ],
                (False, True, True, True, True, True),
            ),
        ],
    )


@dataclass(frozen=True)
class _Picture:
    """A picture of the page, which is a file beside it, too."""

    file: str
    title: str
    caption: str
    png: bytes


def _pictures(comparison: TableComparison, chart: Chart | None) -> list[_Picture]:
    found = [
        _Picture(
            "lights.png",
            "Light by light",
            "Left: angle between the two whites, and what their standard errors alone give. Middle: brightness, as "
            "measured, and without the drift that both tables record and the median of all lights. Right: how far the "
            "cells differ in units of their noise; 1 is noise alone.",
            png_of(draw_lights, comparison.lights),
        ),
        _Picture(
            "cells.png",
            "Cell by cell",
            "Each cell over its own light's white, B over A, mean over the lights. Right: in units of its standard "
            "error; what is wider than the line is not noise.",
            png_of(draw_cells, comparison.cells),
        ),
    ]
    if chart is not None:
        caption = "The same where the cells lie. Noise is a fine grain; a stain, a shadow or another field has a shape."
        found.append(_Picture("map.png", "On the print", caption, png_of(draw_map, chart, comparison.cells)))
    return found
