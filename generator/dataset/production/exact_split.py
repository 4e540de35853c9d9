"""Parts of a dataset of exactly the sizes asked for, decided for all sources together before any is rendered.

Sources are ranked by a hash of the seed and their name, and cut by their number. Pictures of one name, and copies of
one file, whatever their names, stay together; of files, only those of one length are read to find copies.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from foundation.errors import InputError
from foundation.hashing import file_sha256
from generator.dataset.production.records import SPLITS, Split
from generator.pictures.sources import PictureFile
from generator.stores.places import is_remote

if TYPE_CHECKING:
    from generator.pictures.sources import Source


def exact_parts(sources: Sequence[Source], shares: tuple[float, float, float], seed: int) -> tuple[Split, ...]:
    """Return the part of each source; parts have the sizes of `sizes_of`."""
    wanted: dict[Split, int] = dict(zip(SPLITS, sizes_of(len(sources), shares), strict=True))
    groups: dict[str, list[int]] = defaultdict(list)
    copies = _copies(sources)
    for place, source in enumerate(sources):
        groups[copies.get(place, f"name {source.name}")].append(place)
    ranked = sorted(groups, key=lambda key: hashlib.sha256(f"split {seed} {key}".encode()).digest())
    parts: dict[int, Split] = {}
    # Copies first, while there is room; a stable sort keeps the order of the hashes among groups of one size.
    for key in sorted(ranked, key=lambda key: -len(groups[key])):
        group = groups[key]
        part: Split | None = next((name for name in SPLITS if wanted[name] >= len(group)), None)
        if part is None:
            raise InputError(
                f"{len(group)} copies of {sources[group[0]].name} stay in one part, and none of the parts of exactly "
                f"{','.join(map(str, sizes_of(len(sources), shares)))} has room for them; leave copies out, or ask for "
                "other sizes"
            )
        wanted[part] -= len(group)
        parts.update((place, part) for place in group)
    return tuple(parts[place] for place in range(len(sources)))


def sizes_of(count: int, shares: tuple[float, float, float]) -> tuple[int, int, int]:
    """Return how many of `count` sources each part has: shares rounded by largest remainders.

    Examples
    --------
    >>> sizes_of(10, (0.8, 0.1, 0.1)), sizes_of(11, (0.8, 0.1, 0.1)), sizes_of(1000, (0.7, 0.2, 0.1))
    ((8, 1, 1), (9, 1, 1), (700, 200, 100))
    """
    # Shares are quotients: a product that should be whole may be off by its last bits.
    exact = [round(share * count, 6) for share in shares]
    sizes = [int(size) for size in exact]
    by_remainder = sorted(range(3), key=lambda part: (sizes[part] - exact[part], part))
    for part in by_remainder[: count - sum(sizes)]:
        sizes[part] += 1
    return sizes[0], sizes[1], sizes[2]


def _copies(sources: Sequence[Source]) -> dict[int, str]:
    """Return by place what tells the content of files that may be copies of others: those that are as long."""
    by_length: dict[int, list[int]] = defaultdict(list)
    for place, source in enumerate(map(_file_of, sources)):
        if isinstance(source, PictureFile) and not is_remote(source.location):
            try:
                by_length[Path(source.location).stat().st_size].append(place)
            except OSError:
                # It is left out, and named, where it is to be read.
                continue
    found: dict[int, str] = {}
    for places in by_length.values():
        for place in places if len(places) > 1 else ():
            source = _file_of(sources[place])
            if isinstance(source, PictureFile):
                try:
                    found[place] = f"file {file_sha256(Path(source.location))}"
                except OSError:
                    continue
    return found


def _file_of(source: Source) -> Source:
    """Return what a source with a weight, or one that must be as it was, is of."""
    return getattr(source, "source", source)
