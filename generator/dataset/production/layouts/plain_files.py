"""The layout `folder`: each image in a file of its own."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Final, Self

from foundation.hashing import HashingWriter
from generator.dataset.production.layouts.samples import ExitReason, Sample
from generator.dataset.production.records import FileSum
from generator.stores.store import Store

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
