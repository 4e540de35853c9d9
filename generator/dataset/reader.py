"""A dataset: how its files are read, and whether they are those that were made; docs/formats.md says what they hold.

No byte of them depends on the workers, the clock or the machine's paths; the versions of the libraries that encode and
decode are recorded.
"""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from foundation.compiled import ordered_map
from foundation.errors import FormatError, InputError, counted
from foundation.files import MAX_JSON_BYTES, bounded_lines, is_inside_name, parse_json_object, stream_sha256
from generator.dataset.layouts import LAYOUTS, require_library
from generator.dataset.records import (
    COMPLETED_BY_HAND,
    FORMAT,
    GROUND_TRUTH,
    GROUND_TRUTH_COLUMNS,
    IMAGES,
    SOURCES,
    SPLITS,
    SUMS,
    TRUTHS,
    VERSION,
    Description,
    Entry,
    ReadingOptions,
    SourceRecord,
    Split,
    Triple,
    part_of,
)
from generator.files import decode_image
from generator.lights.lighting import parse_mixture
from generator.masks.maps import decode_ground_truth, decode_weights
from generator.stores import DESCRIPTION, Store, open_store, read_bounded

# A number, of which ten digits count all images that a dataset holds, and an ending.
_NAME: Final = re.compile(r"([0-9]{1,10})(\.[A-Za-z0-9.]*)?")
_VALID: Final = "with r + g + b = 1 and none below 0"
# What sums and means of chromaticities may be off by: more than six written digits are, and less than a thousandth of
# a degree.
_ROUNDING: Final = 2e-6
_KEPT: Final = 4096  # Lights of images that are kept, since many images share one: several times a table's lights


def read_entries(store: Store, description: Description) -> Iterator[Entry]:
    """Yield the images of a dataset in the order of their numbers; reads no image.

    Both lists are in this order, and the rows of one image follow each other, so that a line of each is in memory.
    """
    name = f"{store.place}/{GROUND_TRUTH}"
    part_of: dict[int, Split] = {}
    for part in SPLITS:
        if part in description.splits:
            with _text(store, f"splits/{part}.txt") as images:
                part_of.update((_number(image.rstrip("\r\n")), part) for image in images)
    with _text(store, TRUTHS) as truths, _text(store, GROUND_TRUTH) as table:
        last, count = -1, 0
        for image, group in groupby(_numbered_rows(name, table), key=lambda numbered: numbered[1].get("image")):
            count += 1
            source, labels, whites = _read_rows(name, group)
            number = _number(image or "")
            if image is None or number <= last:
                raise FormatError(f"{name}: {image!r} is not in the order of the images; make the dataset again")
            last = number
            truth = _truth(store, next(truths, ""), count, image, whites)
            yield Entry(image, source, labels, whites, truth, part_of.get(number))
        if count != description.images:
            raise FormatError(
                f"{name} has rows of {count} images, expected the {description.images} of {DESCRIPTION}; make the "
                "dataset again"
            )
        more = sum(1 for line in truths if line.strip())
        if more:
            raise FormatError(
                f"{store.place}/{TRUTHS} has {count + more} lines, expected one for each of the {count} images of "
                f"{GROUND_TRUTH}; make the dataset again"
            )


def _numbered_rows(name: str, table: Iterable[str]) -> Iterator[tuple[int, dict[str, str]]]:
    rows = csv.DictReader(table)
    try:
        for row in rows:
            yield rows.line_num, row
    except csv.Error as error:
        raise FormatError(f"{name}, line {rows.line_num + 1} is no CSV: {error}; make the dataset again") from error


def _read_rows(
    name: str, rows: Iterable[tuple[int, dict[str, str]]]
) -> tuple[str, tuple[str, ...], tuple[Triple, ...]]:
    lights: list[tuple[str, Triple]] = []
    source = ""
    for line, row in rows:
        try:
            lights.append(_light(row["illumination"], row["r"], row["g"], row["b"]))
            source = sys.intern(row["source"])
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise FormatError(
                f"{name}, line {line}: expected {','.join(GROUND_TRUTH_COLUMNS)} {_VALID}, found "
                f"{_shown(','.join(map(str, row.values())))}; make the dataset again"
            ) from error
    return source, *_unzipped(tuple(lights))


