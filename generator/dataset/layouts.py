"""What a dataset is on disk: its records, how its images lie, and the cards that describe it to catalogues.

The records are its description, lights and sources, and the record of each shard. A shard is a range of planned image
numbers that is made by one task. Its record is written when everything else of it is on the disk: a shard with a record
is done, one without is not.

Images lie in files, tar or Parquet shards.

WebDataset shards: plain tar files in which the files of an image follow each other under one number.

    000123.png           the image
    000123.json          its ground truth, source and part
    000123.preview.jpg   its preview, where there are previews
    000123.masks_0.png … and 000123.ground_truth.png, where several lights fall on an image

The format is POSIX.1-1988 ustar. Owner, time and mode are the same in every header, so that equal images make equal
files. Layout of names after the WebDataset specification ("key", then everything after the first dot).

Parquet shards that Hugging Face `datasets` reads: one row an image, the file's bytes in it.

The columns::

    image     struct of bytes and path, feature Image that is not decoded by itself: Pillow, with which `datasets` would
              decode, keeps 8 of a 16-bit image's bits
    preview   the same, decoded; where there are previews
    number, source, split, width, height
    truth     [r, g, b] of sum 1, the mean of the lights over the image
    lights    list of illumination and truth
    details   what options did to the image, a JSON object in text; where the dataset has an `images.csv`
    masks, ground_truth   where several lights fall on an image: as images of 16 bits, not decoded by themselves either

Needs pyarrow, the extra `parquet`.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from string import Template
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Literal, NamedTuple, Protocol, Self, cast

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from calibration.citation import OriginRecord, bibtex, origin_lines, table_title
from foundation.errors import CropError, FormatError, InputError
from foundation.files import HashingWriter
from foundation.records import Record
from generator.files import FULL, Format, suffix_of
from generator.stores import Pieces, Store, joined

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


class SparseRecord(Record):
    """A record of which keys that are None by default are left out while they are, so that files stay as they were."""

    @model_serializer(mode="wrap")
    def _without_none(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        left_out = {name for name, field in type(self).model_fields.items() if field.default is None}
        return {key: value for key, value in serialise(self).items() if value is not None or key not in left_out}


FORMAT: Final = "crop.dataset"
VERSION: Final = 2
"""Version 1 listed the sources in `dataset.json`; they have a table of their own since."""
STRETCHED_VERSION: Final = 3
"""Of datasets whose counts are stretched over 16 bits: software that knows nothing of it refuses them, and does not
take their images for more than six times as bright."""

GROUND_TRUTH: Final = "ground_truth.csv"
GROUND_TRUTH_COLUMNS: Final = ("image", "source", "illumination", "r", "g", "b")
UNCERTAINTY_COLUMN: Final = "uncertainty_deg"
"""Column of `ground_truth.csv` on request: what the light's direction may be off by, expanded (k = 2), degrees."""

IMAGES: Final = "images.csv"
SOURCES: Final = "sources.csv"
SOURCE_COLUMNS: Final = ("position", "name", "sha256", "width", "height", "replaced_pixels", "split", "profile", "note")
TRUTHS: Final = "gt.txt"
SUMS: Final = "SHA256SUMS"
DATASHEET: Final = "DATASHEET.md"
CROISSANT: Final = "croissant.json"
CARD: Final = "README.md"

COMPLETED_BY_HAND: Final = (CARD, DATASHEET, CROISSANT)
"""Files that a lab completes, so that no hash of them is recorded; nothing of this software reads them."""

Triple = tuple[float, float, float]
Details = dict[str, int | float | str]
"""What options did to one image, by column of `images.csv`; all images of a dataset have the same columns."""

Layout = Literal["folder", "webdataset", "parquet"]
Scale = Literal["table", "full"]
Split = Literal["train", "validation", "test"]
SPLITS: Final[tuple[Split, ...]] = ("train", "validation", "test")


