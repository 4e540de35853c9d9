"""How the images of a dataset lie on disk: each in a file of its own, or those of a shard in one; and all layouts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import ClassVar, Final, Self

from foundation.errors import InputError
from foundation.files import HashingWriter
from generator.dataset.joined import JOINED, Beside, ExitReason, JoinedLayout, JoinedWriter
from generator.dataset.records import FileSum, Sample, part_of
from generator.stores import Store

# Images from which files are synchronised while others are made: enough that one wait for the disk serves many.
_SYNCED_IMAGES: Final = 32
_SYNCED_PIXELS: Final = 1 << 23  # Pixels of such images, for the same reason where images are large


class FileWriter:
    """Each image in a file of its own, named by `FileLayout.place`.

    A thread of its own synchronises the files with the disk, a few at a time, while others are made; only the last few
    are waited for.
    """

    def __init__(self, store: Store, place: Callable[[str, str, str], str]) -> None:
        self._store, self._place = store, place
        self._files: list[FileSum] = []
        self._thread = ThreadPoolExecutor(1)
        self._syncing: list[Future[None]] = []
        self._written: list[str] = []
        self._images = self._pixels = 0

    def store(self, sample: Sample) -> Sample:
        """Write the files of a sample; return it without their bytes."""
        sums: list[FileSum] = []
        for kind, ending, data in sample.files:
            name = self._place(kind, part_of(sample.split), f"{sample.key}{ending}")
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


# Writes the samples of one shard, in a block; files that are still open appear only if the block ends well. `store`
# is called from the thread that made a sample, `append` in the order of their numbers.
ShardWriter = FileWriter | JoinedWriter


@dataclass(frozen=True)
class FileLayout:
    """A layout in which each image is a file of its own.

    - `place`: name in the dataset of a file of some kind (`images`, `previews`, `masks`, `ground_truth`), of a part of
      the dataset (`data` where it is not divided), and of its own name, such as ``000123.png``.
    """

    place: Callable[[str, str, str], str]
    library: ClassVar[str] = ""
    is_of_the_hub: ClassVar[bool] = False

    def open_writer(self, store: Store, shard: int, beside: Beside) -> FileWriter:
        """Return the writer of a shard."""
        del shard, beside
        return FileWriter(store, self.place)

    def name_of(self, kind: str, part: str, shard: int, key: str, ending: str) -> str:
        """Return the name of an image's file in the dataset."""
        del shard
        return self.place(kind, part, f"{key}{ending}")

    def get(self, store: Store, name: str) -> bytes:
        """Return the bytes of a file by its name."""
        return store.get(name)

    def folder(self, kind: str, parts: Sequence[str]) -> str | None:
        """Return the folder of all files of a kind; None where they lie in several."""
        folders = {self.place(kind, part, "").removesuffix("/") for part in parts}
        return folders.pop() if len(folders) == 1 else None

    def patterns(self, parts: Sequence[str], ending: str) -> list[str]:
        """Return the patterns of the images' files, which end in `ending`."""
        return list(dict.fromkeys(self.place("images", part, f"*{ending}") for part in parts))


# All layouts by name.
LAYOUTS: Final[Mapping[str, FileLayout | JoinedLayout]] = {
    "folder": FileLayout(place=lambda kind, part, name: f"{kind}/{name}"),
    **JOINED,
}


def require_library(layout: str) -> None:
    """Refuse a layout whose library is not installed."""
    library = LAYOUTS[layout].library
    if library and find_spec(library) is None:
        raise InputError(f"the layout {layout} needs {library}; install it with: pip install {library}")
