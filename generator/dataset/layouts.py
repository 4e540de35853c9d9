"""How a dataset's images lie: each in its own file, or those of a shard together in a tar or a Parquet file.

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
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.util import find_spec
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Protocol, Self, cast

from foundation.errors import CropError, FormatError, InputError
from foundation.hashing import HashingWriter
from generator.dataset.records import FileSum, ImageRecord, Layout, Split, image_key, shard_key
from generator.stores import Pieces, Store, joined

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


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


def _read_tar_member(store: Store, container: str, file: str) -> bytes:
    """Return the bytes of the file called `file` in the tar file called `container`.

    Only members that are plain files are looked at: a tar file may also hold links and sparse files, and claim sizes
    that it does not have.
    """
    with store.open(container) as stream:
        try:
            for name, offset, size in _members(stream):
                if name == file:
                    stream.seek(offset)
                    return stream.read(size)
        except (tarfile.TarError, ValueError, OSError) as error:
            raise FormatError(f"{store.place}/{container} is damaged: {error}; make the dataset again") from error
    raise FormatError(f"{store.place}/{container} holds no {file}; make the dataset again")


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


def require_pyarrow() -> None:
    """Refuse where pyarrow is not installed."""
    if find_spec("pyarrow") is None:
        raise InputError("the layout parquet needs pyarrow; install it with: pip install pyarrow")


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


def _read_parquet_member(store: Store, container: str, file: str) -> bytes:
    """Return the bytes of a file, named as in a tar file, of the Parquet file called `container`."""
    require_pyarrow()
    import pyarrow.parquet as pq

    with store.open(container) as stream:
        try:
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
        except CropError:
            raise
        except Exception as error:
            # Whatever a foreign file makes of the library: its own errors, and those of values that are missing.
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise FormatError(f"{store.place}/{container} is damaged: {reason}; make the dataset again") from error
    raise FormatError(f"{store.place}/{container} holds no {file}; make the dataset again")


def require_libraries(layout: Layout) -> None:
    """Refuse a layout whose library is not installed."""
    if layout == "parquet":
        require_pyarrow()


def open_writer(layout: Layout, store: Store, shard: int, *, previews: bool, maps: bool, details: bool) -> ShardWriter:
    """Return the writer of a shard."""
    match layout:
        case "folder":
            return FolderWriter(store)
        case "webdataset":
            return JoinedWriter(store, shard, "tar", _Tar)
        case "parquet":
            columns = schema(previews, maps, details)
            return JoinedWriter(store, shard, "parquet", lambda stream: _Parquet(stream, columns))


def read_member(layout: str, store: Store, container: str, file: str) -> bytes:
    """Return the bytes of a file of an image that lies with others in one file of a shard."""
    read = _read_tar_member if layout == "webdataset" else _read_parquet_member
    return read(store, container, file)