class ReadingOptions(Record):
    """What of the options of a dataset its readers need; they refuse values that no dataset is made with."""

    format: Format
    layout: Layout = "folder"
    previews: bool
    shard_images: int = Field(default=256, ge=1, le=1 << 32)
    scale: Scale = "table"


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
    - `weight`: by which it was drawn, 1 that of a picture neither favoured nor disfavoured; None where pictures were
      not drawn.
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
    weight: float | None = None


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
    """An image of a shard that is not done; `files` are all of it, which were written before this was."""

    image: ImageRecord
    source: SourceRecord
    files: list[FileSum]


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

    `lights` are those of the table that were used, alone or mixed.
    """

    shard: int
    sources: list[SourceRecord]
    skipped: list[Skipped]
    images: list[ImageRecord]
    files: list[FileSum]
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
    version: Literal[2, 3] = VERSION
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


def image_key(number: int) -> str:
    """Return the number of an image as file names have it: six digits, more where they are needed."""
    return f"{number:06d}"


def shard_key(shard: int) -> str:
    """Return the number of a shard as file names have it."""
    return f"{shard:06d}"


_INFIXES: Final = {"images": "", "previews": ".preview", "masks": ".masks", "ground_truth": ".ground_truth"}


def member_name(kind: str, key: str, ending: str) -> str:
    """Return the name of a file of an image where the files of a shard lie in one: ``000123.masks_0.png``."""
    return f"{key}{_INFIXES[kind]}{ending}"


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


ExitReason = tuple[type[BaseException] | None, BaseException | None, TracebackType | None]
"""Arguments of `__exit__`: the type, value and traceback of what ended the block, or None."""


class ShardWriter(Protocol):
    """Writes the samples of one shard, in a block; files that are still open appear only if the block ends well."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: *ExitReason) -> None: ...

    def store(self, sample: Sample) -> Sample:
        """Write what does not depend on the order of samples and return the sample for `append`.

        Called from the thread that made the sample.
        """
        ...

    def append(self, sample: Sample) -> None:
        """Write the rest of the next sample, in the order of their numbers."""
        ...

    def close(self) -> list[FileSum]:
        """Finish all files, bring them to the disk and return them in the order of their names or numbers."""
        ...


def metadata_of(sample: Sample) -> dict[str, Any]:
    """Return what a shard records of an image beside its pixels, as plain values for JSON."""
    record = sample.record
    plain: dict[str, Any] = {
        "image": record.number,
        "source": sample.source,
        "split": sample.split,
        "width": sample.width,
        "height": sample.height,
        "truth": list(record.truth),
        "lights": [{"illumination": light.illumination, "truth": list(light.truth)} for light in record.lights],
    }
    # What no option asked for is no key: such datasets keep their bytes.
    return plain | {"details": record.details} if record.details else plain


_SYNCED_IMAGES: Final = 32
"""Images from which files are synchronised while others are made: enough that one wait for the disk serves many."""
_SYNCED_PIXELS: Final = 1 << 23
"""Pixels of such images, for the same reason where images are large."""


