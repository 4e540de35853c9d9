"""What commands and reports show, as few plain values to be pinned: tables by column, words of pages, figures."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from html import unescape
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.figure import Figure

from evaluation.results.tables import Table
from foundation.version import software
from tests.pinned import WHOLE
from tests.pinned.drawn import drawn

# What is shown is of any kind.


def unversioned(text: str) -> str:
    """Return a text without the version of the suite, and without the day on which it made something."""
    return re.sub(r"SOFTWARE on \d{4}-\d\d-\d\d", "SOFTWARE on DAY", text.replace(software(), "SOFTWARE"))


def printed(text: str) -> list[str]:
    """Return what a command prints, line by line, without the lines about tables and blanks between their cells."""
    lines = (re.sub(" +", " ", line).strip() for line in unversioned(text).splitlines())
    return [line for line in lines if line and line[0] not in "┏┡├└"]


MANY = 15
"""Texts from which a column is told by its kinds and their places; numbers above so many by their sums."""


def numbers(values: Any) -> npt.NDArray[np.float64]:
    """Return numbers as an array (N,), nothing as NaN; many followed by zeros, so that they are kept by their sums."""
    found = np.array(values, dtype=np.float64).ravel()
    return np.pad(found, (0, WHOLE)) if len(found) > MANY else found


def column(values: Sequence[Any]) -> Any:
    """Return numbers and nothing (NaN) as an array, many texts by their kinds, others as they are."""
    if all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in values):
        return numbers(values)
    parts = [compact(value) for value in values]
    if all(isinstance(part, np.ndarray) for part in parts) and len({part.shape for part in parts}) == 1:
        return np.stack(parts)
    if len(parts) > MANY and all(isinstance(part, str) for part in parts):
        kinds = list(dict.fromkeys(parts))
        return {"texts": kinds, "places": numbers([kinds.index(part) for part in parts])}
    return parts


def compact(value: Any) -> Any:
    """Return what JSON holds, records of the same names as columns, without versions of the suite and of libraries."""
    match value:
        case Mapping():
            return {str(name): compact(part) for name, part in value.items() if name != "libraries"}
        case str():
            return unversioned(value)
        case list() | tuple():
            rows = cast("list[Any]", value)
            if len(rows) > 1 and all(isinstance(row, dict) and list(row) == list(rows[0]) for row in rows):
                return {name: column([row[name] for row in rows]) for name in rows[0]}
            return column(rows)
        case _:
            return value


def _field(text: str) -> str | float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return unversioned(text)


def lines(shown: Table) -> list[str]:
    """Return a table as people read it, a line a row."""
    rows = [" | ".join(row) for row in (shown.columns, *shown.texts())]
    return [shown.title, *rows, *shown.notes]


def table(text: str) -> Any:
    """Return the columns of a CSV text by their heads."""
    heads, *rows = csv.reader(text.splitlines())
    return {head: column([_field(row[place]) for row in rows]) for place, head in enumerate(heads)}


def words(page: str) -> list[str]:
    """Return the texts of an HTML page piece by piece, but no plain numbers, which tables hold with all digits."""
    seen = re.sub(r"(?s)<(style|script|svg)\b.*?</\1>", "", page)
    pieces = (unescape(piece).strip() for piece in re.split(r"<[^>]*>", seen))
    return [unversioned(piece) for piece in pieces if re.search("[a-z]", piece)]


def contents(path: Path) -> Any:
    """Return what a file of a report holds: a table, a record, words, or lines; of others that it is there."""
    match path.suffix:
        case ".csv":
            return table(path.read_text(encoding="utf-8"))
        case ".json":
            return compact(json.loads(path.read_text(encoding="utf-8")))
        case ".html":
            return words(path.read_text(encoding="utf-8"))
        case ".tex":
            return path.read_text(encoding="utf-8").splitlines()
        case _:
            return ""


def figure_seen(figure: Figure) -> dict[str, Any]:
    """Return the words of a figure, and its numbers in one array for each kind of artist."""
    size, *artists = drawn(figure)
    texts: dict[str, None] = {}
    known: dict[str, list[float]] = {"size": size}
    for kind, *shown in artists:
        for one in _leaves(shown):
            if isinstance(one, str):
                texts[one] = None
            elif one is not None:
                known.setdefault(kind, []).append(float(one))
    return {"texts": [*texts], **{kind: numbers(values) for kind, values in known.items()}}


def _leaves(value: Any) -> Iterator[Any]:
    match value:
        case Mapping():
            for part in value.values():
                yield from _leaves(part)
        case list() | tuple():
            for part in value:
                yield from _leaves(part)
        case _:
            yield value


def recorded_figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list to which what each figure shows is added in place of being saved, which takes half a second."""
    seen: list[Any] = []

    def savefig(self: Figure, stream: BinaryIO, **options: Any) -> None:
        for axes in self.axes:
            # Labels are written when they are asked for.
            axes.get_xticklabels()
            axes.get_yticklabels()
        stream.write(b"<svg></svg>")
        seen.append(figure_seen(self))

    monkeypatch.setattr(Figure, "savefig", savefig)
    return seen
