"""Numbers of a whole build, to be pinned: measurements, verdict and files."""

from __future__ import annotations

import json
from collections.abc import Generator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.causes.rules import Evidence
from calibration.report.report import report_json
from calibration.table.lut import open_lut
from calibration.verdict import BuildResult, findings, retaken_frames
from tests.pinned import NOTHING

# Tolerance for numbers of whole builds: they come from several fits, and another BLAS changes some by 3e-4.
LIMITS: dict[str, float] = {"same": 1e-3, "nothing": 1e-6}

# Small differences of large numbers, or values that depend on excluded cells: 2 % by another processor.
UNSURE = ("scatter", "frame_scatter", "noise", "noise_misfit", "transfer")

# Number of listed unfit cells.
MOST_UNFIT = 3

OUTCOMES = ("accept", "accept with remarks", "refuse")

# Keys of reports that are the same in all, or do not depend on the session.
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


def together(values: Sequence[Any]) -> Any:
    """Return similar records field by field, their numbers as one array."""
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
    """Return nested lists of numbers as one array; other values unchanged."""
    result = list(_numbers(value))
    return value if any(isinstance(one, str) for one in result) else np.array(result, float)


def _numbers(value: Any) -> Generator[Any]:
    """Yield the numbers of a number, an array or nested tuples."""
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
    """Return a record's fields by name, without those listed."""
    return {one.name: getattr(record, one.name) for one in fields(record) if one.name not in (*left_out, *UNSURE)}


def brief(value: Any) -> Any:
    """Return a record with large arrays replaced by their root mean square and a randomly weighted sum."""
    match value:
        case float():
            return 0.0 if abs(value) < NOTHING else value
        case None | bool() | int() | str() | Enum():
            return value
        case Mapping():
            # What is nothing is left out.
            result = {name: brief(one) for name, one in value.items()}
            return {name: one for name, one in result.items() if one not in (None, [], {}, False)}
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


def known(evidence: Evidence) -> dict[str, float]:
    """Return the measured evidence without uncertain values."""
    return {name: value for name, value in evidence.measured_values().items() if value and name not in UNSURE}


def told(result: BuildResult) -> dict[str, Any]:
    """Return the numbers of a verdict and of its causes."""
    table, verdict = result.figures, result.verdict
    causes = findings(verdict, table).values()
    return {
        **{row.figure.name: row.value for row in verdict.rows if row.figure.name not in UNSURE},
        "outcomes": {row.figure.name: OUTCOMES.index(row.outcome) for row in verdict.rows if row.outcome != "accept"},
        "causes": {f"{one.figure}, {one.decision.cause.name}": known(one.evidence) for one in causes},
        "cause_frames": {one.figure: len(one.frames) for one in causes},
        "retake": len(retaken_frames(verdict, table)),
        "unfit": [len(table.cells.unfit), *(cell.colour for cell in table.cells.unfit[:MOST_UNFIT])],
    }


def whole(result: BuildResult) -> dict[str, Any]:
    """Return all measured and judged numbers of a build."""
    table = result.figures
    left_out = ("lights", "frames", "session", "origin", "origins", "registration", "cells", "budget", "primaries")
    return told(result) | {
        "frames": together([of_fields(frame, "record", "origin", "consistency") for frame in table.frames]),
        "lights": table.lights,
        "greys": table.greys,
        "registration": of_fields(table.registration, "framing"),
        "framing": of_fields(table.registration.framing, "plane"),
        "budget": {
            one.name: {"lights": _root(one.lights), "cells": np.sqrt(one.cells)}
            for one in table.budget.components
            if one.name not in UNSURE
        },
        "added": table.cells.added,
        "stains": of_fields(table.cells.stains, "level", "places_mm"),
        "fields": numbers_of([one.coefficients for one in table.primaries.fields]) if table.primaries else None,
        "primaries": of_fields(table.primaries, "fields") if table.primaries else None,
        "sensor": of_fields(table.sensor),
        **of_fields(table, *left_out, "sensor"),
    }


def _root(covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a covariance in the unit of its quantity, so that small ones are compared, too."""
    return np.sign(covariance) * np.sqrt(np.abs(covariance))


def written(folder: Path) -> dict[str, Any]:
    """Return the content of a table's folder: samples, lists and corrections."""
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
    """Return recorded corrections with numbers as arrays."""
    return [
        {name: numbers_of(value) if isinstance(value, list) else value for name, value in one.items()} for one in done
    ]


def reported(result: BuildResult) -> dict[str, Any]:
    """Return the content of `report.json` without hashes and constant parts."""

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