class FolderWriter:
    """Each image in a file of its own: `images/000123.png`, `previews/000123.jpg`.

    A thread of its own synchronises the files with the disk, a few at a time, while others are made; only the last few
    are waited for.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._files: list[FileSum] = []
        self._thread = ThreadPoolExecutor(1)
        self._syncing: list[Future[None]] = []
        self._written: list[str] = []
        self._images = self._pixels = 0

    def store(self, sample: Sample) -> Sample:
        """Write the files of a sample; return it without their bytes."""
        sums: list[FileSum] = []
        for kind, ending, data in sample.files:
            name = f"{kind}/{sample.key}{ending}"
            with self._store.create(name) as stream:
                hashed = HashingWriter(stream)
                for piece in data:
                    hashed.write(piece)
            sums.append(FileSum(name=name, sha256=hashed.sha256))
        return replace(sample, files=(), stored=tuple(sums))

    def append(self, sample: Sample) -> None:
        """Record the files of a sample."""
        self._files += sample.stored
        self._written += [file.name for file in sample.stored]
        self._images += 1
        self._pixels += sample.width * sample.height
        if self._images >= _SYNCED_IMAGES or self._pixels >= _SYNCED_PIXELS:
            self._sync()

    def _sync(self) -> None:
        self._syncing.append(self._thread.submit(self._store.sync, self._written))
        self._written, self._images, self._pixels = [], 0, 0

    def close(self) -> list[FileSum]:
        """Wait until all files are on the disk and return them."""
        self._sync()
        for synced in self._syncing:
            synced.result()
        return self._files

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: *ExitReason) -> None:
        """Leave the files where they are: whoever makes the shard again writes the same."""
        self._thread.shutdown(cancel_futures=True)


class _Container(Protocol):
    """A file of a shard in which the files of several images lie, while it is written."""

    def append(self, sample: Sample) -> None:
        """Write an image and what belongs to it."""
        ...

    def close(self) -> None:
        """Write the end of the file."""
        ...

    def give_up(self) -> None:
        """Write no end of a file that will not be."""
        ...


class JoinedWriter:
    """The images of a shard in one file, `data/000003.tar` or `.parquet`, or in one for each part of the dataset.

    `begin` makes such a file of the stream that it is written to.
    """

    def __init__(self, store: Store, shard: int, ending: str, begin: Callable[[HashingWriter], _Container]) -> None:
        self._store, self._begin = store, begin
        self._name = f"{shard_key(shard)}.{ending}"
        self._stack = ExitStack()
        self._open: dict[str, tuple[_Container, HashingWriter]] = {}

    def store(self, sample: Sample) -> Sample:
        """Return the sample with its bytes computed: such a file takes its images one after the other."""
        return replace(sample, files=tuple((kind, ending, (joined(data),)) for kind, ending, data in sample.files))

    def append(self, sample: Sample) -> None:
        """Write an image and what belongs to it."""
        name = f"{sample.split or 'data'}/{self._name}"
        if name not in self._open:
            hashed = HashingWriter(self._stack.enter_context(self._store.create(name)))
            self._open[name] = (self._begin(hashed), hashed)
        self._open[name][0].append(sample)

    def close(self) -> list[FileSum]:
        """Finish the files, bring them to the disk and return them."""
        for container, _ in self._open.values():
            container.close()
        self._stack.close()
        self._store.sync(self._open)
        return [FileSum(name=name, sha256=self._open[name][1].sha256) for name in sorted(self._open)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: *ExitReason) -> None:
        """Leave no half file behind."""
        for container, _ in self._open.values():
            container.give_up()
        self._stack.__exit__(*error)


class _Tar:
    """A tar file of images and what belongs to each."""

    def __init__(self, stream: HashingWriter) -> None:
        self._tar = tarfile.open(fileobj=cast("Any", stream), mode="w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115

    def append(self, sample: Sample) -> None:
        text = json.dumps(metadata_of(sample), ensure_ascii=False) + "\n"
        for kind, ending, pieces in (*sample.files, ("images", ".json", (text.encode(),))):
            data = joined(pieces)
            header = tarfile.TarInfo(member_name(kind, sample.key, ending))
            header.size = len(data)
            header.mode = 0o644
            self._tar.addfile(header, io.BytesIO(data))

    def close(self) -> None:
        self._tar.close()

    def give_up(self) -> None:
        pass


def _read_tar(stream: BinaryIO, file: str) -> bytes | None:
    """Return the bytes of a file in a tar file.

    Only members that are plain files are looked at: a tar file may also hold links and sparse files, and claim sizes
    that it does not have.
    """
    for name, offset, size in _members(stream):
        if name == file:
            stream.seek(offset)
            return stream.read(size)
    return None


def _members(stream: BinaryIO) -> Iterator[tuple[str, int, int]]:
    """Yield name, offset and size of the plain files of a tar file (POSIX.1-1988, ustar), as they follow each other."""
    end = stream.seek(0, io.SEEK_END)
    offset = 0
    while offset < end:
        stream.seek(offset)
        block = stream.read(tarfile.BLOCKSIZE)
        if not any(block):
            return
        header = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        offset += tarfile.BLOCKSIZE
        if not 0 <= header.size <= end - offset:
            raise tarfile.ReadError(f"{header.name!r} claims {header.size} bytes, {end - offset} are left")
        if header.type in (tarfile.REGTYPE, tarfile.AREGTYPE):
            yield header.name, offset, header.size
        offset += -(-header.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


_GROUP_BYTES: Final = 4 << 20
"""Bytes from which a group of rows is written: what a reader has to read to get at one image."""
_GROUP_ROWS: Final = 64
"""Rows of a group at most: small images stay quick to reach too."""

_MOST_THRIFT_BYTES: Final = 64 << 20
"""Longest text in the description of a shard, of which the longest of ours are a few kilobytes."""
_MOST_THRIFT_ITEMS: Final = 1 << 20
"""Things that a list in it may hold: ours hold columns and groups, some hundred."""
_MOST_ROWS: Final = 1 << 16
"""Rows of a group that is read: a thousand times those that are written."""

_COLUMNS: Final = {"images": "image", "previews": "preview", "ground_truth": "ground_truth"}

_FILE = {"decode": False, "_type": "Image"}
_STRING = {"dtype": "string", "_type": "Value"}
_INT = {"dtype": "int64", "_type": "Value"}
_TRUTH = {"feature": {"dtype": "float64", "_type": "Value"}, "length": 3, "_type": "List"}


def schema(previews: bool, maps: bool, details: bool) -> pa.Schema:
    """Return the columns, and in their metadata the features as `datasets` reads them."""
    import pyarrow as pa

    file = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    truth = pa.list_(pa.float64(), 3)
    columns: list[tuple[str, pa.DataType, Any]] = [
        ("image", file, _FILE),
        ("preview", file, {"_type": "Image"}),
        ("number", pa.int64(), _INT),
        ("source", pa.string(), _STRING),
        ("split", pa.string(), _STRING),
        ("width", pa.int64(), _INT),
        ("height", pa.int64(), _INT),
        ("truth", truth, _TRUTH),
        (
            "lights",
            pa.list_(pa.struct([("illumination", pa.string()), ("truth", truth)])),
            {"feature": {"illumination": _STRING, "truth": _TRUTH}, "_type": "List"},
        ),
        ("details", pa.string(), _STRING),
        ("masks", pa.list_(file), {"feature": _FILE, "_type": "List"}),
        ("ground_truth", file, _FILE),
    ]
    left_out = {"preview": not previews, "details": not details, "masks": not maps, "ground_truth": not maps}
    kept = [column for column in columns if not left_out.get(column[0])]
    features = {name: feature for name, _, feature in kept}
    info = json.dumps({"info": {"features": features}})
    return pa.schema([(name, kind) for name, kind, _ in kept]).with_metadata({"huggingface": info})


class _Parquet:
    """A Parquet file with one row an image."""

    def __init__(self, stream: HashingWriter, columns: pa.Schema) -> None:
        import pyarrow.parquet as pq

        self._schema = columns
        # Images are compressed already, and the few numbers beside them are not worth a reader's trouble.
        self._writer: pq.ParquetWriter = pq.ParquetWriter(
            stream, self._schema, compression="none", use_dictionary=False, write_statistics=["number"]
        )
        self._rows: list[dict[str, Any]] = []
        self._size = 0

    def append(self, sample: Sample) -> None:
        metadata = metadata_of(sample)
        row: dict[str, Any] = {"number": metadata.pop("image"), **metadata, "masks": []}
        if "details" in row:
            row["details"] = json.dumps(row["details"], ensure_ascii=False)
        for kind, ending, pieces in sample.files:
            data = joined(pieces)
            self._size += len(data)
            file = {"bytes": data, "path": f"{sample.key}{ending}"}
            if kind == "masks":
                row["masks"].append(file)
            else:
                row[_COLUMNS[kind]] = file
        self._rows.append(row)
        if self._size >= _GROUP_BYTES or len(self._rows) >= _GROUP_ROWS:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._writer.close()

    def give_up(self) -> None:
        self._writer.is_open = False

    def _flush(self) -> None:
        import pyarrow as pa

        if self._rows:
            self._writer.write_table(pa.Table.from_pylist(self._rows, self._schema))
        self._rows, self._size = [], 0


def _cell_of(file: str) -> tuple[str, int | None]:
    """Return the column that has a file, named as in a tar file, and its place where it is one of several."""
    kind = file.split(".")[1:-1]
    if not kind:
        return "image", None
    name, several, place = kind[0].partition("masks_")
    return ("masks", int(place)) if several else (name, None)


def _read_parquet(stream: BinaryIO, file: str) -> bytes | None:
    """Return the bytes of a file, named as in a tar file, in a Parquet file."""
    import pyarrow.parquet as pq

    number = int(file.partition(".")[0])
    column, place = _cell_of(file)
    size = stream.seek(0, 2)
    table = pq.ParquetFile(
        stream, thrift_string_size_limit=_MOST_THRIFT_BYTES, thrift_container_size_limit=_MOST_THRIFT_ITEMS
    )
    for group in range(table.num_row_groups):
        # Our writer compresses nothing: a group that claims more than the file has is none of ours.
        known = table.metadata.row_group(group)
        if not (0 <= known.num_rows <= _MOST_ROWS and 0 <= known.total_byte_size <= 2 * size + 65536):
            raise ValueError(f"it claims {known.num_rows} rows of {known.total_byte_size} bytes in a group")
        numbers = table.read_row_group(group, ["number"]).column("number").to_pylist()
        if number in numbers:
            cells = table.read_row_group(group, [column]).column(column).to_pylist()
            cell = cells[numbers.index(number)]
            data = (cell if place is None else cell[place])["bytes"]
            if not isinstance(data, bytes):
                raise ValueError(f"{file} is no file")
            return data
    return None


class Beside(NamedTuple):
    """What a dataset has beside images and their lights: previews, maps of several lights, what options did."""

    previews: bool
    maps: bool
    details: bool


@dataclass(frozen=True)
class JoinedLayout:
    """A layout in which the images of a shard lie in one file.

    - `ending`, `media`: of such a file: its name's, and its media type.
    - `begin`: begins one on a stream.
    - `read`: returns the bytes of an image's file that lies in one, named by `member_name`; None where it has no such.
      Whatever else it raises says that the file is damaged.
    - `library`: by which it is written and read; "" where Python suffices.
    - `is_of_the_hub`: whether Hugging Face's `load_dataset` finds the images in it; else it finds the table of lights.
    - `reading`: for the dataset's card, how images are read without losing bits.
    - `columns`: name, type and description of those that Croissant's loaders find in it.
    """

    ending: str
    media: str
    begin: Callable[[HashingWriter, Beside], _Container]
    read: Callable[[BinaryIO, str], bytes | None]
    library: str
    is_of_the_hub: bool
    reading: str
    columns: tuple[tuple[str, str, str], ...]


_HUB_READING: Final = (
    "`load_dataset` finds the parts. Its decoder, Pillow, keeps 8 of 16 bits: decode the bytes with "
    "`cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)` (then BGR), with "
    '`.cast_column("png", Image(decode=False))` before it in WebDataset shards; or read with '
    "`generator.open_dataset`."
)

JOINED: Final[Mapping[str, JoinedLayout]] = {
    "webdataset": JoinedLayout(
        ending="tar",
        media="application/x-tar",
        begin=lambda stream, _: _Tar(stream),
        read=_read_tar,
        library="",
        is_of_the_hub=True,
        reading=_HUB_READING,
        # Members of archives that a pattern names cannot be told to loaders; WebDataset's own reader finds them.
        columns=(),
    ),
    "parquet": JoinedLayout(
        ending="parquet",
        media="application/x-parquet",
        begin=lambda stream, beside: _Parquet(stream, schema(*beside)),
        read=_read_parquet,
        library="pyarrow",
        is_of_the_hub=True,
        reading=_HUB_READING,
        columns=(
            ("number", "sc:Integer", "Number of the image."),
            ("source", "sc:Text", "Name of the picture that it shows."),
            ("width", "sc:Integer", "Width, px."),
            ("height", "sc:Integer", "Height, px."),
        ),
    ),
}
"""By name all layouts but `folder`, in which each image is a file of its own."""


def library_of(layout: str) -> str:
    """Return the library by which a layout is written and read; "" where Python suffices."""
    return JOINED[layout].library if layout in JOINED else ""


def require_library(layout: str) -> None:
    """Refuse a layout whose library is not installed."""
    library = library_of(layout)
    if library and find_spec(library) is None:
        raise InputError(f"the layout {layout} needs {library}; install it with: pip install {library}")


def open_writer(layout: Layout, store: Store, shard: int, beside: Beside) -> ShardWriter:
    """Return the writer of a shard."""
    if layout == "folder":
        return FolderWriter(store)
    joined = JOINED[layout]
    return JoinedWriter(store, shard, joined.ending, lambda stream: joined.begin(stream, beside))


def read_member(layout: str, store: Store, container: str, file: str) -> bytes:
    """Return the bytes of a file of an image that lies with others in one file of a shard."""
    require_library(layout)
    with store.open(container) as stream:
        try:
            data = JOINED[layout].read(stream, file)
        except CropError:
            raise
        except Exception as error:
            # Whatever a foreign file makes of the library: its own errors, and those of values that are missing.
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise FormatError(f"{store.place}/{container} is damaged: {reason}; make the dataset again") from error
    if data is None:
        raise FormatError(f"{store.place}/{container} holds no {file}; make the dataset again")
    return data


def name_of(description: Description) -> str:
    """Return what the dataset is called until its makers name it."""
    return f"CroP images of the {_one_line(description.table.camera)}, {counted_images(description)}"


def counted_images(description: Description) -> str:
    """Return the number of images in words."""
    return f"{description.images} image" + "s" * (description.images != 1)


def kind_of(description: Description) -> str:
    """Return in words whether colours were photographed, simulated or computed: no reader may take one for another."""
    table = description.table
    if table.computed is not None:
        return "The table behind them was computed from spectra and a model of the sensor; nothing was photographed."
    rig = None if table.origin is None else table.origin.rig
    if rig == "simulated":
        return "The table behind them was taken in a simulated laboratory; nothing was photographed."
    if rig is None:
        return "The table behind them does not record whether its frames were photographed or simulated."
    return "The table behind them was made from raw frames of a printed chart under a projector's lights."


def summary_of(description: Description) -> str:
    """Return what the images are, in two sentences."""
    table = description.table
    return (
        f"{counted_images(description)} of linear camera RGB as the raw sensor of the {_one_line(table.camera)} would "
        "give them, each with the exact colour of its light. Black is 0, saturation "
        f"{stored_white(description)}; nothing is white balanced. {kind_of(description)}"
    )


def stored_white(description: Description) -> int:
    """Return the number that saturation has in the files."""
    return FULL if option(description, "scale") == "full" else description.table.white_level


def brightness_note(description: Description) -> str:
    """Return why a reader that knows nothing of raw images shows them as it does, and what to do about it."""
    white = stored_white(description)
    if option(description, "format") == "dng":
        return "Images are raw files: open them with a raw developer."
    if option(description, "scale") == "full":
        counts = description.table.white_level
        return (
            f"Counts of 0 to {counts} are stretched over 16 bits: the camera's count is round(v * {counts} / {FULL}). "
            "Images are linear, so that they still look darker than photographs: for display divide by the ground "
            "truth and apply the sRGB curve."
        )
    return (
        f"A reader that takes {FULL} for white, as WebDataset's decoders, imageio and image viewers do, shows them "
        f"nearly black: {white} is white here. Divide by {white} after decoding all 16 bits, or make the dataset with "
        "generate --scale full. Previews show what they look like."
    )


def origin_table(description: Description) -> list[tuple[str, str]]:
    """Return what the table says of its origin, names and values; what it does not say is "not recorded"."""
    return [(name, _one_line(value)) for name, value in origin_lines(description.table.origin)]


def citation_of(description: Description) -> str:
    """Return a BibTeX entry of the table."""
    table = description.table
    computed = table.computed is not None
    return bibtex(table.camera, table.lights, table.software, table.sha256, table.origin, computed)


def table_name(description: Description) -> str:
    """Return what the table is called."""
    table = description.table
    return _one_line(table_title(table.camera, table.lights, table.origin, table.computed is not None))


def truth_of(description: Description) -> str:
    """Return in words where the ground truth comes from."""
    if description.table.computed is not None:
        return "it is what the model of the sensor answers to bare paper under the light's spectrum."
    return "it is the mean of the white references that lie among the colours, under the same light."


def pixels_of(description: Description) -> str:
    """Return in words how a pixel comes from the table's samples, by the rendering of the dataset."""
    samples = description.table.samples
    if option(description, "rendering") is None:
        return (
            f"Each pixel is one of the {samples} samples that the table has of its colour, drawn by the seed; where "
            "lights mix, one of each."
        )
    return (
        "Each pixel is the mean of its colour, interpolated between cells of the table, plus the deviation of one of "
        f"the {samples} samples of the nearest cell from their mean, drawn by the seed and scaled to the noise at that "
        "level; where lights mix, of each."
    )


