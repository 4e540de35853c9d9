"""A dataset and its reader.

    images/NNNNNN.png    linear camera RGB in the units of the table; the number is the one that was planned
    masks/, ground_truth/  where several lights fall on an image; see `masks.maps`
    previews/NNNNNN.jpg  the same, tone mapped, at most 512 px: the look of the raw, no white balance
    ground_truth.csv     image,source,illumination,r,g,b with r + g + b = 1, one row a light
    gt.txt               r g b a line in image order: the mean of the lights over the image
    images.csv           where options do something to each image: what they did to it
    sources.csv          position,name,sha256,width,height,replaced_pixels,split,profile
    splits/train.txt …   names of images, where the dataset was divided
    dataset.json         the table's hash, seed, options: enough to make every byte again
    SHA256SUMS           hashes of all files; `sha256sum -c SHA256SUMS` verifies them

Image number `position · lights_each + k` shows the source at `position` under its k-th light. A source that cannot be
read is listed, and its numbers are not used. In the layouts `webdataset` and `parquet` the images of a shard lie in one
file, `data/NNNNNN.tar` or `.parquet`, or below the name of their part. No byte depends on the workers, the clock or the
machine's paths; the versions of the libraries that encode and decode are recorded.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from foundation.errors import FormatError, InputError
from foundation.foreign_folders import MOST_JSON_BYTES, parse_json_object
from generator.dataset.entries import read_entries
from generator.dataset.production.layouts.by_name import read_member
from generator.dataset.production.layouts.samples import member_name
from generator.dataset.production.records import (
    FORMAT,
    IMAGES,
    SOURCES,
    STRETCHED_VERSION,
    VERSION,
    Description,
    Entry,
    ReadingOptions,
    SourceRecord,
    shard_key,
)
from generator.files import decode_image, from_full_scale
from generator.masks.maps import decode_ground_truth, decode_weights
from generator.stores.places import DESCRIPTION
from generator.stores.store import Store, open_store, read_bounded

MOST_LIST_BYTES: Final = 4 << 30
"""Lists that are read whole have a line an image or source, some hundred bytes: this is forty million of them."""

__all__ = ["Dataset", "Description", "Entry", "open_dataset"]


@dataclass(frozen=True)
class Dataset:
    """A dataset on disk or in a store; images are read where they are used.

    - `store`: where its files are.
    - `description`: the content of `dataset.json`.
    - `entries`: its images in the order of their numbers.
    """

    store: Store
    description: Description
    entries: tuple[Entry, ...]

    def read_image(self, entry: Entry) -> npt.NDArray[np.uint16]:
        """Return the image (H, W, 3) uint16, linear camera RGB, `description.table.white_level` = saturation.

        Counts that were stretched over 16 bits are as they were before.
        """
        name = self._name(entry.image, entry.split, "images")
        image = decode_image(self._bytes(name), self._options.format, f"{self.store.place}/{name}")
        if self._options.scale == "full":
            return from_full_scale(image, self.description.table.white_level)
        return image

    def read_preview(self, entry: Entry) -> bytes | None:
        """Return the JPEG file of an image's preview, or None if the dataset has none."""
        if not self._options.previews:
            return None
        return self._beside(entry, "previews", ".jpg")

    def read_weights(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return how the lights of an image share its pixels: (H, W, K) float32.

        In the order of `entry.lights`, sum 1.
        """
        masks = [self._map(entry, "masks", f"_{light}.png") for light in range(len(entry.lights))]
        return decode_weights(masks, self._of(entry, "masks"))

    def read_ground_truth_map(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return the ground truth of every pixel of an image: (H, W, 3) float32, r + g + b = 1."""
        return decode_ground_truth(self._map(entry, "ground_truth", ".png"), self._of(entry, "ground truth"))

    @property
    def layout(self) -> str:
        """Its layout: ``folder``, ``webdataset`` or ``parquet``."""
        return self._options.layout

    @cached_property
    def _options(self) -> ReadingOptions:
        return ReadingOptions.model_validate(self.description.options)

    @cached_property
    def sources(self) -> tuple[SourceRecord, ...]:
        """The sources that were used, in their order."""
        rows: Iterable[dict[str, Any]]
        try:
            if self.store.has(SOURCES):
                rows = csv.DictReader(io.StringIO(self._list(SOURCES)))
            else:
                rows = _content(self.store)["sources"]  # Version 1 had them there.
            return tuple(
                SourceRecord.model_validate({key: None if value == "" else value for key, value in row.items()})
                for row in rows
            )
        except (ValidationError, csv.Error, KeyError, TypeError, AttributeError) as error:
            raise FormatError(f"{self.store.place}/{SOURCES} is damaged; make the dataset again") from error

    @cached_property
    def details(self) -> dict[str, dict[str, str]]:
        """What options did to each image, as `images.csv` has it, by the image's name; empty if none did anything."""
        if not self.store.has(IMAGES):
            return {}
        rows = csv.DictReader(io.StringIO(self._list(IMAGES)))
        try:
            return {row.pop("image"): row for row in rows}
        except csv.Error as error:
            raise FormatError(f"{self.store.place}/{IMAGES} is no CSV: {error}; make the dataset again") from error
        except KeyError as error:
            raise FormatError(f"{self.store.place}/{IMAGES} has no column image; make the dataset again") from error

    def _list(self, name: str) -> str:
        """Return the text of a list."""
        return read_bounded(self.store, name, MOST_LIST_BYTES).decode("utf-8", "replace")

    def _name(self, file: str, split: str | None, kind: str) -> str:
        if self.layout == "folder":
            return f"{kind}/{file}"
        number = int(file.partition(".")[0])
        shard = shard_key(number // self._options.shard_images)
        return f"{split or 'data'}/{shard}.{'tar' if self.layout == 'webdataset' else 'parquet'}/{file}"

    def _map(self, entry: Entry, kind: str, ending: str) -> bytes:
        """Return the file of a map that lies beside an image of several lights."""
        if len(entry.lights) == 1:
            raise InputError(f"one light falls on {entry.image}, so that it has no masks; see its truth")
        return self._beside(entry, kind, ending)

    def _beside(self, entry: Entry, kind: str, ending: str) -> bytes:
        """Return a file that lies beside an image."""
        key = PurePosixPath(entry.image).stem
        file = f"{key}{ending}" if self.layout == "folder" else member_name(kind, key, ending)
        return self._bytes(self._name(file, entry.split, kind))

    def _of(self, entry: Entry, what: str) -> str:
        return f"{self.store.place}, the {what} of {entry.image},"

    def _bytes(self, name: str) -> bytes:
        if self.layout == "folder":
            return self.store.get(name)
        container, _, file = name.rpartition("/")
        return read_member(self.layout, self.store, container, file)


def open_dataset(place: Path | str) -> Dataset:
    """Open a dataset; reads no image.

    Parameters
    ----------
    place
        Its folder, or its URL in a store that fsspec knows.

    Raises
    ------
    FormatError
        There is no dataset, it is of a version that this software does not read, or its files disagree.

    Examples
    --------
    >>> import tempfile
    >>> from generator import find_pictures, generate_dataset, open_dataset, open_lut
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = generate_dataset(open_lut("lut"), f"{folder}/dataset", find_pictures("cat.png"), [2])
    ...     dataset = open_dataset(f"{folder}/dataset")
    ...     image = dataset.read_image(dataset.entries[0])
    >>> image.shape, image.dtype, dataset.entries[0].truth
    ((40, 50, 3), dtype('uint16'), (0.407407407, 0.296296296, 0.296296296))
    """
    store = open_store(place)
    if not store.has(DESCRIPTION):
        raise FormatError(f"{place} is no dataset: it has no {DESCRIPTION}; make one with generate")
    description = _load_description(store)
    return Dataset(store, description, tuple(read_entries(store, description)))


def _load_description(store: Store) -> Description:
    name = f"{store.place}/{DESCRIPTION}"
    try:
        content = _content(store)
        if content["version"] == 1:
            content = _upgraded(content)
        description = Description.model_validate(content)
        ReadingOptions.model_validate(description.options)
    except ValidationError as error:
        first = error.errors()[0]
        raise FormatError(
            f"{name} is no dataset's description: {'.'.join(map(str, first['loc']))}: {first['msg']}; this software "
            f"reads {FORMAT} of versions 1 to {STRETCHED_VERSION}"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{name} is damaged ({type(error).__name__}: {error}); make the dataset again") from error
    return description


def _content(store: Store) -> dict[str, Any]:
    """Return the object of `dataset.json` as it stands there."""
    return parse_json_object(read_bounded(store, DESCRIPTION, MOST_JSON_BYTES), f"{store.place}/{DESCRIPTION}")


def _upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """Return a description of version 1, which listed the sources themselves, as one of version 2."""
    sources = content["sources"]
    counts = {
        "sources": len(sources),
        "pixels": sum(source["width"] * source["height"] for source in sources),
        "replaced_pixels": sum(source["replaced_pixels"] for source in sources),
    }
    return content | counts | {"version": VERSION, "planned": content["images"]}
