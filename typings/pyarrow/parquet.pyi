from collections.abc import Sequence
from types import TracebackType
from typing import Any, BinaryIO, Self

from pyarrow import Schema, Table

class ParquetWriter:
    is_open: bool
    def __init__(
        self,
        where: Any,
        schema: Schema,
        *,
        compression: str | dict[str, str] = "snappy",
        use_dictionary: bool | Sequence[str] = True,
        write_statistics: bool | Sequence[str] = True,
        store_schema: bool = True,
    ) -> None: ...
    def write_table(self, table: Table, row_group_size: int | None = None) -> None: ...
    def close(self) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

class RowGroupMetaData:
    num_rows: int
    total_byte_size: int

class FileMetaData:
    def row_group(self, i: int) -> RowGroupMetaData: ...

class ParquetFile:
    num_row_groups: int
    schema_arrow: Schema
    metadata: FileMetaData
    def __init__(
        self,
        source: str | BinaryIO,
        *,
        thrift_string_size_limit: int | None = None,
        thrift_container_size_limit: int | None = None,
    ) -> None: ...
    def read_row_group(self, i: int, columns: Sequence[str] | None = None) -> Table: ...
    def read(self, columns: Sequence[str] | None = None) -> Table: ...