def noise_of(description: Description) -> str:
    """Return in words how many electrons a count is and what noise a sample has, as far as the table says it."""
    green = "Green is the mean of two photosites, so that its noise has half the variance of one."
    table = description.table
    if table.computed is None:
        return f"Gain and read noise are in `report.html` of the table, as measured. {green}"
    try:
        body, iso = table.computed["body"], float(table.computed["exposure"]["iso"])
        gain, read, early = (float(body[name]) for name in ("electrons_per_dn", "read_noise_dn", "sensor_noise_e"))
    except (KeyError, TypeError, ValueError):
        return f"The table does not state gain and read noise. {green}"
    stretched = f"; a count is {FULL / table.white_level:.4g} of the files' units" * (
        option(description, "scale") == "full"
    )
    return (
        f"In the model of the sensor a count is {gain * 100 / iso:.4g} electrons at its ISO {iso:g}{stretched}; "
        f"at ISO 100 it is {gain:.4g}, and the read noise of a photosite {read:.4g} counts, of which {early:.4g} "
        f"electrons arise before the amplifier. {green}"
    )


def _repeats(description: Description) -> str:
    """Return in words whether pictures come more than once."""
    if description.images <= description.sources:
        return "Each picture is in one image."
    return "Images of one picture repeat it, or parts of it, under another light or with other noise."


