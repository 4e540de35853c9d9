"""WebDataset shards: plain tar files in which the files of an image follow each other under one number.

    000123.png           the image
    000123.json          its ground truth, source and part
    000123.preview.jpg   its preview, where there are previews
    000123.masks_0.png … and 000123.ground_truth.png, where several lights fall on an image

The format is POSIX.1-1988 ustar. Owner, time and mode are the same in every header, so that equal images make equal
files. Layout of names after the WebDataset specification ("key", then everything after the first dot).
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any, BinaryIO, Self, cast

from foundation.errors import FormatError
from foundation.hashing import HashingWriter
from generator.dataset.production.layouts.samples import ExitReason, Sample, in_memory, member_name, metadata_of
from generator.dataset.production.records import FileSum, shard_key
from generator.stores.store import Store


class TarWriter:
    """Writes the images of a shard to `data/000003.tar`, or to one file for each part of the dataset."""

    def __init__(self, store: Store, shard: int) -> None:
        self._store = store
        self._shard = shard_key(shard)
        self._stack = ExitStack()
        self._open: dict[str, tuple[tarfile.TarFile, HashingWriter]] = {}

    def store(self, sample: Sample) -> Sample:
        """Return the sample encoded: a tar file takes its members one after the other."""
        return in_memory(sample)

    def append(self, sample: Sample) -> None:
        """Write an image and what belongs to it."""
        name = f"{sample.split or 'data'}/{self._shard}.tar"
        if name not in self._open:
            hashed = HashingWriter(self._stack.enter_context(self._store.create(name)))
            tar = tarfile.open(fileobj=cast("Any", hashed), mode="w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115
            self._open[name] = (tar, hashed)
        tar = self._open[name][0]
        text = json.dumps(metadata_of(sample), ensure_ascii=False) + "\n"
        for kind, ending, pieces in (*sample.files, ("images", ".json", (text.encode(),))):
            data = b"".join(pieces)
            header = tarfile.TarInfo(member_name(kind, sample.key, ending))
            header.size = len(data)
            header.mode = 0o644
            tar.addfile(header, io.BytesIO(data))

    def close(self) -> list[FileSum]:
        """Finish the files, bring them to the disk and return them."""
        for tar, _ in self._open.values():
            tar.close()
        self._stack.close()
        self._store.sync(self._open)
        return [FileSum(name=name, sha256=self._open[name][1].sha256) for name in sorted(self._open)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: *ExitReason) -> None:
        self._stack.__exit__(*error)


def read_member(store: Store, container: str, file: str) -> bytes:
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
