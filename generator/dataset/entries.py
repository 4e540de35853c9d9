"""The images of a dataset, read from its tables of ground truths: `ground_truth.csv`, `gt.txt` and `splits/`."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import groupby
from typing import Final

from foundation.errors import FormatError, InputError
from foundation.foreign_folders import bounded_lines
from generator.dataset.production.records import (
    GROUND_TRUTH,
    GROUND_TRUTH_COLUMNS,
    SPLITS,
    TRUTHS,
    Description,
    Entry,
    Split,
    Triple,
)
from generator.lights.lighting import parse_mixture
from generator.stores.places import DESCRIPTION
from generator.stores.store import Store

_NAME: Final = re.compile(r"([0-9]{1,10})(\.[A-Za-z0-9.]*)?")
"""A number, of which ten digits count all images that a dataset holds, and an ending."""
_VALID: Final = "with r + g + b = 1 and none below 0"
_ROUNDING: Final = 2e-6
"""What sums and means of chromaticities may be off by: more than six written digits are, and less than a thousandth of
a degree."""
_KEPT: Final = 4096
"""Lights of images that are kept, since many images share one: several times a table's lights."""


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
    """Yield the rows of a CSV file with the line where each ends."""
    rows = csv.DictReader(table)
    try:
        for row in rows:
            yield rows.line_num, row
    except csv.Error as error:
        raise FormatError(f"{name}, line {rows.line_num + 1} is no CSV: {error}; make the dataset again") from error


def _read_rows(
    name: str, rows: Iterable[tuple[int, dict[str, str]]]
) -> tuple[str, tuple[str, ...], tuple[Triple, ...]]:
    """Return source, labels and ground truths of the lights from an image's rows with their line numbers."""
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