def _procedure(description: Description) -> str:
    """Return in words how the table's colours were obtained and what vouches for them."""
    name = table_name(description)
    if description.table.computed is not None:
        return (
            f"{name}: samples of all colours of a chart were computed under known lights. No frame was taken, and "
            "there is no report; `computed` under `table` in `dataset.json` has the model and its settings."
        )
    return (
        f"A chart of all colours under known lights: {name}. The table's report has the verdict on it and every figure "
        "with its limit."
    )


def option(description: Description, name: str) -> Any:
    """Return an option as `dataset.json` has it; None where it was off."""
    return description.options.get(name)


def table_cell(text: str) -> str:
    """Return a text that stays in its cell of a table in Markdown and is no markup of HTML."""
    return _one_line(text).replace("|", "\\|").replace("<", "&lt;")


def _one_line(text: str) -> str:
    """Return a text that no other line of a file follows from: foreign tables name cameras as they like."""
    return " ".join(text.split())


CONFORMS_TO: Final = "http://mlcommons.org/croissant/1.0"

_CONTEXT: Final = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
"""The context that the specification recommends, "Appendix 1: JSON-LD context"."""

_MEDIA: Final = {
    "png": "image/png",
    "tiff": "image/tiff",
    "exr": "image/x-exr",
    "jxl": "image/jxl",
    "dng": "image/x-adobe-dng",
}
"""Media types of the formats of images; those of OpenEXR and DNG are not registered with IANA."""

