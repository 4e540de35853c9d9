"""Records of a data set on disk: description, illuminants, sources, images and shards, and the names of the files.

A shard is a range of planned image numbers, made by one task. Its record is written after all its files are on the
disk, so that a shard is complete exactly if it has a record. `generator.dataset.layouts` defines the image files.
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
    """A record that omits keys with default None if their value is None, so that older files keep their bytes."""

    @model_serializer(mode="wrap")
    def _without_none(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        optional_names = {name for name, field in type(self).model_fields.items() if field.default is None}
        return {key: value for key, value in serialise(self).items() if value is not None or key not in optional_names}


FORMAT: Final = "crop.dataset"
VERSION: Final = 2  # Version of `dataset.json`; raised when an older reader would misread a data set

GROUND_TRUTH: Final = "ground_truth.csv"
GROUND_TRUTH_COLUMNS: Final = ("image", "source", "illumination", "r", "g", "b")
# Optional column of `ground_truth.csv`: expanded uncertainty (k = 2) of the ground truth, degrees.
UNCERTAINTY_COLUMN: Final = "uncertainty_deg"

IMAGES: Final = "images.csv"
SOURCES: Final = "sources.csv"
SOURCE_COLUMNS: Final = ("position", "name", "sha256", "width", "height", "replaced_pixels", "split", "profile", "note")
TRUTHS: Final = "gt.txt"
NAMED_TRUTHS: Final = "named_gt.txt"  # As `TRUTHS`, with the name of the image before the numbers; for other programs
SUMS: Final = "SHA256SUMS"
DATASHEET: Final = "DATASHEET.md"
CARD: Final = "README.md"

# Files that the authors complete by hand, so their hashes are not recorded; this software does not read them.
COMPLETED_BY_HAND: Final = (CARD, DATASHEET)

Triple = tuple[float, float, float]
# Details of one image, by column of `images.csv`; all images of a data set have the same columns.
Details = dict[str, int | float | str]

Layout = Literal["folder", "c5", "webdataset", "parquet"]
Split = Literal["train", "validation", "test"]
SPLITS: Final[tuple[Split, ...]] = ("train", "validation", "test")


class ReadingOptions(Record):
    """The options of a data set that are needed for reading; invalid values are refused."""

    format: Format
    layout: Layout
    previews: bool
    shard_images: int = Field(ge=1, le=1 << 32)


class TableRecord(SparseRecord):
    """The LUT of a data set."""

    sha256: str  # `calibration.table.lut.Lut.sha256`
    camera: str
    bits: int = Field(ge=1, le=8)  # of each colour channel of the chart
    samples: int = Field(ge=1)  # of each patch under each illuminant
    white_level: int = Field(ge=1, le=65535)  # saturation level in counts
    software: str
    computed: dict[str, Any] | None = None  # settings of a computed LUT (`Provenance.computed`)
    lights: int | None = Field(default=None, ge=1)  # number of illuminants
    origin: OriginRecord | None = None  # equipment, date and authors of the frames


class Light(SparseRecord):
    """An illuminant of the LUT that was used."""

    illumination: int  # number in the LUT
    kind: str
    cct_k: float | None
    codes: tuple[int, int, int]  # of the projector; for a computed spectrum, codes of a similar colour
    white: Triple  # ground truth in linear camera RGB, not normalised
    name: str | None = None  # of a computed spectrum
    uncertainty_deg: float | None = None  # expanded uncertainty (k = 2), if the LUT reports it

    @property
    def label(self) -> str:
        """Return a label for users: the name, the temperature of a black body, or the codes."""
        if self.name is not None:
            return self.name
        return f"{self.cct_k:.0f} K" if self.cct_k is not None else "{} {} {}".format(*self.codes)

    @property
    def cell(self) -> str:
        """Return the label for a Markdown table, with the word `codes` if it has codes."""
        return table_cell(self.label if self.name or self.cct_k is not None else f"codes {self.label}")


def table_cell(text: str) -> str:
    """Return a text with Markdown and HTML markup escaped for a Markdown table."""
    return one_line(text).replace("|", "\\|").replace("<", "&lt;")


def one_line(text: str) -> str:
    """Return a text as one line, because names in foreign files may contain line breaks."""
    return " ".join(text.split())


class SourceRecord(Record):
    """A source picture that was used."""

    position: int  # in the list of sources, from 0; the choice of illuminants depends on it
    name: str
    sha256: str | None  # of its file; None for a computed picture
    profile: str | None = None  # treatment of its colour profile; None for a computed picture
    width: int  # of its images, px
    height: int  # of its images, px
    replaced_pixels: int  # pixels with colours that the LUT lists as unfit, replaced by the nearest fit colour
    split: Split | None = None  # None if the data set is not divided
    note: str | None = None  # problems in reading, black or tiny pictures; separated by semicolons


class Skipped(Record):
    """A source picture that could not be read; its image numbers are not used."""

    position: int
    name: str


class LightRow(Record):
    """An illuminant in an image: number in the LUT or label of a mixture, and ground truth with the sum 1."""

    illumination: str
    truth: Triple


class ImageRecord(Record):
    """A generated image; `truth` is the mean of its illuminants over all pixels, with the sum 1."""

    number: int
    position: int
    truth: Triple
    lights: list[LightRow]
    details: Details = Field(default_factory=dict[str, int | float | str])


class FileSum(Record):
    """A file of the data set and its SHA-256."""

    name: str
    sha256: str


class FinishedImage(Record):
    """A finished image of an incomplete shard; `files` are stored in its piece (`foundation.pieces`)."""

    image: ImageRecord
    source: SourceRecord
    files: list[FileSum] = Field(default_factory=list[FileSum], exclude=True)


class RenderingSummary(Record):
    """Results of the rendering of a data set."""

    outside: float | None = None  # mean share of pixels outside of the print's gamut; None if rendered by codes
    distance: float | None = None  # mean colour error over all pixels, degrees; None if rendered by codes
    black_taken: float = 0.0  # mean subtracted share of the black of the print


class ShardRecord(Record):
    """A complete shard."""

    shard: int
    sources: list[SourceRecord]  # in the order of their positions
    skipped: list[Skipped]
    images: list[ImageRecord]  # in the order of their numbers
    files: list[FileSum] = Field(default_factory=list[FileSum], exclude=True)  # stored in its piece
    lights: list[Light]  # used illuminants of the LUT, alone or mixed


class Description(SparseRecord):
    """The content of `dataset.json`; seed, options, LUT and sources determine every byte."""

    format: Literal["crop.dataset"] = FORMAT
    version: Literal[2] = VERSION
    software: str
    libraries: dict[str, str]
    table: TableRecord
    seed: int
    options: dict[str, Any]
    planned: int = Field(ge=0, le=1 << 32)  # number of planned images; missing images leave gaps in the numbers
    images: int = Field(ge=0, le=1 << 32)  # number of generated images
    sources: int = Field(ge=0, le=1 << 32)  # number of sources that were used
    pixels: int = Field(ge=0)  # of all sources
    replaced_pixels: int = Field(ge=0)  # of all sources; see `SourceRecord`
    splits: dict[str, int] = Field(default_factory=dict[str, int])  # images of each split
    lights: list[Light]  # used illuminants of the LUT, alone or mixed
    skipped: list[Skipped]
    rendering: RenderingSummary | None = None  # None if rendered by codes without `--black-point`

    @property
    def parts(self) -> list[str]:
        """Names of the splits with images; `data` if the data set is not divided."""
        return [split for split, images in self.splits.items() if images] or [split_name(None)]


@dataclass(frozen=True, slots=True)
class Entry:
    """One image of a data set.

    Attributes
    ----------
    image
        File name, also in layouts with one file for each shard.
    source
        Name of the source picture.
    lights
        Number in the LUT, or label of the mixture, of each illuminant.
    truths
        Ground truth (r, g, b) of each illuminant, sum 1.
    truth
        Mean of the illuminants over all pixels, sum 1; the ground truth if there is one illuminant.
    split
        Split of the image; None if the data set is not divided.
    """

    image: str
    source: str
    lights: tuple[str, ...]
    truths: tuple[Triple, ...]
    truth: Triple
    split: Split | None = None

    @property
    def illumination(self) -> str:
        """Number in the LUT, or label of the mixture, of the first illuminant."""
        return self.lights[0]


def split_name(split: str | None) -> str:
    """Return the name of a split in file names; `data` if the data set is not divided."""
    return split or "data"


def image_key(number: int) -> str:
    """Return the number of an image in file names, with at least six digits."""
    return f"{number:06d}"


def shard_key(shard: int) -> str:
    """Return the number of a shard in file names."""
    return f"{shard:06d}"


@dataclass(frozen=True)
class Sample:
    """An image with its maps and preview, ready to be written."""

    record: ImageRecord
    source: str  # name of the source picture
    split: Split | None
    width: int  # px
    height: int  # px
    # File kind (`images`, `previews`, `masks`, `ground_truth`), end of the file name, and bytes that can be iterated
    # once; the image is first.
    files: tuple[tuple[str, str, Pieces], ...]
    stored: tuple[FileSum, ...] = ()  # files that are already written

    @property
    def key(self) -> str:
        """Number of the image in file names."""
        return image_key(self.record.number)
