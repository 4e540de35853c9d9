"""Layouts with one file for each shard: tar and Parquet; docs/formats.md describes them.

Tar files (POSIX.1-1988 ustar) follow the WebDataset specification. Parquet files have one row for each image, for
Hugging Face `datasets`, and need pyarrow (the extra `parquet`). Equal images give equal files.
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
from generator.dataset.records import FileSum, Sample, shard_key, split_name
from generator.stores import Store, join_pieces

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


# Type of the arguments of `__exit__`: type, value and traceback of an exception, or None.
ExitReason = tuple[type[BaseException] | None, BaseException | None, TracebackType | None]


def metadata_of(sample: Sample) -> dict[str, Any]:
    """Return the metadata of an image in a shard, as plain values for JSON."""
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
    # Unused options add no key, so that data sets without them keep their bytes between versions.
    return plain | {"details": record.details} if record.details else plain


class _Container(Protocol):
    """An open file of a shard that takes several images."""

    def append(self, sample: Sample) -> None:
        """Write the files of an image."""
        ...

    def close(self) -> None:
        """Write the end of the file."""
        ...

    def give_up(self) -> None:
        """Close without completing the file, after an error."""
        ...


class JoinedWriter:
    """Writes the images of a shard to one file for each split, such as `data/000003.tar`.

    `start` opens a container on the stream of such a file.
    """

    def __init__(self, store: Store, shard: int, ending: str, start: Callable[[HashingWriter], _Container]) -> None:
        self._store, self._start = store, start
        self._name = f"{shard_key(shard)}.{ending}"
        self._stack = ExitStack()
        self._open: dict[str, tuple[_Container, HashingWriter]] = {}

    def store(self, sample: Sample) -> Sample:
        """Return the sample with its bytes in memory; `append` writes them, because the file is sequential."""
        return replace(sample, files=tuple((role, ending, (join_pieces(data),)) for role, ending, data in sample.files))

    def append(self, sample: Sample) -> None:
        """Write the files of an image."""
        name = f"{split_name(sample.split)}/{self._name}"
        if name not in self._open:
            hashed = HashingWriter(self._stack.enter_context(self._store.create(name)))
            self._open[name] = (self._start(hashed), hashed)
        self._open[name][0].append(sample)

    def close(self) -> list[FileSum]:
        """Complete the files, synchronise them with the disk; return their names and hashes."""
        for container, _ in self._open.values():
            container.close()
        self._stack.close()
        self._store.sync(self._open)
        return [FileSum(name=name, sha256=self._open[name][1].sha256) for name in sorted(self._open)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: *ExitReason) -> None:
        """Remove incomplete files."""
        for container, _ in self._open.values():
            container.give_up()
        self._stack.__exit__(*error)


_INFIXES: Final = {"images": "", "previews": ".preview", "masks": ".masks", "ground_truth": ".ground_truth"}


def _member_name(file_kind: str, key: str, ending: str) -> str:
    return f"{key}{_INFIXES[file_kind]}{ending}"


class _Tar:
    """A tar file of images."""

    def __init__(self, stream: HashingWriter) -> None:
        self._tar = tarfile.open(fileobj=cast("Any", stream), mode="w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115

    def append(self, sample: Sample) -> None:
        text = json.dumps(metadata_of(sample), ensure_ascii=False) + "\n"
        for file_kind, ending, pieces in (*sample.files, ("images", ".json", (text.encode(),))):
            data = join_pieces(pieces)
            # Owner, time and mode are constant, so that equal images give equal files.
            header = tarfile.TarInfo(_member_name(file_kind, sample.key, ending))
            header.size = len(data)
            header.mode = 0o644
            self._tar.addfile(header, io.BytesIO(data))

    def close(self) -> None:
        self._tar.close()

    def give_up(self) -> None:
        pass


def _read_tar(stream: BinaryIO, file: str) -> bytes | None:
    # Only plain files are read, because a foreign tar file may contain links, sparse files and false sizes.
    for name, offset, size in _members(stream):
        if name == file:
            stream.seek(offset)
            return stream.read(size)
    return None


def _members(stream: BinaryIO) -> Iterator[tuple[str, int, int]]:
    """Yield name, offset and size of the plain files of a tar file (POSIX.1-1988, ustar)."""
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
            raise tarfile.ReadError(f"{header.name!r} declares {header.size} bytes, but only {end - offset} follow")
        if header.type in (tarfile.REGTYPE, tarfile.AREGTYPE):
            yield header.name, offset, header.size
        offset += -(-header.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


# Bytes after which a group of rows is written: a reader must read a whole group to get one image.
_GROUP_BYTES: Final = 4 << 20

_GROUP_ROWS: Final = 64  # Largest number of rows in a group, for the same reason if images are small

# The next three limits bound the memory for reading foreign files.
# Longest text in the metadata, bytes; our files have some kB.
_MOST_TEXT_BYTES: Final = 64 << 20

_MOST_LIST_ITEMS: Final = 1 << 20  # Longest list in the metadata; our files have some hundred columns and groups

_MOST_ROWS: Final = 1 << 16  # Largest number of rows in a group; a thousand times `_GROUP_ROWS`

_COLUMNS: Final = {"images": "image", "previews": "preview", "ground_truth": "ground_truth"}

_FILE = {"decode": False, "_type": "Image"}

_STRING = {"dtype": "string", "_type": "Value"}

_INT = {"dtype": "int64", "_type": "Value"}

_TRUTH = {"feature": {"dtype": "float64", "_type": "Value"}, "length": 3, "_type": "List"}


def _schema(extras: Extras) -> pa.Schema:
    # The metadata have the features for `datasets`. Only previews are decoded: `datasets` decodes with Pillow, which
    # keeps 8 of 16 bits.
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
    without_maps = not extras.maps
    left_out = {
        **{"preview": not extras.previews, "details": not extras.details},
        **{"masks": without_maps, "ground_truth": without_maps},
    }
    used_columns = [column for column in columns if not left_out.get(column[0])]
    features = {name: feature for name, _, feature in used_columns}
    info = json.dumps({"info": {"features": features}})
    return pa.schema([(name, data_type) for name, data_type, _ in used_columns]).with_metadata({"huggingface": info})


class _Parquet:
    """A Parquet file with one row for each image."""

    def __init__(self, stream: HashingWriter, columns: pa.Schema) -> None:
        import pyarrow.parquet as pq

        self._schema = columns
        # Images are already compressed, and compressing the few other values would save little.
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
        for file_kind, ending, pieces in sample.files:
            data = join_pieces(pieces)
            self._size += len(data)
            file = {"bytes": data, "path": f"{sample.key}{ending}"}
            if file_kind == "masks":
                row["masks"].append(file)
            else:
                row[_COLUMNS[file_kind]] = file
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


def _column_of(file: str) -> tuple[str, int | None]:
    # Returns the column of a file that is named as in a tar file. If this column has lists, also the index in the list.
    infix = file.split(".")[1:-1]
    if not infix:
        return "image", None
    name, mask_prefix, index = infix[0].partition("masks_")
    return ("masks", int(index)) if mask_prefix else (name, None)


def _read_parquet(stream: BinaryIO, file: str) -> bytes | None:
    import pyarrow.parquet as pq

    number = int(file.partition(".")[0])
    column, index = _column_of(file)
    size = stream.seek(0, 2)
    table = pq.ParquetFile(
        stream, thrift_string_size_limit=_MOST_TEXT_BYTES, thrift_container_size_limit=_MOST_LIST_ITEMS
    )
    for group in range(table.num_row_groups):
        # Our files are not compressed, so a group that declares more bytes than the file is damaged or foreign.
        row_group = table.metadata.row_group(group)
        if not (0 <= row_group.num_rows <= _MOST_ROWS and 0 <= row_group.total_byte_size <= 2 * size + 65536):
            raise ValueError(
                f"a group declares {row_group.num_rows} rows of {row_group.total_byte_size} bytes, expected at most "
                f"{_MOST_ROWS} rows of {2 * size + 65536} bytes"
            )
        numbers = table.read_row_group(group, ["number"]).column("number").to_pylist()
        if number in numbers:
            cells = table.read_row_group(group, [column]).column(column).to_pylist()
            cell = cells[numbers.index(number)]
            data = (cell if index is None else cell[index])["bytes"]
            if not isinstance(data, bytes):
                raise ValueError(f"{file} has no bytes, expected some")
            return data
    return None


class Extras(NamedTuple):
    """Content of a data set besides its images, and its camera."""

    previews: bool
    maps: bool  # masks and ground truth maps of several illuminants
    details: bool  # columns of `images.csv`
    camera: str
    # ColorMatrix and ForwardMatrix of the camera (`generator.rendering.matrices.dng_matrices`); None if not needed
    matrices: tuple[list[list[float]], list[list[float]]] | None = None


@dataclass(frozen=True)
class JoinedLayout:
    """A layout with one file for each shard."""

    ending: str  # of the file name
    start: Callable[[HashingWriter, Extras], _Container]  # opens a container on a stream
    # Returns the bytes of a file named as in a tar file (``000123.masks_0.png``), or None; raises if damaged.
    read: Callable[[BinaryIO, str], bytes | None]
    library: str  # required Python library, or ""
    is_read_by_hugging_face: bool  # `load_dataset` reads the images; else it reads the table of ground truths
    reading: str  # text of the card: how to read images with all bits

    def open_writer(self, store: Store, shard: int, extras: Extras) -> JoinedWriter:
        """Return the writer of a shard."""
        return JoinedWriter(store, shard, self.ending, lambda stream: self.start(stream, extras))

    def name_of(self, file_kind: str, split_name: str, shard: int, key: str, ending: str, camera: str) -> str:
        """Return the name of a file of an image: the file of its shard, and the name inside."""
        del camera
        return f"{split_name}/{shard_key(shard)}.{self.ending}/{_member_name(file_kind, key, ending)}"

    def get(self, store: Store, name: str) -> bytes:
        """Return the bytes of a file by its name."""
        container, _, file = name.rpartition("/")
        with store.open(container, scattered=True) as stream:
            try:
                data = self.read(stream, file)
            except CropError:
                raise
            except Exception as error:
                # A damaged file may raise any error of the library, or one about missing values.
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                raise FormatError(f"{store.location}/{container} is damaged: {reason}; copy it again") from error
        if data is None:
            raise FormatError(f"{store.location}/{container} lacks the listed file {file}; make the data set again")
        return data

    def patterns(self, split_names: Sequence[str], ending: str, camera: str) -> list[str]:
        """Return the glob patterns of the files with images."""
        del ending, camera
        return [f"{split_name}/*.{self.ending}" for split_name in split_names]


_HUB_READING: Final = (
    "`load_dataset` reads the splits. Its decoder, Pillow, keeps only 8 of 16 bits. Decode the bytes with "
    "`cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)` (in BGR order), after "
    '`.cast_column("png", Image(decode=False))` for WebDataset shards, or read images with '
    "`generator.open_dataset`."
)


# Layouts of shards in one file each by name.
JOINED: Final[Mapping[str, JoinedLayout]] = {
    "webdataset": JoinedLayout(
        ending="tar",
        start=lambda stream, _: _Tar(stream),
        read=_read_tar,
        library="",
        is_read_by_hugging_face=True,
        reading=_HUB_READING,
    ),
    "parquet": JoinedLayout(
        ending="parquet",
        start=lambda stream, extras: _Parquet(stream, _schema(extras)),
        read=_read_parquet,
        library="pyarrow",
        is_read_by_hugging_face=True,
        reading=_HUB_READING,
    ),
}
