"""Numbers of tables, files and figures of commands and reports, for pinning."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import pytest
from matplotlib.figure import Figure

from tests.pinned.drawn import drawn


def table(text: str) -> dict[str, list[float | None]]:
    """Return the numbers of a CSV text by column."""
    heads, *rows = csv.reader(text.splitlines())
    return {head: _numbers([row[place] for row in rows]) for place, head in enumerate(heads)}


def _numbers(texts: Sequence[str]) -> list[float | None]:
    try:
        return [float(text) if text else None for text in texts]
    except ValueError:
        return []


def contents(path: Path) -> Any:
    """Return the numbers of a CSV or JSON file."""
    match path.suffix:
        case ".csv":
            return table(path.read_text(encoding="utf-8"))
        case ".json":
            return json.loads(path.read_text(encoding="utf-8"))
        case _:
            return None


def recorded_figures(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, list[float]]]:
    """Return a list that collects the numbers of each saved figure; saving itself would take half a second."""
    seen: list[dict[str, list[float]]] = []

    def savefig(self: Figure, stream: BinaryIO, **options: Any) -> None:
        for axes in self.axes:
            # Matplotlib sets the labels of ticks when they are read.
            axes.get_xticklabels()
            axes.get_yticklabels()
        stream.write(b"<svg></svg>")
        seen.append(drawn(self))

    monkeypatch.setattr(Figure, "savefig", savefig)
    return seen
