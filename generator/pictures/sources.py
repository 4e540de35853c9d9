"""Where source pictures come from: files, folders of any size, stores past this machine, or random colours."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from foundation.errors import FormatError, InputError, StorageError
from generator.dataset.store import DESCRIPTION, filesystem, is_remote, local_path
from generator.kernels import philox
from generator.pictures.picture import AS_THEY_ARE, LARGEST_SIDE, Picture, Preparation, open_picture

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem

SUFFIXES: Final = frozenset(
    {".avif", ".bmp", ".dpx", ".exr", ".gif", ".hdr", ".heic", ".heif", ".j2k", ".jp2", ".jpe", ".jpeg", ".jpg"}
    | {".jxl", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".psd", ".rgbe", ".sgi", ".tga", ".tif", ".tiff", ".webp"}
)
"""What a folder is searched for, in lower or upper case; a file that is named itself may end as it likes."""

_OF_THE_MACHINE: Final = frozenset(
    {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN}
)
"""Errors of reading that say nothing of a file."""


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """A source picture as it was read.

    Attributes
    ----------
    picture
        (H, W, 3) uint8, sRGB codes.
    sha256
        Hash of the file's bytes; None where there is no file.
    profile
        What was done about its colour profile, in words; None where there is no file.
    """

    picture: Picture
    sha256: str | None = None
    profile: str | None = None


class Source(Protocol):
    """Something that gives one picture."""

    @property
    def name(self) -> str:
        """What the dataset calls it."""
        ...

    def read(self) -> Scene:
        """Return the picture; a FormatError says why it cannot be had."""
        ...

    def told(self) -> dict[str, Any]:
        """Return how it is made or read, as JSON holds it, but not where a file lies."""
        ...


@dataclass(frozen=True, slots=True)
class PictureFile:
    """A file on this machine, or on a store that fsspec knows.

    Attributes
    ----------
    root
        Folder it was found in, as a path or URL; the file itself where it was named.
    below
        Path below the root with forward slashes; empty where the file was named itself.
    preparation
        What is done to it.
    """

    root: str
    below: str
    preparation: Preparation = AS_THEY_ARE

    @property
    def name(self) -> str:
        """What the dataset calls it: its path below the folder, a byte that is no text as its hexadecimal escape."""
        name = self.below or PurePosixPath(self.root.replace(os.sep, "/")).name
        text = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
        # Many readers of CSV take a carriage return for the end of a line, quoted or not.
        return text.replace("\r", "\\r")

    def told(self) -> dict[str, Any]:
        """Return its name and its preparation."""
        return {"picture": self.name, **self.preparation.describe()}

    @property
    def location(self) -> str:
        """The file's path or URL."""
        return f"{self.root.rstrip('/')}/{self.below}" if self.below else self.root

    def read(self) -> Scene:
        """Return the picture; see `picture.open_picture`.

        Raises
        ------
        FormatError
            It is no picture, may not be read, or is gone from among others.
        InputError
            There is not enough memory for it.
        StorageError
            Its bytes cannot be had for a reason that is not its own: a disk that is not mounted, a store that does not
            answer. Then no picture may be passed over as if it were damaged.
        """
        with _at_hand(self.location) as path:
            digest = hashlib.sha256()
            try:
                with path.open("rb") as stream:
                    while chunk := stream.read(1 << 20):
                        digest.update(chunk)
                reading = open_picture(path, self.preparation, self.name)
            except FormatError as error:
                raise FormatError(str(error).replace(str(path), self.location)) from error
            except OSError as error:
                raise _unread(self.location, error, _is_of_the_file(path, error)) from error
            except MemoryError as error:
                raise InputError(
                    f"there is not enough memory to read {self.location}; use fewer workers, or leave it out"
                ) from error
        return Scene(reading.picture, digest.hexdigest(), reading.profile)


