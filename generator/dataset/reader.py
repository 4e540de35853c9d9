"""Read and verify data sets; docs/formats.md describes their files.

Readers raise FormatError if files are missing, damaged or inconsistent. Data sets may come from foreign sources, so
names, numbers and sizes in their lists are checked.
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
    split_name,
)
from generator.files import decode_image
from generator.lights.lighting import parse_mixture
from generator.masks.maps import decode_ground_truth, decode_weights
from generator.stores import DESCRIPTION, RemoteStore, Store, open_store, read_bounded

# File name of an image: a number, for which ten digits suffice, and a suffix.
_NAME: Final = re.compile(r"([0-9]{1,10})(\.[A-Za-z0-9.]*)?")
_VALID_TRUTH: Final = "with r + g + b = 1 and no negative number"
# Tolerance for sums and means of chromaticities: above the rounding of six digits, below 0.001 degrees.
_ROUNDING: Final = 2e-6
_CACHED_LIGHTS: Final = 4096  # Number of cached illuminants: several times that of a LUT


def read_entries(store: Store, description: Description) -> Iterator[Entry]:
    """Yield the entries of a data set in the order of their numbers, without reading images."""
    # Only one line of `gt.txt` and of `ground_truth.csv` is in memory, because both are in this order.
    name = f"{store.location}/{GROUND_TRUTH}"
    split_of_image: dict[int, Split] = {}
    for split in SPLITS:
        if split in description.splits:
            with _open_text(store, f"splits/{split}.txt") as images:
                split_of_image.update((_number(image.rstrip("\r\n")), split) for image in images)
    with _open_text(store, TRUTHS) as truths, _open_text(store, GROUND_TRUTH) as table:
        last, count = -1, 0
        for image, group in groupby(_numbered_rows(name, table), key=lambda numbered: numbered[1].get("image")):
            count += 1
            source, labels, chromaticities = _read_rows(name, group)
            number = _number(image or "")
            if image is None or number <= last:
                raise FormatError(f"{name}: the image {image!r} is out of numerical order; make the data set again")
            last = number
            truth = _truth(store, next(truths, ""), count, image, chromaticities)
            yield Entry(image, source, labels, chromaticities, truth, split_of_image.get(number))
        if count != description.images:
            raise FormatError(
                f"{name} has rows of {count} images, expected {description.images} as in {DESCRIPTION}; make the "
                "data set again"
            )
        extra_lines = sum(1 for line in truths if line.strip())
        if extra_lines:
            raise FormatError(
                f"{store.location}/{TRUTHS} has {count + extra_lines} lines, expected one for each of the {count} "
                f"images of {GROUND_TRUTH}; make the data set again"
            )


def _numbered_rows(name: str, table: Iterable[str]) -> Iterator[tuple[int, dict[str, str]]]:
    rows = csv.DictReader(table)
    try:
        for row in rows:
            yield rows.line_num, row
    except csv.Error as error:
        raise FormatError(f"{name}, line {rows.line_num + 1} is not CSV: {error}; make the data set again") from error


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
                f"{name}, line {line} is {_excerpt(','.join(map(str, row.values())))}, expected "
                f"{','.join(GROUND_TRUTH_COLUMNS)} {_VALID_TRUTH}; make the data set again"
            ) from error
    return source, *_unzipped(tuple(lights))


def _truth(store: Store, text: str, line: int, image: str, lights: tuple[Triple, ...]) -> Triple:
    name = f"{store.location}/{TRUTHS}, line {line}"
    try:
        truth = _triple(*text.split())
    except (TypeError, ValueError) as error:
        raise FormatError(
            f"{name}: {image} has {_excerpt(text.strip())}, expected r g b {_VALID_TRUTH}; make the data set again"
        ) from error
    if not _may_be_mean(truth, lights):
        expected = " and ".join("{:g} {:g} {:g}".format(*light) for light in lights)
        raise FormatError(
            f"{name}: the ground truth of {image} is {text.strip()}, expected {expected} as in {GROUND_TRUTH}; run "
            f"generate --verify {store.location} to see which of the two files has changed, and restore it"
        )
    return truth


@lru_cache(maxsize=_CACHED_LIGHTS)
def _may_be_mean(mean: Triple, lights: tuple[Triple, ...]) -> bool:
    # The weights of the illuminants are not in the lists, so only the range of each channel is checked.
    return all(
        min(light_components) - _ROUNDING <= component <= max(light_components) + _ROUNDING
        for component, *light_components in zip(mean, *lights, strict=True)
    )


def _excerpt(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:80]}…") if text else "empty"


@contextmanager
def _open_text(store: Store, name: str) -> Generator[Iterator[str]]:
    with store.open(name) as stream:
        lines = bounded_lines(stream, f"{store.location}/{name}")
        yield (line.decode("utf-8-sig" if number == 0 else "utf-8", "replace") for number, line in enumerate(lines))


def _number(image: str) -> int:
    # -1 if the name is invalid.
    match = _NAME.fullmatch(image)
    return int(match[1]) if match else -1


@lru_cache(maxsize=_CACHED_LIGHTS)
def _light(label: str, red: str, green: str, blue: str) -> tuple[str, Triple]:
    return parse_mixture(label).label, _triple(red, green, blue)


@lru_cache(maxsize=_CACHED_LIGHTS)
def _unzipped(lights: tuple[tuple[str, Triple], ...]) -> tuple[tuple[str, ...], tuple[Triple, ...]]:
    return tuple(label for label, _ in lights), tuple(white for _, white in lights)


@lru_cache(maxsize=_CACHED_LIGHTS)
def _triple(red: str, green: str, blue: str) -> Triple:
    triple = float(red), float(green), float(blue)
    if not (min(triple) >= 0 and abs(sum(triple) - 1) <= _ROUNDING):
        raise ValueError(f"{triple} is not a chromaticity")
    return triple


_SHA256: Final = re.compile("[0-9a-f]{64}")  # SHA-256 of a file in hexadecimal digits


def file_faults(
    location: str | Path, progress: Callable[[int, int], None] | None = None, *, workers: int = 1
) -> Iterator[str]:
    """Yield a text for each file that is missing, changed or not listed; reads every byte of the data set.

    `README.md` and `DATASHEET.md` are not checked, because the authors complete them by hand.
    """
    store = open_store(location)
    sums = f"{store.location}/{SUMS}"
    _require_description(store)
    with store.open(SUMS) as stream:
        total = sum(1 for _ in bounded_lines(stream, sums))
    listed_names: set[str] = {SUMS}
    verified = 0
    with store.open(SUMS) as stream:
        lines = _listed_files(bounded_lines(stream, sums), listed_names)
        for fault in ordered_map(partial(_verify_listed, store), lines, workers):
            if fault is not None:
                yield fault
            verified += 1
            if progress is not None:
                progress(verified, total)
    for name in sorted(set(store.names()) - listed_names - set(COMPLETED_BY_HAND)):
        yield f"{name} is not listed in {SUMS}; remove it if you do not need it"


def _require_description(store: Store) -> None:
    if store.has(DESCRIPTION):
        return
    try:
        store.get(DESCRIPTION)
    except FormatError as error:
        # The error of a store shows whether its bucket or only the file is missing.
        answer = f" ({error.__cause__})" if isinstance(store, RemoteStore) else ""
        raise FormatError(
            f"{store.location} is not a data set, because {DESCRIPTION} is missing{answer}; correct the address, or "
            "make a data set with generate"
        ) from error


def _listed_files(lines: Iterator[bytes], listed_names: set[str]) -> Iterator[tuple[str, str, str | None]]:
    # Yields name, hash and fault of each line, and adds the names to `listed_names`.
    for number, line in enumerate(lines, start=1):
        digest, _, name = line.decode("utf-8", "replace").rstrip("\n").partition("  ")
        if not _SHA256.fullmatch(digest) or not is_inside_name(name):
            yield (
                "",
                "",
                f"{SUMS}, line {number} is damaged, expected a hash, two spaces and a name inside the data set",
            )
        elif name in listed_names:
            # Each file is read only once, even if a malicious list repeats it a million times.
            yield "", "", f"{SUMS}, line {number}: {name} is listed twice"
        else:
            listed_names.add(name)
            yield name, digest, None


def _verify_listed(store: Store, line: tuple[str, str, str | None]) -> str | None:
    name, digest, fault = line
    return _fault_of(store, name, digest) if fault is None else fault


def _fault_of(store: Store, name: str, digest: str) -> str | None:
    try:
        with store.open(name) as stream:
            actual_digest = stream_sha256(stream)
    except FormatError as error:
        missing = isinstance(error.__cause__, FileNotFoundError)
        return f"{name} is missing" if missing else f"{name} is missing or cannot be read: {error}"
    return None if actual_digest == digest else f"{name} has changed"


# Largest list that is read at once, in bytes: forty million lines (one for each image or source) of 100 bytes.
MOST_LIST_BYTES: Final = 4 << 30


@dataclass(frozen=True)
class Dataset:
    """A data set on disk or in a store; lists and images are read when they are used.

    Attributes
    ----------
    store
        Location of the files.
    description
        Content of `dataset.json`; `description.table.white_level` is the saturation level.
    known_light_labels
        `light_labels`, if they are known because the data set was just generated; None to read them from its lists.
    """

    store: Store
    description: Description
    known_light_labels: frozenset[str] | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        """Return one line, because the list of entries may be very long."""
        return f"Dataset({self.store.location!r}, {counted(self.description.images, 'image')}, layout {self.layout})"

    def read_image(self, entry: Entry) -> npt.NDArray[np.uint16]:
        """Return an image.

        Parameters
        ----------
        entry
            An element of `entries`.

        Returns
        -------
        ndarray
            (H, W, 3) uint16, linear camera RGB, black 0, saturation `description.table.white_level`. For the
            format ``dng``, it is the half-size image.

        Raises
        ------
        FormatError
            The file is missing or damaged.
        """
        name = self._name(entry, "images", PurePosixPath(entry.image).suffix)
        return decode_image(self._bytes(name), self._options.format, f"{self.store.location}/{name}")

    def read_preview(self, entry: Entry) -> bytes | None:
        """Return the JPEG file of the preview of an image, or None if the data set has no previews."""
        if not self._options.previews:
            return None
        return self._bytes(self._name(entry, "previews", ".jpg"))

    def read_weights(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return the masks of an image with several illuminants.

        Parameters
        ----------
        entry
            An element of `entries`.

        Returns
        -------
        ndarray
            (H, W, K) float32, weights of the illuminants in the order of `entry.lights`, sum 1 in each pixel.

        Raises
        ------
        InputError
            The image has one illuminant and therefore no masks.
        FormatError
            A file is missing or damaged.
        """
        masks = [self._map(entry, "masks", f"_{light}.png") for light in range(len(entry.lights))]
        return decode_weights(masks, self._described(entry, "masks"))

    def read_ground_truth_map(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return the ground truth of every pixel, (H, W, 3) float32, r + g + b = 1; errors as for `read_weights`."""
        return decode_ground_truth(self._map(entry, "ground_truth", ".png"), self._described(entry, "ground truth"))

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """One entry for each image, in the order of their numbers."""
        return tuple(read_entries(self.store, self.description))

    @cached_property
    def light_labels(self) -> frozenset[str]:
        """All illuminants of the images without repetitions; see `Entry.lights`."""
        if self.known_light_labels is not None:
            return self.known_light_labels
        return frozenset(label for entry in self.entries for label in entry.lights)

    @property
    def layout(self) -> str:
        """The layout: ``"folder"``, ``"c5"``, ``"webdataset"`` or ``"parquet"``."""
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
            raise FormatError(f"{self.store.location}/{SOURCES} is damaged; make the data set again") from error

    @cached_property
    def details(self) -> dict[str, dict[str, str]]:
        """Details of each image from `images.csv`, by image name; empty if there is no such file."""
        if not self.store.has(IMAGES):
            return {}
        rows = csv.DictReader(io.StringIO(self._list(IMAGES)))
        try:
            return {row.pop("image"): row for row in rows}
        except csv.Error as error:
            raise FormatError(f"{self.store.location}/{IMAGES} is not CSV: {error}; make the data set again") from error
        except KeyError as error:
            raise FormatError(f"{self.store.location}/{IMAGES} has no column image; make the data set again") from error

    def _list(self, name: str) -> str:
        return read_bounded(self.store, name, MOST_LIST_BYTES).decode("utf-8", "replace")

    def _map(self, entry: Entry, file_kind: str, ending: str) -> bytes:
        if len(entry.lights) == 1:
            raise InputError(f"{entry.image} has 1 illuminant and no masks, expected 2 or more; use entry.truth")
        return self._bytes(self._name(entry, file_kind, ending))

    def _name(self, entry: Entry, file_kind: str, ending: str) -> str:
        key = PurePosixPath(entry.image).stem
        shard = _number(entry.image) // self._options.shard_images
        camera = self.description.table.camera
        return LAYOUTS[self.layout].name_of(file_kind, split_name(entry.split), shard, key, ending, camera)

    def _bytes(self, name: str) -> bytes:
        require_library(self.layout)
        return LAYOUTS[self.layout].get(self.store, name)

    def _described(self, entry: Entry, content: str) -> str:
        return f"{self.store.location}, the {content} of {entry.image},"


def open_dataset(location: Path | str) -> Dataset:
    """Open a data set without reading images.

    Parameters
    ----------
    location
        Folder of the data set, or its URL in a store that fsspec supports.

    Returns
    -------
    Dataset
        The data set; its lists are read and checked.

    Raises
    ------
    FormatError
        There is no data set, its version is not supported, or its files are inconsistent.

    Examples
    --------
    >>> import tempfile
    >>> from generator import find_pictures, generate_dataset, open_dataset, open_lut
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = generate_dataset(open_lut("lut"), f"{folder}/dataset", find_pictures("cat.png"), [2])
    ...     dataset = open_dataset(f"{folder}/dataset")
    ...     image = dataset.read_image(dataset.entries[0])
    >>> image.shape, image.dtype, dataset.entries[0].truth
    ((40, 50, 3), dtype('uint16'), (0.407407407, 0.296296296, 0.296296296))
    """
    store = open_store(location)
    _require_description(store)
    dataset = Dataset(store, load_description(store))
    # Reads the lists, so that inconsistent lists are reported before images are used.
    _ = dataset.entries
    return dataset


def load_description(store: Store) -> Description:
    """Return the content of `dataset.json`; raises FormatError."""
    name = f"{store.location}/{DESCRIPTION}"
    try:
        content = parse_json_object(read_bounded(store, DESCRIPTION, MAX_JSON_BYTES), name)
        description = Description.model_validate(content)
        ReadingOptions.model_validate(description.options)
    except ValidationError as error:
        first = error.errors()[0]
        raise FormatError(
            f"{name} is invalid: {'.'.join(map(str, first['loc']))}: {first['msg']}, expected {FORMAT} of version "
            f"{VERSION}; make the data set again"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{name} is damaged ({type(error).__name__}: {error}); make the data set again") from error
    return description
