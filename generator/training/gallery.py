"""Decoded pictures for training, so that crops can be cut without decoding.

A gallery is a folder with two files. `codes.u8` has the sRGB codes R, G, B of all pictures, one picture after another,
row by row. `gallery.json` has the size of each picture. The codes are memory-mapped: workers share one copy, and unused
pictures take no memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from foundation.errors import FormatError, InputError, value_text
from foundation.files import storage_error, write_atomic
from foundation.folders import atomic_folder
from foundation.records import Record
from generator.kernels.choice import check_picture
from generator.pictures.sources import Picture, Source

FORMAT: Final = "crop.gallery"
VERSION: Final = 1  # The only version so far


class _Entry(Record):
    name: str
    sha256: str | None
    width: int
    height: int


class _Head(Record):
    format: Literal["crop.gallery"] = FORMAT
    version: Literal[1] = VERSION
    pictures: list[_Entry]
    skipped: list[str]


@dataclass(frozen=True, eq=False)
class Gallery:
    """Pictures in one flat array.

    Attributes
    ----------
    names
        Names of the P pictures.
    codes
        (N,) uint8, sRGB codes of all pictures one after another.
    sizes
        (P, 2) int64, height and width, px.
    offsets
        (P,) int64, index in `codes` of the first value of each picture.
    folder
        Folder of the gallery; None if it is in memory.

    Examples
    --------
    >>> Gallery(("grey",), np.full(12, 128, np.uint8), np.array([[2, 2]]), np.array([0])).picture(0).shape
    (2, 2, 3)
    """

    names: tuple[str, ...]
    codes: npt.NDArray[np.uint8]
    sizes: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]
    folder: Path | None = None

    def __repr__(self) -> str:
        """Return a summary in one line."""
        return f"Gallery of {len(self)} pictures" + ("" if self.folder is None else f" in {str(self.folder)!r}")

    def __len__(self) -> int:
        """Return the number of pictures."""
        return len(self.names)

    def __reduce__(self) -> tuple[Any, ...]:
        # A worker maps the files again instead of receiving gigabytes.
        if self.folder is not None:
            return open_gallery, (self.folder,)
        return Gallery, (self.names, self.codes, self.sizes, self.offsets)

    def picture(self, number: int) -> Picture:
        """Return a picture.

        Parameters
        ----------
        number
            Index of the picture, 0 … P − 1.

        Returns
        -------
        ndarray
            (H, W, 3) uint8, sRGB codes; a view.
        """
        height, width = (int(side) for side in self.sizes[number])
        start = int(self.offsets[number])
        return self.codes[start : start + 3 * height * width].reshape(height, width, 3)


def gallery_of(pictures: Sequence[Picture], names: Sequence[str] | None = None) -> Gallery:
    """Return a gallery in memory.

    Parameters
    ----------
    pictures
        1 or more pictures (H, W, 3) uint8, sRGB codes.
    names
        Name of each picture; numbers if None.

    Returns
    -------
    Gallery
        The gallery; its codes are a copy.

    Raises
    ------
    InputError
        If there is no picture, a picture has another shape or type, or the number of names differs.

    Examples
    --------
    >>> gallery = gallery_of([np.zeros((4, 6, 3), np.uint8), np.ones((2, 2, 3), np.uint8)], ["dark", "other"])
    >>> len(gallery), gallery.codes.shape, gallery.picture(1).shape
    (2, (84,), (2, 2, 3))
    """
    if isinstance(pictures, str) or not len(pictures):
        raise InputError(f"the pictures are {value_text(pictures)}, expected a list, such as [read_picture(FILE)]")
    if names is not None and len(names) != len(pictures):
        raise InputError(f"{len(pictures)} pictures have {len(names)} names, expected one name each")
    for picture in pictures:
        check_picture(picture)
        if not picture.size:
            raise InputError(f"a picture has {picture.shape[1]}x{picture.shape[0]} px, expected 1x1 or more")
    sizes = np.array([picture.shape[:2] for picture in pictures], dtype=np.int64)
    codes = np.concatenate([picture.reshape(-1) for picture in pictures])
    gallery_names = [str(number) for number in range(len(pictures))] if names is None else names
    return Gallery(tuple(gallery_names), codes, sizes, _offsets(sizes))


def _offsets(sizes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(3 * sizes.prod(axis=1))[:-1]]).astype(np.int64)


def save_gallery(
    sources: Sequence[Source], folder: Path, on_skip: Callable[[Source, str], None] | None = None
) -> Gallery:
    """Decode pictures and save them as a gallery in a new folder.

    Parameters
    ----------
    sources
        The pictures; see `pictures.sources.find_pictures`. A picture that cannot be read is skipped and listed.
    folder
        Folder of the gallery, which must not exist. It appears when it is complete.
    on_skip
        Called with each skipped source and the reason.

    Returns
    -------
    Gallery
        The saved gallery, memory-mapped.

    Raises
    ------
    InputError
        If the folder exists.
    FormatError
        If no picture can be read.
    StorageError
        If the disk is full or fails; no files are left.

    Examples
    --------
    >>> import tempfile
    >>> from generator import find_pictures
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     gallery = save_gallery(find_pictures("cat.png"), Path(folder) / "gallery")
    >>> gallery.names, gallery.sizes.tolist()
    (('cat.png',), [[40, 50]])
    """
    entries: list[_Entry] = []
    skipped: list[str] = []
    with atomic_folder(folder, "the gallery") as partial:
        path = partial / "codes.u8"
        try:
            with path.open("wb") as stream:
                for source in sources:
                    try:
                        scene = source.read()
                    except FormatError as error:
                        skipped.append(source.name)
                        if on_skip:
                            on_skip(source, str(error))
                        continue
                    height, width = scene.picture.shape[:2]
                    entries.append(_Entry(name=source.name, sha256=scene.sha256, width=width, height=height))
                    stream.write(np.ascontiguousarray(scene.picture).data)
        except OSError as error:
            raise storage_error(path, error) from error
        if not entries:
            raise FormatError(f"0 of {len(sources)} pictures can be read, expected 1 or more; name other pictures")
        head = _Head(pictures=entries, skipped=skipped)
        write_atomic(partial / "gallery.json", head.model_dump_json(indent=2) + "\n")
    return open_gallery(folder)


def open_gallery(folder: Path | str) -> Gallery:
    """Open a gallery made by `save_gallery`, memory-mapped.

    Parameters
    ----------
    folder
        Folder of the gallery.

    Returns
    -------
    Gallery
        The gallery.

    Raises
    ------
    FormatError
        If the folder is not a gallery, or its files are inconsistent.

    Examples
    --------
    >>> import tempfile
    >>> from generator import find_pictures
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = save_gallery(find_pictures("cat.png"), Path(folder) / "gallery")
    ...     open_gallery(Path(folder) / "gallery").picture(0).shape
    (40, 50, 3)
    """
    folder = Path(folder)
    path = folder / "gallery.json"
    try:
        head = _Head.model_validate_json(path.read_bytes())
        codes = np.memmap(folder / "codes.u8", np.uint8, "r")
    except (OSError, ValueError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise FormatError(f"{folder} is not a gallery: {reason}; make one with save_gallery") from error
    sizes = np.array([(entry.height, entry.width) for entry in head.pictures], dtype=np.int64)
    expected_size = int(3 * sizes.prod(axis=1).sum())
    if codes.size != expected_size:
        raise FormatError(
            f"{folder / 'codes.u8'} has {codes.size} bytes, expected {expected_size}; make the gallery again"
        )
    return Gallery(tuple(entry.name for entry in head.pictures), codes, sizes, _offsets(sizes), folder)
