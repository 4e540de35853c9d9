"""How a dataset's images lie: each in its own file, or those of a shard together in one file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Final, Protocol, Self

from generator.dataset.production.plan import ShardJob
from generator.dataset.production.records import FileSum, ImageRecord, Split, image_key
from generator.dataset.store import Pieces, Store, gathered

_SETTLED_IMAGES: Final = 32
_SETTLED_PIXELS: Final = 1 << 23
"""Images, and pixels of them, from which files are brought to the disk while others are made."""


_KINDS: Final = {"images": "", "previews": ".preview", "masks": ".masks", "ground_truth": ".ground_truth"}


def member_name(kind: str, key: str, ending: str) -> str:
    """Return what a file of an image is called where those of a shard lie together: ``000123.masks_0.png``."""
    return f"{key}{_KINDS[kind]}{ending}"


@dataclass(frozen=True)
class Sample:
    """An image with all that goes with it, ready to be written.

    Attributes
    ----------
    record
        Its number, source and ground truth.
    source, split
        Its source's name, and the part of the dataset it belongs to.
    width, height
        px.
    files
        Kind (`images`, `previews`, `masks`), what follows the number in the file's name, and the bytes, which may be
        asked for once; the image first.
    stored
        What is written already.
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
        """The number as it stands in names."""
        return image_key(self.record.number)


Fault = tuple[type[BaseException] | None, BaseException | None, TracebackType | None]
"""What ended a block."""


class ShardWriter(Protocol):
    """Writes the samples of one shard, in a block; files that are still open appear only if the block ends well."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: *Fault) -> None: ...

    def store(self, sample: Sample) -> Sample:
        """Write what can be written by itself and return what `append` is to take; called where the sample was made."""
        ...

    def append(self, sample: Sample) -> None:
        """Take the next sample, in the order of their numbers."""
        ...

    def close(self) -> list[FileSum]:
        """Finish all files, bring them to the disk and return them in the order of their names or numbers."""
        ...


def hold(sample: Sample) -> Sample:
    """Return a sample with all its bytes in memory of their own."""
    return replace(sample, files=tuple((kind, ending, (gathered(data),)) for kind, ending, data in sample.files))


class FolderWriter:
    """Each image in a file of its own: `images/000123.png`, `previews/000123.jpg`.

    Files are brought to the disk by a thread of their own, a few at a time, so that nobody waits for the disk but the
    last of them.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._files: list[FileSum] = []
        self._thread = ThreadPoolExecutor(1)
        self._settling: list[Future[None]] = []
        self._written: list[str] = []
        self._images = self._pixels = 0

    def store(self, sample: Sample) -> Sample:
        """Write the files of a sample, and let go of their bytes."""
        sums: list[FileSum] = []
        for kind, ending, data in sample.files:
            name = f"{kind}/{sample.key}{ending}"
            digest = hashlib.sha256()
            self._store.put(name, _passing(data, digest.update))
            sums.append(FileSum(name=name, sha256=digest.hexdigest()))
        return replace(sample, files=(), stored=tuple(sums))

    def append(self, sample: Sample) -> None:
        """Note the files of a sample."""
        self._files += sample.stored
        self._written += [file.name for file in sample.stored]
        self._images += 1
        self._pixels += sample.width * sample.height
        if self._images >= _SETTLED_IMAGES or self._pixels >= _SETTLED_PIXELS:
            self._settle()

    def _settle(self) -> None:
        self._settling.append(self._thread.submit(self._store.settle, self._written))
        self._written, self._images, self._pixels = [], 0, 0

    def close(self) -> list[FileSum]:
        """Wait until all files are on the disk and return them."""
        self._settle()
        for settled in self._settling:
            settled.result()
        return self._files

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: *Fault) -> None:
        """Leave the files where they are: whoever makes the shard again writes the same."""
        self._thread.shutdown(cancel_futures=True)


def _passing(data: Pieces, see: Callable[[bytes | memoryview], object]) -> Iterator[bytes | memoryview]:
    for piece in data:
        see(piece)
        yield piece


def open_writer(job: ShardJob, store: Store) -> ShardWriter:
    """Return the writer of a shard in the layout that its job asks for."""
    match job.options.layout:
        case "folder":
            return FolderWriter(store)
        case "webdataset":
            from generator.dataset.production.webdataset import TarWriter

            return TarWriter(store, job)
        case "parquet":
            from generator.dataset.production.parquet import ParquetWriter

            return ParquetWriter(store, job)


def read_member(layout: str, store: Store, container: str, file: str) -> bytes:
    """Return the bytes of an image that lies with others in one file.

    Raises
    ------
    FormatError
        The file is missing or damaged, or there is no such image in it.
    """
    if layout == "webdataset":
        from generator.dataset.production import webdataset

        return webdataset.read_member(store, container, file)
    from generator.dataset.production import parquet

    return parquet.read_member(store, container, file)
