"""Which files lie in a folder, and whether they are those that should: names only, no file is opened."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from foundation.errors import FormatError, first_of

IMAGE_ENDINGS = (".png", ".tif", ".tiff", ".npy")
"""Of files that hold linear images of 16 bits or more."""


@dataclass(frozen=True)
class Folder:
    """The names in a folder, read once; hidden files, such as those that systems leave behind, are not seen."""

    path: Path

    @cached_property
    def _entries(self) -> tuple[list[str], list[str]]:
        files: list[str] = []
        folders: list[str] = []
        try:
            with os.scandir(self.path) as found:
                for entry in found:
                    if not entry.name.startswith("."):
                        (folders if entry.is_dir() else files).append(entry.name)
        except OSError as error:
            raise FormatError(f"{self.path} cannot be read: {error.strerror or error}; name a folder") from error
        return files, folders

    @cached_property
    def files(self) -> Sequence[str]:
        """The names of its files, sorted."""
        return sorted(self._entries[0])

    @cached_property
    def folders(self) -> Mapping[str, Folder]:
        """The folders in it by their names, numbers in them by their value."""
        return {name: Folder(self.path / name) for name in in_natural_order(self._entries[1])}

    def has(self, name: str) -> bool:
        """Return whether a file of that name is in it."""
        return (self.path / name).is_file()

    def within(self, depth: int) -> Iterator[Folder]:
        """Yield this folder and those below it, down to `depth` folders deep."""
        yield self
        if depth:
            for folder in self.folders.values():
                yield from folder.within(depth - 1)

    def images(self, endings: Collection[str] = (".png",)) -> dict[str, str]:
        """Return the paths of its images by their names without ending, in natural order."""
        found: dict[str, str] = {}
        for name in self.files:
            stem, _, ending = name.rpartition(".")
            if f".{ending.lower()}" in endings:
                if stem in found:
                    raise FormatError(
                        f"{self.path} has {name} and {Path(found[stem]).name}, expected one file an image; remove one"
                    )
                found[stem] = f"{self.path}{os.sep}{name}"
        return {stem: found[stem] for stem in in_natural_order(found)}


def gather(folders: Iterable[Folder], endings: Collection[str] = (".png",)) -> dict[str, str]:
    """Return the paths of the images in several folders by their names without ending."""
    found: dict[str, str] = {}
    for folder in folders:
        images = folder.images(endings)
        twice = next((name for name in images if name in found), None)
        if twice is not None:
            raise FormatError(
                f"{images[twice]} and {found[twice]} are both there, expected each image once; remove one"
            )
        found |= images
    return found


def in_natural_order(names: Iterable[str]) -> list[str]:
    """Return names sorted so that numbers in them go by their values.

    Examples
    --------
    >>> in_natural_order(["a10", "10", "9", "a2"])
    ['9', '10', 'a2', 'a10']
    """
    given = list(names)
    if len({name.translate(_DIGITS) for name in given}) <= 1:
        return sorted(given)  # Numbers of as many digits in the same places: a million names in a second.
    return sorted(given, key=natural)


_DIGITS = str.maketrans("0123456789", "0" * 10)


def natural(name: str) -> list[str | int]:
    """Return what sorts names with numbers by the numbers' values.

    Examples
    --------
    >>> sorted(["a10", "10.png", "9.png", "a2"], key=natural)
    ['9.png', '10.png', 'a2', 'a10']
    """
    parts: list[str | int] = list(re.split(r"([0-9]+)", name))  # Text and digits in turn, text first.
    parts[1::2] = [int(digits) for digits in parts[1::2]]
    return parts


def present(
    names: Sequence[str], images: Mapping[str, str], source: str, folder: Path | str, partial: bool
) -> tuple[list[int], str]:
    """Return which of the images that a data set should have are there, and a sentence on their number.

    Examples
    --------
    >>> present(["1", "2"], {"2": "set/2.png"}, "gt.txt", Path("set"), partial=True)
    ([1], '1; 1 of the 2 of gt.txt is not in this copy and left out')
    """
    wanted = set(names)
    if len(wanted) != len(names):
        seen: set[str] = set()
        twice = next(name for name in names if name in seen or seen.add(name))
        raise FormatError(f"{source} names {twice} twice, expected each image once; correct it")
    missing = [name for name in names if name not in images]
    superfluous = [name for name in images if name not in wanted]
    if superfluous:
        raise FormatError(
            f"{folder} has {len(superfluous)} images that {source} does not know ({first_of(superfluous)}), expected "
            f"its {len(names)} and no other; remove them, or complete {source}"
        )
    if missing and (not partial or len(missing) == len(names)):
        raise FormatError(
            f"{folder} lacks {len(missing)} of the {len(names)} images of {source} ({first_of(missing)}); complete "
            "the copy" + ("" if len(missing) == len(names) else ", or take what is there with --partial")
        )
    kept = [number for number, name in enumerate(names) if name in images]
    note = str(len(kept))
    if missing:
        note += (
            f"; {len(missing)} of the {len(names)} of {source} {'is' if len(missing) == 1 else 'are'} not in this "
            "copy and left out"
        )
    return kept, note