def _truth(store: Store, text: str, line: int, image: str, lights: tuple[Triple, ...]) -> Triple:
    """Return the mean of an image's lights by its line of `gt.txt`; a FormatError if it cannot be their mean."""
    name = f"{store.place}/{TRUTHS}, line {line}"
    try:
        truth = _triple(*text.split())
    except (TypeError, ValueError) as error:
        raise FormatError(
            f"{name}: expected the light of {image}, r g b {_VALID}, found {_shown(text.strip())}; make the dataset "
            "again"
        ) from error
    if not _may_be_mean(truth, lights):
        listed = " and ".join("{:g} {:g} {:g}".format(*light) for light in lights)
        raise FormatError(
            f"{name}: {text.strip()} is not the light of {image}, which is {listed} in {GROUND_TRUTH}; see with "
            f"generate --verify {store.place} which of the two files has changed, and restore it"
        )
    return truth


@lru_cache(maxsize=_KEPT)
def _may_be_mean(mean: Triple, lights: tuple[Triple, ...]) -> bool:
    """Return whether lights may have this mean; one light is its own."""
    return all(
        min(parts) - _ROUNDING <= part <= max(parts) + _ROUNDING for part, *parts in zip(mean, *lights, strict=True)
    )


def _shown(text: str) -> str:
    """Return the text of a line for a message, cut where it is long."""
    return repr(text if len(text) <= 80 else f"{text[:80]}…") if text else "nothing"


@contextmanager
def _text(store: Store, name: str) -> Generator[Iterator[str]]:
    """Open a file of text to be read line by line; a FormatError tells of a line that does not end."""
    with store.open(name) as stream:
        lines = bounded_lines(stream, f"{store.place}/{name}")
        yield (line.decode("utf-8-sig" if number == 0 else "utf-8", "replace") for number, line in enumerate(lines))


def _number(image: str) -> int:
    """Return the number of an image by its name; -1 if it has none, or is no name of a file."""
    found = _NAME.fullmatch(image)
    return int(found[1]) if found else -1


@lru_cache(maxsize=_KEPT)
def _light(label: str, red: str, green: str, blue: str) -> tuple[str, Triple]:
    return parse_mixture(label).label, _triple(red, green, blue)


@lru_cache(maxsize=_KEPT)
def _unzipped(lights: tuple[tuple[str, Triple], ...]) -> tuple[tuple[str, ...], tuple[Triple, ...]]:
    return tuple(label for label, _ in lights), tuple(white for _, white in lights)


@lru_cache(maxsize=_KEPT)
def _triple(red: str, green: str, blue: str) -> Triple:
    triple = float(red), float(green), float(blue)
    if not (min(triple) >= 0 and abs(sum(triple) - 1) <= _ROUNDING):
        raise ValueError(f"{triple} is no chromaticity")
    return triple


_LINE: Final = re.compile("[0-9a-f]{64}")  # A hash as `sha256sum` writes it


def file_faults(
    place: str | Path, progress: Callable[[int, int], None] | None = None, *, workers: int = 1
) -> Iterator[str]:
    """Yield each file of a dataset that is missing, changed or unknown, in words; reads every byte of it.

    Card and datasheet are completed by hand and not looked at.
    """
    store = open_store(place)
    sums = f"{store.place}/{SUMS}"
    if not store.has(DESCRIPTION):
        raise FormatError(f"{place} is no dataset: it has no {DESCRIPTION}; make one with generate")
    with store.open(SUMS) as listed:
        total = sum(1 for _ in bounded_lines(listed, sums))
    known: set[str] = {SUMS}
    verified = 0
    with store.open(SUMS) as listed:
        lines = _named(bounded_lines(listed, sums), known)
        for fault in ordered_map(partial(_verify_named, store), lines, workers):
            if fault is not None:
                yield fault
            verified += 1
            if progress is not None:
                progress(verified, total)
    for name in sorted(set(store.names()) - known - set(COMPLETED_BY_HAND)):
        yield f"{name} is no part of the dataset"


def _named(lines: Iterator[bytes], known: set[str]) -> Iterator[tuple[str, str, str | None]]:
    """Yield name and hash of each line, and what is wrong with it; names are added to `known`, once each."""
    for number, line in enumerate(lines, start=1):
        digest, _, name = line.decode("utf-8", "replace").rstrip("\n").partition("  ")
        if not _LINE.fullmatch(digest) or not is_inside_name(name):
            yield "", "", f"{SUMS}, line {number}: expected a hash, two blanks and a name inside the dataset"
        elif name in known:
            # Whoever lists one file a million times would have it read a million times.
            yield "", "", f"{SUMS}, line {number}: {name} is listed twice"
        else:
            known.add(name)
            yield name, digest, None


def _verify_named(store: Store, line: tuple[str, str, str | None]) -> str | None:
    name, digest, fault = line
    return _fault_of(store, name, digest) if fault is None else fault