@contextmanager
def _at_hand(location: str) -> Generator[Path]:
    """Give a file of this machine; one of a store is copied for as long as it is wanted."""
    if not is_remote(location):
        yield Path(location)
        return
    store, path = filesystem(location)
    try:
        copy = tempfile.NamedTemporaryFile(prefix="crop-", suffix=PurePosixPath(location).suffix)  # noqa: SIM115
    except OSError as error:
        raise _unread(location, error, own=False) from error
    with copy:
        try:
            store.get_file(path, copy.name)
        except Exception as error:
            # Every store raises errors of its own.
            gone = isinstance(error, FileNotFoundError)
            raise _unread(location, error, own=gone and _folder_is_there(store, path)) from error
        yield Path(copy.name)


def _is_of_the_file(path: Path, error: OSError) -> bool:
    """Return whether a file cannot be read for what it is itself, and not for where it lies or who reads it."""
    if error.errno in _OF_THE_MACHINE:
        return False
    # The folder of a disk that is not mounted, or fails, is missing, empty or cannot be listed.
    try:
        with os.scandir(path.parent) as entries:
            return next(entries, None) is not None
    except OSError:
        return False


def _folder_is_there(store: AbstractFileSystem, path: str) -> bool:
    """Return whether the folder of an object is there without it."""
    try:
        store.invalidate_cache()
        return bool(store.isdir(path.rpartition("/")[0]))
    except Exception:
        return False


def _unread(location: str, error: Exception, own: bool) -> FormatError | StorageError:
    """Return what to raise where a picture's bytes cannot be had, be it for a reason of its `own` or not."""
    reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split()).rstrip(".")
    if own:
        return FormatError(f"cannot read {location}: {reason}; name a picture")
    return StorageError(
        f"cannot read {location}: {reason}; see that every machine that works on the dataset can read it, then run the "
        "same command again"
    )


@dataclass(frozen=True, slots=True)
class RandomScene:
    """A picture whose every code is drawn uniformly from 0 … 255: the paper's second set of scenes (section 4.3).

    Codes R, G, B of pixel (x, y) are the three high bytes, highest first, of word x mod 4 of Philox4x32-10 with counter
    (⌊x/4⌋, y, number, 2) and the seed as key.
    """

    number: int
    width: int
    height: int
    seed: int = 0

    @property
    def name(self) -> str:
        """What the dataset calls it."""
        return f"random-{self.number:06d}"

    def told(self) -> dict[str, Any]:
        """Return its number, size and seed."""
        return {"random": self.number, "size": [self.width, self.height], "seed": self.seed}

    def read(self) -> Scene:
        """Return the picture."""
        places = np.arange((self.width + 3) // 4)
        rows = np.arange(self.height)[:, None]
        four = philox.words(self.seed, places, rows, self.number, philox.SCENES)
        words = np.stack(four, axis=-1).reshape(self.height, -1)[:, : self.width]
        codes = np.stack([words >> np.uint32(24), words >> np.uint32(16), words >> np.uint32(8)], axis=-1)
        return Scene(codes.astype(np.uint8))


def random_scenes(count: int, width: int, height: int, seed: int = 0) -> tuple[RandomScene, ...]:
    """Return `count` random scenes of `width` × `height` px, numbered from 0.

    Raises
    ------
    InputError
        A number is out of range.
    """
    if count < 1:
        raise InputError(f"{count} random scenes were asked for, expected 1 or more")
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"random scenes of {width}x{height} were asked for, expected sides of 1 to {LARGEST_SIDE} px")
    return tuple(RandomScene(number, width, height, seed) for number in range(count))


