"""What a build measured, judged, said and wrote as a whole, to be pinned."""

from __future__ import annotations

import json
import re
from collections.abc import Generator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from calibration.causes.rules import Evidence
from calibration.report.report import report_json, summary
from calibration.table.lut import open_lut
from calibration.verdict import BuildResult, findings, refusal, remark, retaken_frames
from tests.pinned import NOTHING
from tests.pinned.drawn import drawn

LIMITS: dict[str, float] = {"same": 1e-3, "nothing": 1e-6}
"""What numbers of whole builds may differ by: they come from fits upon fits, and another BLAS moves some by 3e-4."""

UNSURE = ("scatter", "frame_scatter", "noise", "noise_misfit", "transfer")
"""What is a small difference of large numbers, or hangs on which cells are left out: 2 % by another processor."""

MOST_UNFIT = 3
"""Cells that are named."""

CERTAIN_BLOCK = 0.005
"""Share by which a block of cells is off in a frame from which on it is more than noise."""

LEFT_OUT = (
    "gain_e",
    "response_spread",
    "cell_share",
    "sha256",
    "software",
    "serial",
    "limits",
    "format",
    "version",
    "chart_places",
)
"""What reports hold that is the same in all, or not of the session."""


def together(values: Sequence[Any]) -> Any:
    """Return like records field by field, what numbers each holds, however many, as one array."""
    match values[0]:
        case Mapping() as first:
            return {name: together([value[name] for value in values]) for name in first}
        case record if is_dataclass(record):
            return {name: together([getattr(value, name) for value in values]) for name in of_fields(record)}
        case int() | float() | np.ndarray() | tuple() | list():
            return numbers_of(values)
        case _:
            return list(values)


def numbers_of(value: Any) -> Any:
    """Return nested lists of numbers as one array; what holds anything else as it is."""
    found = list(_numbers(value))
    return value if any(isinstance(one, str) for one in found) else np.array(found, float)


def _numbers(value: Any) -> Generator[Any]:
    """Yield what a number, an array or nested tuples hold."""
    match value:
        case np.ndarray():
            yield from value.ravel().tolist()
        case Mapping():
            yield from _numbers(list(value.values()))
        case tuple() | list():
            for one in value:
                yield from _numbers(one)
        case int() | float():
            yield value
        case _:
            yield str(value)


def of_fields(record: Any, *left_out: str) -> dict[str, Any]:
    """Return a record's fields by name, but for those left out."""
    return {one.name: getattr(record, one.name) for one in fields(record) if one.name not in (*left_out, *UNSURE)}


def masked(text: str) -> str:
    """Return a text without measured numbers, whose last digit may be another one on another processor."""
    return re.sub(r"[-+]?\d[\d.e-]*(?= ?[%°]| px| mm| counts)|[-+]?\d+\.\d+(e-?\d+)?", "#", text)


def brief(value: Any) -> Any:
    """Return a record, arrays of more than four numbers by their root mean square and a sum by chance weights."""
    match value:
        case float():
            return 0.0 if abs(value) < NOTHING else value
        case None | bool() | int() | str() | Enum():
            return value
        case Mapping():
            # What is nothing is left out.
            found = {name: brief(one) for name, one in value.items()}
            return {name: one for name, one in found.items() if one not in (None, [], {}, False)}
        case record if is_dataclass(record):
            return brief(of_fields(record))
        case [first, *_] if is_dataclass(first):
            return brief(together(value))
        case _:
            numbers = numbers_of(value)
    if not isinstance(numbers, np.ndarray):
        return numbers
    known = numbers[np.isfinite(numbers)]
    if not (np.abs(known) > NOTHING).any():
        return []
    weights = np.random.default_rng(numbers.size).normal(size=known.size)
    if numbers.size <= 4:
        return numbers.tolist()
    return [float(np.sqrt((known**2).mean())), float(weights @ known) / known.size**0.5]


def sketched(figure: Figure) -> list[Any]:
    """Return what a figure shows: of each kind of artist each property of all of them together, in brief."""
    size, *artists = drawn(figure)
    kinds: dict[str, list[list[Any]]] = {}
    for kind, *shown in artists:
        # A collection has as many paths as it has.
        kinds.setdefault(kind, []).append([*shown[:3], shown[3:]])
    return [size, {kind: [_in_brief(column) for column in zip(*shown, strict=False)] for kind, shown in kinds.items()}]


def _in_brief(column: Sequence[Any]) -> list[Any]:
    found = list(_numbers(column))
    words = dict.fromkeys(one for one in found if isinstance(one, str))
    numbers = [one for one in found if not isinstance(one, str)]
    return [len(found), *([" | ".join(words)] if words else []), *(np.ravel(brief(numbers)) if numbers else [])]


