"""Layouts of data sets: one file for each image, or one file for each shard (`generator.dataset.joined`)."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, ClassVar, Final, Self

from foundation.errors import InputError
from foundation.files import HashingWriter
from generator.dataset.joined import JOINED, ExitReason, Extras, JoinedLayout, JoinedWriter
from generator.dataset.records import FileSum, Sample, split_name
from generator.files import Format
from generator.stores import Store

# Number of images whose files are synchronised together, so that one wait for the disk serves many files.
_SYNCED_IMAGES: Final = 32
_SYNCED_PIXELS: Final = 1 << 23  # Number of pixels of such images; it limits the wait if images are large


class FileWriter:
    """Writes each image to its own file.

    A separate thread synchronises files with the disk while other images are made; `close` waits for the last ones.
    """

    def __init__(
        self,
        store: Store,
        file_name: Callable[[str, str, str, str], str],
        extras: Extras,
        metadata: Callable[[Sample, Extras], dict[str, Any]] | None,
    ) -> None:
        self._store, self._file_name, self._extras, self._metadata = store, file_name, extras, metadata
        self._files: list[FileSum] = []
        self._thread = ThreadPoolExecutor(1)
        self._syncing: list[Future[None]] = []
        self._written: list[str] = []
        self._images = self._pixels = 0

    def store(self, sample: Sample) -> Sample:
        """Write the files of a sample; return the sample without their bytes."""
        sums: list[FileSum] = []
        files = sample.files
        if self._metadata is not None:
            text = json.dumps(self._metadata(sample, self._extras), ensure_ascii=False, indent=1) + "\n"
            files = (*files, ("metadata", "_metadata.json", (text.encode(),)))
        for file_kind, ending, data in files:
            split = split_name(sample.split)
            name = self._file_name(file_kind, split, f"{sample.key}{ending}", self._extras.camera)
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
        """Wait until all files are on the disk; return their names and hashes."""
        self._sync()
        for synced in self._syncing:
            synced.result()
        return self._files

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: *ExitReason) -> None:
        """Keep the files, because making the shard again writes the same files."""
        self._thread.shutdown(cancel_futures=True)


# Context manager that writes the samples of one shard; open files appear only if the block does not raise. `store` is
# called by the thread that made a sample, `append` in the order of the image numbers.
ShardWriter = FileWriter | JoinedWriter


@dataclass(frozen=True)
class FileLayout:
    """A layout with one file for each image."""

    # Name in the data set. Arguments: file kind (`images`, `previews`, `masks`, `ground_truth`, `metadata`); split, or
    # `data` if the data set is not divided; name of the file, such as ``000123.png``; camera.
    file_name: Callable[[str, str, str, str], str]
    # Content of the metadata file of an image; None if the layout has no such files.
    metadata: Callable[[Sample, Extras], dict[str, Any]] | None = None
    format: Format | None = None  # the only format of images that programs for this layout read
    library: ClassVar[str] = ""
    is_read_by_hugging_face: ClassVar[bool] = False

    def open_writer(self, store: Store, shard: int, extras: Extras) -> FileWriter:
        """Return the writer of a shard."""
        del shard
        return FileWriter(store, self.file_name, extras, self.metadata)

    def name_of(self, file_kind: str, split_name: str, shard: int, key: str, ending: str, camera: str) -> str:
        """Return the name of a file of an image in the data set."""
        del shard
        return self.file_name(file_kind, split_name, f"{key}{ending}", camera)

    def get(self, store: Store, name: str) -> bytes:
        """Return the bytes of a file by its name."""
        return store.get(name)

    def folder(self, file_kind: str, split_names: Sequence[str]) -> str | None:
        """Return the folder of all files of a kind; None if there are several."""
        names = (self.file_name(file_kind, split_name, "NAME", "") for split_name in split_names)
        folders = {name.rpartition("/")[0] for name in names}
        return folders.pop() if len(folders) == 1 else None

    def patterns(self, split_names: Sequence[str], ending: str, camera: str) -> list[str]:
        """Return the glob patterns of image files that end in `ending`."""
        names = (self.file_name("images", split_name, f"*{ending}", camera) for split_name in split_names)
        return list(dict.fromkeys(names))


def _c5_name(file_kind: str, split_name: str, name: str, camera: str) -> str:
    # Programs list all PNG files of a folder as images, and find more images of a camera by the text after
    # `sensorname_` (`load_files` and `get_rand_examples_from_sensor` of src/dataset.py, github.com/mahmoudnafifi/C5).
    if file_kind not in ("images", "metadata"):
        return f"{file_kind}/{name}"
    stem, rest = re.split(r"(?=[._])", name, maxsplit=1)
    sensor = re.sub(r"[^a-z0-9]+", "_", camera.lower()).strip("_") or "camera"
    return f"{split_name}/{stem}_sensorname_{sensor}{rest}"


def _c5_metadata(sample: Sample, extras: Extras) -> dict[str, Any]:
    # C5 and CCMNet read `illuminant_color_raw`. CCMNet reads also `cm1` to `fm2`, the matrices of a DNG file under
    # illuminants A and D65 (src/dataset.py of github.com/DY112/CCMNet). Only the matrices under D65 are known, and DNG
    # uses a single matrix for all illuminants.
    assert extras.matrices is not None
    color, forward = extras.matrices
    return {
        **{"illuminant_color_raw": list(sample.record.truth), "camera": extras.camera, "source": sample.source},
        **{"cm1": color, "cm2": color, "fm1": forward, "fm2": forward},
    }


# All layouts by name.
LAYOUTS: Final[Mapping[str, FileLayout | JoinedLayout]] = {
    "folder": FileLayout(file_name=lambda file_kind, _split_name, name, _camera: f"{file_kind}/{name}"),
    "c5": FileLayout(file_name=_c5_name, metadata=_c5_metadata, format="png"),
    **JOINED,
}


def require_format(layout: str, form: str) -> None:
    """Raise InputError if the programs that read a layout do not read a format of images."""
    entry = LAYOUTS[layout]
    if isinstance(entry, FileLayout) and entry.format not in (None, form):
        raise InputError(
            f"the layout {layout} and the format {form} exclude each other, expected {entry.format}, the only format "
            f"that programs for {layout} read; use --format {entry.format}"
        )


def require_library(layout: str) -> None:
    """Raise InputError if the library of a layout is not installed."""
    library = LAYOUTS[layout].library
    if library and find_spec(library) is None:
        raise InputError(f"the layout {layout} needs {library}, which is not installed; run pip install {library}")
