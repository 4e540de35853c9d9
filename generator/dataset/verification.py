"""Whether the files of a dataset are those that were made, by their hashes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from foundation.errors import FormatError
from foundation.foreign_folders import bounded_lines, is_inside_name
from foundation.hashing import stream_sha256
from foundation.processors import ordered_map
from generator.dataset.production.cards.facts import COMPLETED_BY_HAND
from generator.dataset.production.records import SUMS
from generator.stores.places import DESCRIPTION
from generator.stores.store import Store, open_store

_LINE: Final = re.compile("[0-9a-f]{64}")
"""A hash as `sha256sum` writes it."""


def file_faults(
    place: str | Path, progress: Callable[[int, int], None] | None = None, *, workers: int = 1
) -> Iterator[str]:
    """Yield each file of a dataset that is missing, changed or unknown, in words; reads every byte of it.

    Card, datasheet and Croissant metadata are completed by hand and not looked at, unless older software listed them.
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
