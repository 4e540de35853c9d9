"""Writers and readers of the layouts, by the layout's name."""

from __future__ import annotations

from generator.dataset.production.layouts.plain_files import FolderWriter
from generator.dataset.production.layouts.samples import ShardWriter
from generator.dataset.production.records import Layout
from generator.stores.store import Store


def require_libraries(layout: Layout) -> None:
    """Refuse a layout whose library is not installed."""
    if layout == "parquet":
        from generator.dataset.production.layouts.parquet import require_pyarrow

        require_pyarrow()


def open_writer(layout: Layout, store: Store, shard: int, *, previews: bool, maps: bool, details: bool) -> ShardWriter:
    """Return the writer of a shard."""
    match layout:
        case "folder":
            return FolderWriter(store)
        case "webdataset":
            from generator.dataset.production.layouts.webdataset import TarWriter

            return TarWriter(store, shard)
        case "parquet":
            from generator.dataset.production.layouts.parquet import ParquetWriter

            return ParquetWriter(store, shard, previews, maps, details)


def read_member(layout: str, store: Store, container: str, file: str) -> bytes:
    """Return the bytes of a file of an image that lies with others in one file of a shard."""
    if layout == "webdataset":
        from generator.dataset.production.layouts import webdataset

        return webdataset.read_member(store, container, file)
    from generator.dataset.production.layouts import parquet

    return parquet.read_member(store, container, file)
