"""Layouts in which the images of a shard lie in one file, tar and Parquet.

docs/formats.md says what lies in a shard: POSIX.1-1988 ustar files whose members are named after the WebDataset
specification, all with one owner, time and mode, so that equal images make equal files; or Parquet files that Hugging
Face `datasets` reads, a row an image, which need pyarrow, the extra `parquet`. There only previews are decoded by
themselves: Pillow, with which `datasets` would decode, keeps 8 of a 16-bit image's bits.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple, Protocol, Self, cast

from foundation.errors import CropError, FormatError
from foundation.files import HashingWriter
from generator.dataset.records import FileSum, Sample, part_of, shard_key
from generator.stores import Store, joined

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


# Arguments of `__exit__`: the type, value and traceback of what ended the block, or None.
ExitReason = tuple[type[BaseException] | None, BaseException | None, TracebackType | None]


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
        name = f"{part_of(sample.split)}/{self._name}"
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


_INFIXES: Final = {"images": "", "previews": ".preview", "masks": ".masks", "ground_truth": ".ground_truth"}


def _member_name(kind: str, key: str, ending: str) -> str:
    """Return the name of a file of an image where the files of a shard lie in one: ``000123.masks_0.png``."""
    return f"{key}{_INFIXES[kind]}{ending}"


class _Tar:
    """A tar file of images and what belongs to each."""

    def __init__(self, stream: HashingWriter) -> None:
        self._tar = tarfile.open(fileobj=cast("Any", stream), mode="w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115

    def append(self, sample: Sample) -> None:
        text = json.dumps(metadata_of(sample), ensure_ascii=False) + "\n"
        for kind, ending, pieces in (*sample.files, ("images", ".json", (text.encode(),))):
            data = joined(pieces)
            header = tarfile.TarInfo(_member_name(kind, sample.key, ending))
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


# Bytes from which a group of rows is written: what a reader has to read to get at one image.
_GROUP_BYTES: Final = 4 << 20

_GROUP_ROWS: Final = 64  # Rows of a group at most: small images stay quick to reach too

# Longest text in the description of a shard, of which the longest of ours are a few kilobytes.
_MOST_THRIFT_BYTES: Final = 64 << 20

_MOST_THRIFT_ITEMS: Final = 1 << 20  # Things that a list in it may hold: ours hold columns and groups, some hundred

_MOST_ROWS: Final = 1 << 16  # Rows of a group that is read: a thousand times those that are written

_COLUMNS: Final = {"images": "image", "previews": "preview", "ground_truth": "ground_truth"}

_FILE = {"decode": False, "_type": "Image"}

_STRING = {"dtype": "string", "_type": "Value"}

_INT = {"dtype": "int64", "_type": "Value"}

_TRUTH = {"feature": {"dtype": "float64", "_type": "Value"}, "length": 3, "_type": "List"}


def _schema(previews: bool, maps: bool, details: bool) -> pa.Schema:
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

    - `ending`: of the name of such a file.
    - `begin`: begins one on a stream.
    - `read`: returns the bytes of an image's file that lies in one, named as in a tar file (``000123.masks_0.png``);
      None where it has no such. Whatever else it raises says that the file is damaged.
    - `library`: by which it is written and read; "" where Python suffices.
    - `is_of_the_hub`: whether Hugging Face's `load_dataset` finds the images in it; else it finds the table of lights.
    - `reading`: for the dataset's card, how images are read without losing bits.
    """

    ending: str
    begin: Callable[[HashingWriter, Beside], _Container]
    read: Callable[[BinaryIO, str], bytes | None]
    library: str
    is_of_the_hub: bool
    reading: str

    def open_writer(self, store: Store, shard: int, beside: Beside) -> JoinedWriter:
        """Return the writer of a shard."""
        return JoinedWriter(store, shard, self.ending, lambda stream: self.begin(stream, beside))

    def name_of(self, kind: str, part: str, shard: int, key: str, ending: str) -> str:
        """Return the name of an image's file: that of its shard in the dataset, and its own in there."""
        return f"{part}/{shard_key(shard)}.{self.ending}/{_member_name(kind, key, ending)}"

    def get(self, store: Store, name: str) -> bytes:
        """Return the bytes of a file by its name."""
        container, _, file = name.rpartition("/")
        with store.open(container) as stream:
            try:
                data = self.read(stream, file)
            except CropError:
                raise
            except Exception as error:
                # Whatever a foreign file makes of the library: its own errors, and those of values that are missing.
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                raise FormatError(f"{store.place}/{container} is damaged: {reason}; make the dataset again") from error
        if data is None:
            raise FormatError(f"{store.place}/{container} holds no {file}; make the dataset again")
        return data

    def patterns(self, parts: Sequence[str], ending: str) -> list[str]:
        """Return the patterns of the files that images lie in."""
        del ending
        return [f"{part}/*.{self.ending}" for part in parts]


_HUB_READING: Final = (
    "`load_dataset` finds the parts. Its decoder, Pillow, keeps 8 of 16 bits: decode the bytes with "
    "`cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)` (then BGR), with "
    '`.cast_column("png", Image(decode=False))` before it in WebDataset shards; or read with '
    "`generator.open_dataset`."
)


# Layouts of shards in one file each by name.
JOINED: Final[Mapping[str, JoinedLayout]] = {
    "webdataset": JoinedLayout(
        ending="tar",
        begin=lambda stream, _: _Tar(stream),
        read=_read_tar,
        library="",
        is_of_the_hub=True,
        reading=_HUB_READING,
    ),
    "parquet": JoinedLayout(
        ending="parquet",
        begin=lambda stream, beside: _Parquet(stream, _schema(*beside)),
        read=_read_parquet,
        library="pyarrow",
        is_of_the_hub=True,
        reading=_HUB_READING,
    ),
}