_TRUTH_COLUMNS: Final = (
    ("image", "sc:Text", "Name of the image, as in the images' files or shards."),
    ("source", "sc:Text", "Name of the picture that it shows."),
    ("illumination", "sc:Text", "Number of its light in the table, or the mixture of lights."),
    ("r", "sc:Float", "Red of the light on bare paper, linear camera RGB, r + g + b = 1."),
    ("g", "sc:Float", "Green of the light."),
    ("b", "sc:Float", "Blue of the light."),
)


def croissant(description: Description, sums: Mapping[str, str]) -> str:
    """Return the text of croissant.json."""
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": name_of(description),
        "description": summary_of(description),
        "conformsTo": CONFORMS_TO,
        "version": "1.0.0",
        "keywords": ["colour constancy", "white balance", "illumination estimation", "raw images"],
        "citeAs": citation_of(description),
        "isLiveDataset": False,
        "distribution": [
            *(_table_file(name, sums[name]) for name in (GROUND_TRUTH, SOURCES)),
            *_files_of_images(description),
        ],
        "recordSet": [_ground_truth(), *_images(description)],
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _table_file(name: str, sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "encodingFormat": "text/csv",
        "sha256": sha256,
    }


def _files_of_images(description: Description) -> list[dict[str, Any]]:
    """Return the set of files that holds the images: themselves, or the shards that they lie in."""
    joined = _joined(description)
    if joined is None:
        suffix = suffix_of(option(description, "format"))
        media = _MEDIA.get(str(option(description, "format")), "application/octet-stream")
        return [_file_set("image-files", [f"images/*{suffix}"], media)]
    return [_file_set("shards", [f"{part}/*.{joined.ending}" for part in _parts(description)], joined.media)]


