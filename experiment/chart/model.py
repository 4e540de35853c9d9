"""The chart as data: positions of all printed patches, tags and references, and the file `chart.json`.

`experiment.chart.layout` designs a chart, and `experiment.chart.printing` draws it. Registration and sampling only need
the positions of the patches, not the rule of the layout. Positions are in millimetres on the print: the origin is its
top-left corner, x to the right, y down.
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
VERSION = 1  # Values of `format` and `version` in `chart.json` (docs/formats.md)

PAPER_WHITE = (255, 255, 255)  # Printed code of bare paper: no ink

# Family of the AprilTags: codes of 36 bits, any two of which differ in at least 11 bits (E. Olson, ICRA 2011).
TAG_FAMILY = "36h11"

# Number of modules (small squares) along the black square of a tag: 6 for data, and one for the border on each side.
# The white rim is outside the square.
TAG_MODULES = 8


def colour_of_index(index: npt.ArrayLike, bits: int) -> npt.NDArray[np.uint8]:
    """Return the printed 8-bit RGB codes (..., 3) uint8 of colour indices; unused low bits are 0.

    `bits`: bits per channel, 1 … 5. Banić et al. (2019, section 3.2) use 5 bits, that is 32³ colours.
    """
    index = np.asarray(index)
    mask = (1 << bits) - 1
    channels = np.stack([index >> (2 * bits) & mask, index >> bits & mask, index & mask], axis=-1)
    return (channels << (8 - bits)).astype(np.uint8)


@dataclass(frozen=True)
class Tag:
    """One AprilTag."""

    family: str
    id: int
    corners_mm: npt.NDArray[np.float64]  # (4, 2), corners of the black square, clockwise from the top-left


_STRICT = ConfigDict(extra="ignore", allow_inf_nan=False, strict=True)
_Point = tuple[float, float]
_Length = Annotated[float, Field(gt=0)]
_Size = tuple[_Length, _Length]
_Code = Annotated[int, Field(ge=0, le=255)]
_Colour = Annotated[int, Field(ge=0, lt=8**5)]


@dataclass(frozen=True)
class Reference:
    """One achromatic area. `rgb` is its printed code; (255, 255, 255) is bare paper."""

    __pydantic_config__ = _STRICT

    name: str
    rgb: tuple[_Code, _Code, _Code]
    centre_mm: _Point
    size_mm: _Size

    @property
    def is_white(self) -> bool:
        """Whether the reference is bare paper."""
        return self.rgb == PAPER_WHITE


@dataclass(frozen=True, eq=False)
class Chart:
    """A chart.

    Parameters
    ----------
    page_mm
        Width and height of the sheet.
    bits
        Bits per channel, 1 … 5. The chart contains each of the 8**bits colours once.
    cell_mm
        Width and height of a patch.
    centres_mm
        (8**bits, 2) float64, centre of each patch, in the order of `chart.json`.
    colours
        (8**bits,) int64, colour index of each patch, in the same order.
    tags, references
        AprilTags (possibly none), and achromatic areas.
    seed, software
        Seed of the layout and version of the software that designed it; None if unknown. Both are printed in the
        margin.
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
        """(8**bits, 3) uint8, printed code of each patch, in the order of `chart.json`."""
        return colour_of_index(self.colours, self.bits)

    @cached_property
    def cell_of_colour(self) -> npt.NDArray[np.int64]:
        """(8**bits,) int64, row in `centres_mm` of each colour index."""
        position = np.empty(self.colour_count, dtype=np.int64)
        position[self.colours] = np.arange(self.colour_count)
        return position

    @property
    def white_references(self) -> tuple[Reference, ...]:
        """References that are bare paper."""
        return tuple(reference for reference in self.references if reference.is_white)

    def to_json(self) -> str:
        """Return the text of `chart.json`, which is the same for equal charts."""
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
        # Keys without a value are omitted. Thus a chart that was read has the hash of its file.
        document |= {
            key: value for key, value in (("seed", self.seed), ("software", self.software)) if value is not None
        }
        return json.dumps(document, separators=(",", ":")) + "\n"

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of `to_json`, which identifies the chart in provenance."""
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
    """Read `chart.json`; `FormatError` if it is not a valid chart."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise reading_error(path, error, "give the chart.json of the print", "chart") from error
    if path.suffix.lower() != ".json" and not text.lstrip().startswith(b"{"):
        remedy = "give chart.json, which acquire chart writes next to the files to print"
        raise FormatError("not a chart, expected the JSON text of chart.json", about=path, remedy=remedy)
    document = from_json(_Document, text, path, "restore it from a copy")
    count = 8**document.bits
    colours = np.asarray(document.cells.colour, dtype=np.int64)
    if len(document.cells.centre_mm) != len(colours) or not np.array_equal(
        np.sort(colours), np.arange(count, dtype=np.int64)
    ):
        raise FormatError(
            f"{path}: {len(document.cells.centre_mm)} centres and {len(colours)} colours, but a chart of "
            f"{document.bits} bits has one patch for each of its {count} colours; restore the file from a copy"
        )
    tag_names = [(tag.family, tag.id) for tag in document.tags]
    if len(set(tag_names)) != len(tag_names):
        raise FormatError(
            f"{path}: the tags have the ids {[tag.id for tag in document.tags]}, but each id may occur only once; "
            "restore the file from a copy"
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