def _fault_of(store: Store, name: str, digest: str) -> str | None:
    try:
        with store.open(name) as stream:
            found = stream_sha256(stream)
    except FormatError as error:
        missing = isinstance(error.__cause__, FileNotFoundError)
        return f"{name} is missing" if missing else f"{name} is missing or cannot be read: {error}"
    return None if found == digest else f"{name} has changed"


# Lists that are read whole have a line an image or source, some hundred bytes: this is forty million of them.
MOST_LIST_BYTES: Final = 4 << 30


@dataclass(frozen=True)
class Dataset:
    """A dataset on disk or in a store; lists and images are read where they are used.

    - `store`: where its files are.
    - `description`: the content of `dataset.json`.
    - `made_under`: `light_labels`, where the dataset was made just now; None to find them in its lists.
    """

    store: Store
    description: Description
    made_under: frozenset[str] | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        """Return one line: a dataset has an entry for each of its images."""
        return f"Dataset({self.store.place!r}, {counted(self.description.images, 'image')}, layout {self.layout})"

    def read_image(self, entry: Entry) -> npt.NDArray[np.uint16]:
        """Return the image (H, W, 3) uint16, linear camera RGB, `description.table.white_level` = saturation."""
        name = self._name(entry, "images", PurePosixPath(entry.image).suffix)
        return decode_image(self._bytes(name), self._options.format, f"{self.store.place}/{name}")

    def read_preview(self, entry: Entry) -> bytes | None:
        """Return the JPEG file of an image's preview, or None if the dataset has none."""
        if not self._options.previews:
            return None
        return self._bytes(self._name(entry, "previews", ".jpg"))

    def read_weights(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return how the lights of an image share its pixels: (H, W, K) float32.

        In the order of `entry.lights`, sum 1.
        """
        masks = [self._map(entry, "masks", f"_{light}.png") for light in range(len(entry.lights))]
        return decode_weights(masks, self._of(entry, "masks"))

    def read_ground_truth_map(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return the ground truth of every pixel of an image: (H, W, 3) float32, r + g + b = 1."""
        return decode_ground_truth(self._map(entry, "ground_truth", ".png"), self._of(entry, "ground truth"))

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """Its images in the order of their numbers."""
        return tuple(read_entries(self.store, self.description))

    @cached_property
    def light_labels(self) -> frozenset[str]:
        """Every light on its images once: number in the table, or name of the mixture; see `Entry.lights`."""
        if self.made_under is not None:
            return self.made_under
        return frozenset(label for entry in self.entries for label in entry.lights)

    @property
    def layout(self) -> str:
        """Its layout, a name of `generator.dataset.layouts.LAYOUTS`."""
        return self._options.layout

    @cached_property
    def _options(self) -> ReadingOptions:
        return ReadingOptions.model_validate(self.description.options)

    @cached_property
    def sources(self) -> tuple[SourceRecord, ...]:
        """The sources that were used, in their order."""
        try:
            rows = csv.DictReader(io.StringIO(self._list(SOURCES)))
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
        return read_bounded(self.store, name, MOST_LIST_BYTES).decode("utf-8", "replace")

    def _map(self, entry: Entry, kind: str, ending: str) -> bytes:
        if len(entry.lights) == 1:
            raise InputError(f"one light falls on {entry.image}, so that it has no masks; see its truth")
        return self._bytes(self._name(entry, kind, ending))

    def _name(self, entry: Entry, kind: str, ending: str) -> str:
        key = PurePosixPath(entry.image).stem
        shard = _number(entry.image) // self._options.shard_images
        return LAYOUTS[self.layout].name_of(kind, part_of(entry.split), shard, key, ending)

    def _bytes(self, name: str) -> bytes:
        require_library(self.layout)
        return LAYOUTS[self.layout].get(self.store, name)

    def _of(self, entry: Entry, what: str) -> str:
        return f"{self.store.place}, the {what} of {entry.image},"


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
    dataset = Dataset(store, load_description(store))
    # Lists that disagree are told now, not in the middle of what is done with the images.
    _ = dataset.entries
    return dataset


def load_description(store: Store) -> Description:
    """Return the content of a dataset's `dataset.json`; a FormatError says why it cannot be used."""
    name = f"{store.place}/{DESCRIPTION}"
    try:
        content = parse_json_object(read_bounded(store, DESCRIPTION, MAX_JSON_BYTES), name)
        description = Description.model_validate(content)
        ReadingOptions.model_validate(description.options)
    except ValidationError as error:
        first = error.errors()[0]
        raise FormatError(
            f"{name} is no dataset's description: {'.'.join(map(str, first['loc']))}: {first['msg']}; this software "
            f"reads {FORMAT} of version {VERSION}"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{name} is damaged ({type(error).__name__}: {error}); make the dataset again") from error
    return description