def _joined(description: Description) -> JoinedLayout | None:
    """Return the layout of a dataset; None where each image is a file of its own."""
    return JOINED.get(option(description, "layout"))


def _parts(description: Description) -> list[str]:
    """Return the folders in which a dataset's shards lie."""
    return [part for part, images in description.splits.items() if images] or ["data"]


def _file_set(name: str, includes: list[str], media: str) -> dict[str, Any]:
    return {"@type": "cr:FileSet", "@id": name, "name": name, "encodingFormat": media, "includes": includes}


def _ground_truth() -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": "ground_truth",
        "name": "ground_truth",
        "description": "The lights of the images: a row a light, in the order of the images.",
        "field": [
            _field("ground_truth", name, kind, text, {"fileObject": {"@id": GROUND_TRUTH}, "extract": {"column": name}})
            for name, kind, text in _TRUTH_COLUMNS
        ],
    }


def _images(description: Description) -> list[dict[str, Any]]:
    """Return the records of images: their files, or the columns of their shards."""
    joined = _joined(description)
    if joined is not None:
        fields = [
            _field("images", name, kind, text, {"fileSet": {"@id": "shards"}, "extract": {"column": name}})
            for name, kind, text in joined.columns
        ]
        if not fields:
            return []
    else:
        fields = [
            _field(
                "images", "name", "sc:Text", "Name of the file.",
                {"fileSet": {"@id": "image-files"}, "extract": {"fileProperty": "filename"}},
            ),
            _field(
                "images", "content", "sc:ImageObject", "The image, linear camera RGB; keep all 16 bits.",
                {"fileSet": {"@id": "image-files"}, "extract": {"fileProperty": "content"}},
            ),
        ]  # fmt: skip
    return [
        {
            "@type": "cr:RecordSet",
            "@id": "images",
            "name": "images",
            "description": "The images, as they lie in the dataset.",
            "field": fields,
        }
    ]


def _field(record: str, name: str, kind: str, text: str, source: dict[str, Any]) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{record}/{name}",
        "name": name,
        "description": text,
        "dataType": kind,
        "source": source,
    }


OPEN: Final = "**TO BE ANSWERED BY THE LAB.**"
"""What stands where only the makers of a dataset know the answer."""


def uncertainty_of(description: Description) -> str:
    """Return in a sentence how well the lights are known."""
    known = [light.uncertainty_deg for light in description.lights if light.uncertainty_deg is not None]
    if not known:
        return "The table does not state what its lights may be off by."
    return (
        f"By the table's uncertainty budget the directions of its lights are known to {median(known):.2g}° in the "
        f"median and {max(known):.2g}° at worst (expanded uncertainty, k = 2, about 95 % of lights; `uncertainty_deg` "
        "in `dataset.json`). Differences between methods below that are none."
    )


def datasheet(description: Description) -> str:
    """Return the text of DATASHEET.md."""
    template = Template((Path(__file__).parent / "datasheet.md").read_text("utf-8"))
    table, origin = description.table, dict(origin_table(description))
    authors = "" if table.origin is None else "; ".join(table.origin.authors)
    splits = "; ".join(f"{part}: {images} images" for part, images in description.splits.items())
    by_colour = option(description, "rendering") is not None
    rendering = "by codes: a picture's 8-bit sRGB value is the code of a printed cell"
    answers: dict[str, object] = {
        "authors": f"The table: {authors}. The dataset: {OPEN}" if authors else OPEN,
        "camera": table.camera,
        "citation": citation_of(description),
        "dates": "No frame was taken for the table."
        if table.computed is not None
        else f"The table's frames: {origin['Dates']}.",
        "format": option(description, "format"),
        "images": counted_images(description),
        "kind": kind_of(description),
        "layout": option(description, "layout"),
        "licence": origin["Licence"],
        "lights": len(description.lights),
        "name": name_of(description),
        "noise": noise_of(description),
        "open": OPEN,
        "origin": "\n".join(f"| {name} | {table_cell(value)} |" for name, value in origin.items()),
        "pixels": description.pixels,
        "pixels_are": pixels_of(description),
        "procedure": _procedure(description),
        "rendering": "colorimetrically, interpolated between the cells of the chart" if by_colour else rendering,
        "replaced": description.replaced_pixels,
        "repeats": _repeats(description),
        "seed": description.seed,
        "skipped": len(description.skipped),
        "software": description.software,
        "sources": description.sources,
        "splits": f"{splits}. All images of a picture are in one part."
        if splits
        else "None; keep all images of a picture in one part.",
        "summary": summary_of(description),
        "table": table.sha256,
        "table_software": table.software,
        "truth": truth_of(description),
        "uncertainty": uncertainty_of(description),
        "white_level": stored_white(description),
    }
    # The makers of the dataset are asked for whether or not those of the table are known.
    return template.substitute(answers, count=template.template.count("${open}") + 1)


