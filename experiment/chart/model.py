"""The chart: every printed cell, tag and reference patch with its place on the sheet, and its file `chart.json`.

A value without behaviour of its own: `experiment.chart.layout` designs one, `experiment.chart.printing` prints it,
registration and sampling read it. Every cell is explicit, so a reader needs no knowledge of the layout rule.
Millimetres on the print, origin at its top-left corner, x right, y down. Knows nothing of cameras or pixels.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from foundation.errors import FormatError
from foundation.files import reading_error, write_atomic
from foundation.records import from_json

FORMAT = "crop.chart"
VERSION = 1  # `format` and `version` of the `chart.json` that this software writes and reads (docs/formats.md)

PAPER_WHITE = (255, 255, 255)  # Printed code of bare paper: no ink

# Family of the AprilTags: codes of 36 bits, any two of which differ in 11 or more (E. Olson, ICRA 2011).
TAG_FAMILY = "36h11"

# Modules along the black square of a tag 36h11: 6 of data and a black border of one; the white rim comes on top.
TAG_MODULES = 8


def colour_of_index(index: npt.ArrayLike, bits: int) -> npt.NDArray[np.uint8]:
    """Return the 8-bit RGB codes printed for colour indices.

    `bits`: bits kept of each channel, 1 … 5 (the paper's 5 gives 32³ colours, section 3.2). Returns (..., 3) uint8, the
    8 − bits low bits zero.
    """
    index = np.asarray(index)
    mask = (1 << bits) - 1
    channels = np.stack([index >> (2 * bits) & mask, index >> bits & mask, index & mask], axis=-1)
    return (channels << (8 - bits)).astype(np.uint8)


@dataclass(frozen=True)
class Tag:
    """One AprilTag: `corners_mm` (4, 2) float64, the black square's corners clockwise from its top-left."""

    family: str
    id: int
    corners_mm: npt.NDArray[np.float64]


_STRICT = ConfigDict(extra="ignore", allow_inf_nan=False, strict=True)
_Point = tuple[float, float]
_Length = Annotated[float, Field(gt=0)]
_Size = tuple[_Length, _Length]
_Code = Annotated[int, Field(ge=0, le=255)]
_Colour = Annotated[int, Field(ge=0, lt=8**5)]


@dataclass(frozen=True)
class Reference:
    """One achromatic patch; `rgb` is the printed code, (255, 255, 255) bare paper."""

    __pydantic_config__ = _STRICT

    name: str
    rgb: tuple[_Code, _Code, _Code]
    centre_mm: _Point
    size_mm: _Size

    @property
    def is_white(self) -> bool:
        """Whether the patch is bare paper."""
        return self.rgb == PAPER_WHITE


@dataclass(frozen=True, eq=False)
class Chart:
    """A whole chart.

    - `page_mm`: width and height of the sheet.
    - `bits`: bits kept of each channel, 1 … 5; the chart has 8**bits colours, each exactly once.
    - `cell_mm`: width and height of a cell.
    - `centres_mm`: (8**bits, 2) float64, centre of each cell, in the file's order.
    - `colours`: (8**bits,) int64, colour index of each cell, in the same order.
    - `tags`, `references`: fiducials and achromatic patches; a print without fiducials has none.
    - `seed`, `software`: what the chart was designed with and by, if its file states it; printed in the margin.
    """

    page_mm: tuple[float, float]
    bits: int
    cell_mm: tuple[float, float]
    centres_mm: npt.NDArray[np.float64]
    colours: npt.NDArray[np.int64]
    tags: tuple[Tag, ...]
    references: tuple[Reference, ...]
    seed: int | None = None
    software: str | None = None

    @property
    def colour_count(self) -> int:
        """Number of colours, 8**bits."""
        return 8**self.bits

    @cached_property
    def rgb(self) -> npt.NDArray[np.uint8]:
        """(8**bits, 3) uint8 printed code of each cell, in the file's order."""
        return colour_of_index(self.colours, self.bits)

    @cached_property
    def cell_of_colour(self) -> npt.NDArray[np.int64]:
        """(8**bits,) int64: position in `centres_mm` of each colour index."""
        position = np.empty(self.colour_count, dtype=np.int64)
        position[self.colours] = np.arange(self.colour_count)
        return position

    @property
    def white_references(self) -> tuple[Reference, ...]:
        """The patches of bare paper."""
        return tuple(reference for reference in self.references if reference.is_white)

    def to_json(self) -> str:
        """Return the text of `chart.json`; equal charts give equal text, and what is read from it gives it again."""
        document = {
            "format": FORMAT,
            "version": VERSION,
            "page_mm": [float(side) for side in self.page_mm],
            "bits": self.bits,
            "cell_mm": [float(side) for side in self.cell_mm],
            "cells": {"centre_mm": self.centres_mm.round(6).tolist(), "colour": self.colours.tolist()},
            "tags": [
                {"family": tag.family, "id": tag.id, "corners_mm": tag.corners_mm.round(6).tolist()}
                for tag in self.tags
            ],
            "references": [
                {
                    "name": reference.name,
                    "rgb": list(reference.rgb),
                    "centre_mm": [round(float(value), 6) for value in reference.centre_mm],
                    "size_mm": [float(side) for side in reference.size_mm],
                }
                for reference in self.references
            ],
        }
        # A chart that does not know them gives the text it was read from, so that its hash stays its name.
        document |= {
            key: value for key, value in (("seed", self.seed), ("software", self.software)) if value is not None
        }
        return json.dumps(document, separators=(",", ":")) + "\n"

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of `to_json`, the chart's name in provenance."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    def save(self, path: Path) -> None:
        """Write `chart.json`."""
        write_atomic(path, self.to_json())


class _Strict(BaseModel):
    model_config = _STRICT


class _Cells(_Strict):
    centre_mm: list[_Point]
    colour: list[_Colour]


class _Tag(_Strict):
    family: str
    id: int = Field(ge=0)
    corners_mm: tuple[_Point, _Point, _Point, _Point]


class _Document(_Strict):
    format: Literal["crop.chart"]
    version: Literal[1]
    page_mm: _Size
    bits: int = Field(ge=1, le=5)
    cell_mm: _Size
    cells: _Cells
    tags: list[_Tag]
    references: tuple[Reference, ...]
    seed: int | None = Field(default=None, ge=0)
    software: str | None = None


def load_chart(path: Path) -> Chart:
    """Read `chart.json`."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise reading_error(path, error, "name the chart.json of the print", "chart") from error
    if path.suffix.lower() != ".json" and not text.lstrip().startswith(b"{"):
        remedy = "name chart.json, which acquire chart writes beside what is printed"
        raise FormatError("no description of a chart, but another file", about=path, remedy=remedy)
    document = from_json(_Document, text, path, "restore it from a copy")
    count = 8**document.bits
    colours = np.asarray(document.cells.colour, dtype=np.int64)
    if len(document.cells.centre_mm) != len(colours) or not np.array_equal(
        np.sort(colours), np.arange(count, dtype=np.int64)
    ):
        raise FormatError(
            f"{path}: a chart of {document.bits} bits has one cell for each of its {count} colours, "
            f"this one has {len(document.cells.centre_mm)} centres and {len(colours)} colours"
        )
    numbers = [(tag.family, tag.id) for tag in document.tags]
    if len(set(numbers)) != len(numbers):
        raise FormatError(
            f"{path}: each tag of a chart has its own number, here they are {[tag.id for tag in document.tags]}"
        )
    return Chart(
        page_mm=document.page_mm,
        bits=document.bits,
        cell_mm=document.cell_mm,
        centres_mm=np.asarray(document.cells.centre_mm, dtype=np.float64).reshape(count, 2),
        colours=colours,
        tags=tuple(Tag(tag.family, tag.id, np.asarray(tag.corners_mm, dtype=np.float64)) for tag in document.tags),
        references=document.references,
        seed=document.seed,
        software=document.software,
    )