def known(evidence: Evidence) -> dict[str, float]:
    """Return what is known as evidence, without what is unsure."""
    return {name: value for name, value in evidence.known().items() if name not in UNSURE}


def told(result: BuildResult) -> dict[str, Any]:
    """Return what is judged and said of a build, and in brief what its frames, lights, greys and cells showed."""
    table, verdict = result.figures, result.verdict
    causes, not_of_frames = findings(verdict, table).values(), ("record", "origin", "consistency")
    return {
        "judged": {row.figure.name: row.value for row in verdict.rows if row.figure.name not in UNSURE},
        "outcomes": {row.figure.name: row.outcome for row in verdict.rows if row.outcome != "accept"},
        "remarks": [masked(remark(row, table)) for row in verdict.remarks],
        "refusal": masked(refusal(verdict, table)) if verdict.refused else None,
        "causes": [[one.figure, one.decision.cause.name, known(one.evidence), one.places] for one in causes],
        "files": [[frame.file for frame in one.frames] for one in causes],
        "retake": [frame.file for frame in retaken_frames(verdict, table)],
        "unfit": [len(table.cells.unfit), *table.cells.unfit[:MOST_UNFIT]],
        "frames": brief(together([of_fields(one, *not_of_frames, "channel") for one in table.frames])),
        "off": {
            frame.record.file: brief(frame.consistency)
            for frame in table.frames
            if frame.consistency.block > CERTAIN_BLOCK
        },
        "lights": brief(table.lights),
        "stains": brief(of_fields(table.cells.stains, "level", "places_mm")),
        "cells": {one.name: brief(np.sqrt(one.cells)) for one in table.budget.components if one.name not in UNSURE},
        "dark": table.dark_frames.light,
    }


def whole(result: BuildResult) -> dict[str, Any]:
    """Return all that was measured, judged and said in a build."""
    table, verdict = result.figures, result.verdict
    left_out = ("lights", "frames", "session", "origin", "origins", "registration", "cells", "budget", "primaries")
    return told(result) | {
        "frames": together([of_fields(frame, "record", "origin", "consistency") for frame in table.frames]),
        "lights": table.lights,
        "greys": table.greys,
        "summary": [[row.name, masked(row.value), masked(row.note)] for row in summary(table)],
        "outcomes": {row.figure.name: masked(row.text()) for row in verdict.rows},
        "registration": of_fields(table.registration, "framing"),
        "framing": of_fields(table.registration.framing, "plane"),
        "budget": [
            [one.name, one.source, _root(one.lights), np.sqrt(one.cells)]
            for one in table.budget.components
            if one.name not in UNSURE
        ],
        "added": table.cells.added,
        "stains": of_fields(table.cells.stains, "level", "places_mm"),
        "fields": numbers_of([one.coefficients for one in table.primaries.fields]) if table.primaries else None,
        "primaries": of_fields(table.primaries, "fields") if table.primaries else None,
        "sensor": of_fields(table.sensor),
        **of_fields(table, *left_out, "sensor"),
    }


def _root(covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a covariance in the unit of its quantity, so that small ones are not as good as 0."""
    return np.sign(covariance) * np.sqrt(np.abs(covariance))


def written(folder: Path) -> dict[str, Any]:
    """Return what a table's folder holds: samples, the rows of its lists, what was corrected."""
    table = open_lut(folder)
    lists = {
        name: [line.split(",") for line in (folder / name).read_text(encoding="utf-8").splitlines()]
        for name in ("illuminations.csv", "references.csv", "uncertainty.csv", "cells.csv")
    }
    numbers = {
        name: [
            rows[0],
            np.array([float(value or "nan") for row in rows[1:] for value in row if not value[:1].isalpha()]),
        ]
        for name, rows in lists.items()
    }
    return {"samples": table.samples, **numbers, "corrections": corrections(table.provenance.corrections)}


def corrections(done: Sequence[Mapping[str, Any]]) -> list[Any]:
    """Return corrections as recorded, numbers as arrays."""
    return [
        {name: numbers_of(value) if isinstance(value, list) else value for name, value in one.items()} for one in done
    ]


def reported(result: BuildResult) -> dict[str, Any]:
    """Return what `report.json` holds, but for names of files' contents and what is in every report."""

    def kept(value: Any) -> Any:
        match value:
            case dict():
                return {
                    name: kept(one)
                    for name, one in value.items()
                    if not any(word in name for word in (*LEFT_OUT, *UNSURE))
                }
            case list() if all(isinstance(one, int | float) for one in value):
                return numbers_of(value)
            case list():
                return [kept(one) for one in value]
            case _:
                return value

    return kept(json.loads(json.dumps(report_json(result))))
