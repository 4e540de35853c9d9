"""Whether the files of a dataset are those that were made, by their hashes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from foundation.errors import FormatError
from foundation.hashing import stream_sha256
from foundation.processors import ordered_map
from generator.dataset.production.records import SUMS
from generator.stores.places import DESCRIPTION
from generator.stores.store import Store, open_store


def file_faults(
    place: str | Path, progress: Callable[[int, int], None] | None = None, *, workers: int = 1
) -> Iterator[str]:
    """Yield each file of a dataset that is missing, changed or unknown, in words; reads every byte of it.

    Parameters
    ----------
    place
        Path or URL of the dataset.
    progress
        Called after each file with how many were verified, and how many there are.
    workers
        Threads that read and hash.

    Raises
    ------
    FormatError
        There is no dataset, or it has no list of hashes.
    """
    store = open_store(place)
    if not store.has(DESCRIPTION):
        raise FormatError(f"{place} is no dataset: it has no {DESCRIPTION}; make one with generate")
    with store.open(SUMS) as listed:
        total = sum(1 for _ in listed)
    known: set[str] = {SUMS}
    verified = 0
    with store.open(SUMS) as listed:
        for name, fault in ordered_map(partial(_verify_line, store), enumerate(listed, start=1), workers):
            if fault is not None:
                yield fault
            if not name:
                continue
            known.add(name)
            verified += 1
            if progress is not None:
                progress(verified, total)
    for name in sorted(set(store.names()) - known):
        yield f"{name} is no part of the dataset"


def _verify_line(store: Store, numbered: tuple[int, bytes]) -> tuple[str, str | None]:
    """Return the name that a numbered line of the list has, empty if it has none, and what is wrong."""
    number, line = numbered
    digest, _, name = line.decode("utf-8", "replace").rstrip("\n").partition("  ")
    if not name:
        return "", f"{SUMS}, line {number}: expected a hash, two blanks and a name"
    return name, _fault_of(store, name, digest)


def _fault_of(store: Store, name: str, digest: str) -> str | None:
    try:
        with store.open(name) as stream:
            found = stream_sha256(stream)
    except FormatError:
        return f"{name} is missing or cannot be read"
    return None if found == digest else f"{name} has changed"
