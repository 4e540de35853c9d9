"""An image of a dataset with all that goes with it, and the contract of those who write it in some layout."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Final, Protocol, Self

from generator.dataset.production.records import FileSum, ImageRecord, Split, image_key
from generator.stores.store import Pieces, joined

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


def in_memory(sample: Sample) -> Sample:
    """Return a sample whose bytes are all computed and in memory of their own."""
    return replace(sample, files=tuple((kind, ending, (joined(data),)) for kind, ending, data in sample.files))


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
