"""What a dataset is on disk: its description, lights and sources, the record of each shard, and the names of its files.

A shard is a range of planned image numbers that is made by one task. Its record is written when everything else of it
is on the disk: a shard with a record is done, one without is not. How its images lie there is another matter
(`generator.dataset.layouts`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from calibration.citation import OriginRecord
from foundation.records import Record
from generator.files import Format
from generator.stores import Pieces


class SparseRecord(Record):
    """A record of which keys that are None by default are left out while they are, so that files stay as they were."""

    @model_serializer(mode="wrap")
    def _without_none(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        left_out = {name for name, field in type(self).model_fields.items() if field.default is None}
        return {key: value for key, value in serialise(self).items() if value is not None or key not in left_out}


FORMAT: Final = "crop.dataset"
VERSION: Final = 2  # Of `dataset.json`; raised when a reader of the version before would misread a dataset


GROUND_TRUTH: Final = "ground_truth.csv"
GROUND_TRUTH_COLUMNS: Final = ("image", "source", "illumination", "r", "g", "b")
# Column of `ground_truth.csv` on request: what the light's direction may be off by, expanded (k = 2), degrees.
UNCERTAINTY_COLUMN: Final = "uncertainty_deg"

IMAGES: Final = "images.csv"
SOURCES: Final = "sources.csv"
SOURCE_COLUMNS: Final = ("position", "name", "sha256", "width", "height", "replaced_pixels", "split", "profile", "note")
TRUTHS: Final = "gt.txt"
SUMS: Final = "SHA256SUMS"
DATASHEET: Final = "DATASHEET.md"
CARD: Final = "README.md"

# Files that a lab completes, so that no hash of them is recorded; nothing of this software reads them.
COMPLETED_BY_HAND: Final = (CARD, DATASHEET)

Triple = tuple[float, float, float]
# What options did to one image, by column of `images.csv`; all images of a dataset have the same columns.
Details = dict[str, int | float | str]

Layout = Literal["folder", "webdataset", "parquet"]
Split = Literal["train", "validation", "test"]
SPLITS: Final[tuple[Split, ...]] = ("train", "validation", "test")


class ReadingOptions(Record):
    """What of the options of a dataset its readers need; they refuse values that no dataset is made with."""

    format: Format
    layout: Layout
    previews: bool
    shard_images: int = Field(ge=1, le=1 << 32)


class TableRecord(SparseRecord):
    """The table a dataset was made from; `sha256` as `calibration.table.lut.Lut.sha256`.

    `computed` is what the table says of itself where nothing was photographed for it
    (`calibration.table.lut.Provenance.computed`), `lights` how many
    it has, `origin` with what, when and by whom its frames were taken; None where that was not kept.
    """

    sha256: str
    camera: str
    bits: int = Field(ge=1, le=8)
    samples: int = Field(ge=1)
    white_level: int = Field(ge=1, le=65535)
    software: str
    computed: dict[str, Any] | None = None
    lights: int | None = Field(default=None, ge=1)
    origin: OriginRecord | None = None


class Light(SparseRecord):
    """A light of the table that was used; `codes` as projected, `white` the ground truth in linear camera RGB.

    Lights of a table that was computed under spectra of its own have a `name`, and codes that would show their colour.
    `uncertainty_deg` is the expanded uncertainty (k = 2) of its direction, where the table states it.
    """

    illumination: int
    kind: str
    cct_k: float | None
    codes: tuple[int, int, int]
    white: Triple
    name: str | None = None
    uncertainty_deg: float | None = None

    @property
    def label(self) -> str:
        """Return what to call it for a reader: its name, its temperature if a black body, else its codes."""
        if self.name is not None:
            return self.name
        return f"{self.cct_k:.0f} K" if self.cct_k is not None else "{} {} {}".format(*self.codes)

    @property
    def cell(self) -> str:
        """Return the label for a cell of a table in Markdown, and that it is codes where it is."""
        return table_cell(self.label if self.name or self.cct_k is not None else f"codes {self.label}")


def table_cell(text: str) -> str:
    """Return a text that stays in its cell of a table in Markdown and is no markup of HTML."""
    return one_line(text).replace("|", "\\|").replace("<", "&lt;")


def one_line(text: str) -> str:
    """Return a text that no other line of a file follows from: foreign tables name cameras as they like."""
    return " ".join(text.split())


class SourceRecord(Record):
    """A source picture that was used.

    - `position`: place in the list of sources, from 0; the choice of its lights depends on it.
    - `name`, `sha256`: its name, and the hash of its file; no hash where it was made and not read.
    - `profile`: how its colour profile was used, in words; None where it was made and not read.
    - `width`, `height`: size of its images, px.
    - `replaced_pixels`: pixels of colours that the table lists as unfit, which took the nearest fit colour.
    - `split`: the part of the dataset that its images belong to; None where it was not divided.
    - `note`: what is to be known of it, between semicolons: what it took to read it, or that it is black or tiny; None
      for nothing.
    """

    position: int
    name: str
    sha256: str | None
    profile: str | None = None
    width: int
    height: int
    replaced_pixels: int
    split: Split | None = None
    note: str | None = None


class Skipped(Record):
    """A source picture that could not be read; its numbers are left free."""

    position: int
    name: str


class LightRow(Record):
    """A light in an image: its number in the table, or what a mixture is called, and its ground truth of sum 1."""

    illumination: str
    truth: Triple


class ImageRecord(Record):
    """An image that was made; `truth` is the mean of its lights over its pixels, of sum 1; `details` as `Details`."""

    number: int
    position: int
    truth: Triple
    lights: list[LightRow]
    details: Details = Field(default_factory=dict[str, int | float | str])


class FileSum(Record):
    """A file of the dataset and its SHA-256."""

    name: str
    sha256: str


class FinishedImage(Record):
    """An image of a shard that is not done; its `files` are those of its piece."""

    image: ImageRecord
    source: SourceRecord
    files: list[FileSum] = Field(default_factory=list[FileSum], exclude=True)


class RenderingSummary(Record):
    """How the images of a dataset were rendered, where that is not by codes with the print's black kept.

    - `outside`, `distance`: means over all pixels of the columns of `images.csv`: the share of colours that the print
      cannot show, and by how many degrees they are missed. None where images were rendered by codes.
    - `black_taken`: mean over all images of the share of the print's black that was taken out.
    """

    outside: float | None = None
    distance: float | None = None
    black_taken: float = 0.0


class ShardRecord(Record):
    """What a shard made; images and files in the order of their numbers, sources in that of their positions.

    `lights` are those of the table that were used, alone or mixed; `files` are those of the shard's piece.
    """

    shard: int
    sources: list[SourceRecord]
    skipped: list[Skipped]
    images: list[ImageRecord]
    files: list[FileSum] = Field(default_factory=list[FileSum], exclude=True)
    lights: list[Light]


class Description(SparseRecord):
    """The content of `dataset.json`.

    - `seed`, `options`: what the dataset is; with the table and the sources, enough to make every byte again.
    - `planned`, `images`: images planned and made; the numbers of the rest are free.
    - `sources`, `pixels`, `replaced_pixels`: sources used, their pixels together, and those of them whose colour was
      replaced.
    - `splits`: images in each part, where the dataset was divided.
    - `lights`: the lights of the table that were used, alone or mixed.
    - `skipped`: sources that could not be read.
    - `rendering`: how images were rendered; None by codes with the print's black kept.
    """

    format: Literal["crop.dataset"] = FORMAT
    version: Literal[2] = VERSION
    software: str
    libraries: dict[str, str]
    table: TableRecord
    seed: int
    options: dict[str, Any]
    planned: int = Field(ge=0, le=1 << 32)
    images: int = Field(ge=0, le=1 << 32)
    sources: int = Field(ge=0, le=1 << 32)
    pixels: int = Field(ge=0)
    replaced_pixels: int = Field(ge=0)
    splits: dict[str, int] = Field(default_factory=dict[str, int])
    lights: list[Light]
    skipped: list[Skipped]
    rendering: RenderingSummary | None = None

    @property
    def parts(self) -> list[str]:
        """Names of the parts that have images; one, `data`, of a dataset that was not divided."""
        return [part for part, images in self.splits.items() if images] or [part_of(None)]


@dataclass(frozen=True, slots=True)
class Entry:
    """One image.

    - `image`: its file name; in shards the name it would have as a file.
    - `source`: its source's name.
    - `lights`: number in the table, or name of the mixture, of each light in it.
    - `truths`: ground truth (r, g, b) of sum 1 of each light.
    - `truth`: mean of its lights over its pixels, of sum 1: the ground truth where there is one light.
    - `split`: the part of the dataset it belongs to.
    """

    image: str
    source: str
    lights: tuple[str, ...]
    truths: tuple[Triple, ...]
    truth: Triple
    split: Split | None = None

    @property
    def illumination(self) -> str:
        """The light's number in the table or its name; of several the first."""
        return self.lights[0]


def part_of(split: str | None) -> str:
    """Return the name of the part of a dataset that an image belongs to, as file names have it."""
    return split or "data"


def image_key(number: int) -> str:
    """Return the number of an image as file names have it: six digits, more where they are needed."""
    return f"{number:06d}"


def shard_key(shard: int) -> str:
    """Return the number of a shard as file names have it."""
    return f"{shard:06d}"


@dataclass(frozen=True)
class Sample:
    """An image with all that goes with it, ready to be written.

    - `record`: its number, source and ground truth.
    - `source`, `split`: its source's name, and the part of the dataset it belongs to.
    - `width`, `height`: px.
    - `files`: kind (`images`, `previews`, `masks`, `ground_truth`), what follows the number in the file's name, and the
      bytes, which can be iterated over once; the image first.
    - `stored`: files of it that are written already.
    """

    record: ImageRecord
    source: str
    split: Split | None
    width: int
    height: int
    files: tuple[tuple[str, str, Pieces], ...]
    stored: tuple[FileSum, ...] = ()

    @property
    def key(self) -> str:
        """The number as file names have it."""
        return image_key(self.record.number)
