"""Parquet shards that Hugging Face `datasets` reads: one row an image, the file's bytes in it.

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

import json
from contextlib import ExitStack
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Self

from foundation.errors import CropError, FormatError, InputError
from foundation.hashing import HashingWriter
from generator.dataset.production.layouts.samples import ExitReason, Sample, in_memory, metadata_of
from generator.dataset.production.records import FileSum, shard_key
from generator.stores.store import Store

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

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


class _Part:
    """One file that is being written."""

    def __init__(self, stream: BinaryIO, columns: pa.Schema) -> None:
        import pyarrow.parquet as pq

        self.hashed = HashingWriter(stream)
        self._schema = columns
        # Images are compressed already, and the few numbers beside them are not worth a reader's trouble.
        self._writer: pq.ParquetWriter = pq.ParquetWriter(
            self.hashed, self._schema, compression="none", use_dictionary=False, write_statistics=["number"]
        )
        self._rows: list[dict[str, Any]] = []
        self._size = 0

    def append(self, row: dict[str, Any], size: int) -> None:
        self._rows.append(row)
        self._size += size
        if self._size >= _GROUP_BYTES or len(self._rows) >= _GROUP_ROWS:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._writer.close()

    def give_up(self) -> None:
        """Keep pyarrow from writing the end of a file that will not be."""
        self._writer.is_open = False

    def _flush(self) -> None:
        import pyarrow as pa

        if self._rows:
            self._writer.write_table(pa.Table.from_pylist(self._rows, self._schema))
        self._rows, self._size = [], 0


class ParquetWriter:
    """Writes the images of a shard to `data/000003.parquet`, or to one file for each part of the dataset."""

    def __init__(self, store: Store, shard: int, previews: bool, maps: bool, details: bool) -> None:
        self._store = store
        self._shard = shard_key(shard)
        self._schema = schema(previews, maps, details)
        self._stack = ExitStack()
        self._parts: dict[str, _Part] = {}

    def store(self, sample: Sample) -> Sample:
        """Return the sample encoded: a Parquet file takes its rows one after the other."""
        return in_memory(sample)

    def append(self, sample: Sample) -> None:
        """Write the row of an image."""
        name = f"{sample.split or 'data'}/{self._shard}.parquet"
        if name not in self._parts:
            self._parts[name] = _Part(self._stack.enter_context(self._store.create(name)), self._schema)
        metadata = metadata_of(sample)
        row: dict[str, Any] = {"number": metadata.pop("image"), **metadata, "masks": []}
        if "details" in row:
            row["details"] = json.dumps(row["details"], ensure_ascii=False)
        size = 0
        for kind, ending, pieces in sample.files:
            data = b"".join(pieces)
            size += len(data)
            file = {"bytes": data, "path": f"{sample.key}{ending}"}
            if kind == "masks":
                row["masks"].append(file)
            else:
                row[_COLUMNS[kind]] = file
        self._parts[name].append(row, size)

    def close(self) -> list[FileSum]:
        """Finish the files, bring them to the disk and return them."""
        for part in self._parts.values():
            part.close()
        self._stack.close()
        self._store.sync(self._parts)
        return [FileSum(name=name, sha256=self._parts[name].hashed.sha256) for name in sorted(self._parts)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: *ExitReason) -> None:
        """Leave no half file behind."""
        for part in self._parts.values():
            part.give_up()
        self._stack.__exit__(*error)


def _cell_of(file: str) -> tuple[str, int | None]:
    """Return the column that has a file, named as in a tar file, and its place where it is one of several."""
    kind = file.split(".")[1:-1]
    if not kind:
        return "image", None
    name, several, place = kind[0].partition("masks_")
    return ("masks", int(place)) if several else (name, None)


def read_member(store: Store, container: str, file: str) -> bytes:
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