_SIZES = (
    (1_000, "n<1K"),
    (10_000, "1K<n<10K"),
    (100_000, "10K<n<100K"),
    (1_000_000, "100K<n<1M"),
    (10_000_000, "1M<n<10M"),
    (100_000_000, "10M<n<100M"),
    (1_000_000_000, "100M<n<1B"),
)
"""Numbers of images below which a data set is of a size category of the Hub."""

_TAGS = ("color-constancy", "white-balance", "illumination-estimation", "raw-images", "image")


def size_category(images: int) -> str:
    """Return the Hub's size category of a number of images."""
    return next((name for limit, name in _SIZES if images < limit), "1B<n<10B")


def card(description: Description) -> str:
    """Return the text of README.md; the licence is left open, for pictures have one of their own."""
    lights = "".join(f"| {light.illumination} | {_light_cell(light)} |\n" for light in description.lights[:20])
    more = f"\nand {len(description.lights) - 20} more in `dataset.json`.\n" if len(description.lights) > 20 else ""
    origin = "".join(f"| {name} | {table_cell(value)} |\n" for name, value in origin_table(description))
    splits = ", ".join(f"{part} {images}" for part, images in description.splits.items()) or "not divided"
    return (
        f"---\n{_front_matter(description)}---\n\n# {name_of(description)}\n\n{summary_of(description)}\n\n"
        f"- **Images**: {description.images}, of {description.sources} pictures; parts: {splits}\n"
        f"- **Ground truth**: `ground_truth.csv`, r + g + b = 1, a row a light; `gt.txt`, a line an image\n"
        f"- **Made by** {description.software}, seed {description.seed}; `dataset.json` has enough to make every byte "
        f"again, `SHA256SUMS` the hash of every file but this one, `{DATASHEET}` and `{CROISSANT}`\n"
        f"- **More**: [{DATASHEET}]({DATASHEET}) (Datasheets for Datasets), [{CROISSANT}]({CROISSANT}) (MLCommons)\n\n"
        f"## Reading\n\n{_reading(description)}\n\n{brightness_note(description)}\n\n"
        f"## Noise\n\n{pixels_of(description)} {noise_of(description)}\n\n"
        f"## Licence\n\n**To be stated by whoever publishes**: images are made of pictures, which have licences of "
        f"their own (`sources.csv` names them), and of the table, whose licence is in the list below. Put the result "
        f"into the front matter, in place of `unknown`.\n\n"
        f"## The table\n\n{kind_of(description)} Its hash is `{description.table.sha256}`.\n\n"
        f"| | |\n|---|---|\n{origin}\n"
        f"## Lights\n\n| number | light |\n|---|---|\n{lights}{more}\n"
        f"## Citation\n\n```bibtex\n{citation_of(description)}```\n"
    )


def _front_matter(description: Description) -> str:
    """Return the YAML between the lines of three hyphens."""
    keys: dict[str, object] = {
        "pretty_name": name_of(description),
        "license": "unknown",
        "tags": list(_TAGS),
        "size_categories": [size_category(description.images)],
        "annotations_creators": ["machine-generated"],
    }
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in keys.items()]
    return "".join(lines) + _configs(description)


def _configs(description: Description) -> str:
    """Return where the files of each part lie; of plain files the table of ground truths is what rows are read from."""
    joined = _joined(description)
    if joined is None or not joined.is_of_the_hub:
        files = "  - split: train\n    path: ground_truth.csv\n"
    else:
        files = "".join(
            f"  - split: {'train' if part == 'data' else part}\n    path: {part}/*.{joined.ending}\n"
            for part in _parts(description)
        )
    return f"configs:\n- config_name: default\n  data_files:\n{files}"


def _reading(description: Description) -> str:
    """Return how the images are read without losing bits."""
    form, joined = option(description, "format"), _joined(description)
    if joined is not None:
        return joined.reading
    return (
        f"`images/NNNNNN.{form}` are linear, 16 bits where the format has them; `load_dataset` gives the rows of "
        "`ground_truth.csv`, whose column `image` names the file. Pillow, and imageio by it, keep 8 of 16 bits of a "
        "PNG: use `cv2.imread(path, cv2.IMREAD_UNCHANGED)` (then BGR) or `generator.open_dataset`."
    )


def _light_cell(light: Light) -> str:
    return table_cell(light.label if light.name or light.cct_k is not None else f"codes {light.label}")