def find_pictures(
    places: Sequence[Path | str] | Path | str, preparation: Preparation = AS_THEY_ARE
) -> tuple[PictureFile, ...]:
    """Return the pictures of folders and files.

    A folder is searched with all folders below it, but for hidden ones, data sets and links to folders, for
    files that end in one of `SUFFIXES`, sorted by their path below it, code point by code point. The order of `places`
    is kept. Nothing is opened: a million files take about 0.2 GB.

    Parameters
    ----------
    places
        Paths of this machine, or URLs that fsspec knows, such as ``s3://bucket/folder``; or a single one.
    preparation
        What is done to each.

    Raises
    ------
    InputError
        A place is missing or neither file nor folder, a folder holds no picture, or two pictures would have one name.
    """
    found: list[PictureFile] = []
    named = (places,) if isinstance(places, Path | str) else places
    for place in named:
        remote = is_remote(str(place))
        # Whole, since a worker may have been started in another folder.
        root = str(place) if remote else os.path.abspath(local_path(place))  # noqa: PTH100  keeps no link's target
        if not remote and not os.path.lexists(root):
            raise InputError(f"there is no {place}; name a picture or a folder of pictures")
        if not remote and Path(root).exists() and not (Path(root).is_dir() or Path(root).is_file()):
            raise InputError(f"{place} is a device or a pipe; name a picture or a folder of pictures")
        if not remote and not Path(root).is_dir():
            found.append(PictureFile(root, "", preparation))
            continue
        before = len(found)
        below = _below_url(root) if remote else _below_folder(root)
        found += [PictureFile(root, name, preparation) for name in below]
        if len(found) == before:
            raise InputError(f"{root} holds no picture; expected files that end in one of {' '.join(sorted(SUFFIXES))}")
    if len(named) > 1:
        _refuse_names(found)
    return tuple(found)


def _refuse_names(found: Sequence[PictureFile]) -> None:
    """Raise an InputError that tells two pictures of one name."""
    seen: dict[str, PictureFile] = {}
    for picture in found:
        if (other := seen.setdefault(picture.name, picture)) is not picture:
            raise InputError(
                f"two pictures would be called {picture.name}: {other.location} and {picture.location}; name a folder "
                "that holds both, or rename one"
            )


def _is_picture(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in SUFFIXES  # noqa: PTH122  a million Path objects take a minute


def _below_folder(folder: str, prefix: str = "") -> Iterator[str]:
    """Give the pictures below a folder in the order of their whole paths, one folder's list in memory at a time."""
    try:
        with os.scandir(folder) as entries:
            # A folder sorts as its path goes on: with the slash.
            listed = sorted(
                f"{entry.name}/" if entry.is_dir(follow_symlinks=False) else entry.name
                for entry in entries
                if not entry.name.startswith(".")
                and (
                    entry.is_dir(follow_symlinks=False)
                    or (_is_picture(entry.name) and _is_file(entry))
                    or entry.name == DESCRIPTION
                )
            )
    except OSError as error:
        raise InputError(f"cannot look into {folder}: {error.strerror}; name a folder that may be read") from error
    if DESCRIPTION in listed:
        # A data set among the pictures, the one made of them perhaps: its images are no sources.
        if prefix:
            return
        listed.remove(DESCRIPTION)
    for name in listed:
        if name.endswith("/"):
            yield from _below_folder(f"{folder.rstrip('/')}/{name[:-1]}", prefix + name)
        else:
            yield prefix + name


def _is_file(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a file or leads to one; a link that leads round in a circle does not."""
    try:
        return entry.is_file()
    except OSError as error:
        if error.errno == errno.ELOOP:
            return False
        raise


def _below_url(url: str) -> list[str]:
    """Return the pictures below a URL, or ``""`` where it is a file itself."""
    store, root = filesystem(url)
    try:
        if store.isfile(root):
            return [""]
        top = PurePosixPath(root)
        listed = [PurePosixPath(path).relative_to(top) for path in store.find(root)]
    except Exception as error:
        # Every store raises errors of its own.
        raise InputError(f"cannot look into {url}: {error}; check the address and that you may read there") from error
    datasets = {path.parent for path in listed if path.name == DESCRIPTION and len(path.parts) > 1}
    return sorted(
        path.as_posix()
        for path in listed
        if _is_picture(path.name)
        and not any(part.startswith(".") for part in path.parts)
        and datasets.isdisjoint(path.parents)
    )
