"""Where source pictures come from: files, folders of any size, remote stores, or random colours."""

from __future__ import annotations

import errno
import logging
import os
import re
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from foundation.errors import FormatError, InputError, StorageError
from foundation.files import file_sha256, sha256_of, stream_sha256
from foundation.secret_texts import masked
from generator import philox
from generator.pictures.picture import LARGEST_SIDE, UNPREPARED, Cut, Picture, Preparation, open_picture
from generator.stores import DESCRIPTION, filesystem, is_remote, local_path

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem

SUFFIXES: Final = frozenset(
    {".avif", ".bmp", ".dpx", ".exr", ".gif", ".hdr", ".j2k", ".jp2", ".jpe", ".jpeg", ".jpg"}
    | {".jxl", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".psd", ".rgbe", ".sgi", ".tga", ".tif", ".tiff", ".webp"}
)
"""Ends of the names for which a folder is searched, in either case; a file that is named itself may have any end."""

UNREADABLE: Final = frozenset({".heic", ".heif"})
"""Ends of pictures' names that no library of a plain installation reads; those in a folder are told."""

_LIKE_A_BYTE: Final = re.compile(r"\\+(?=x[89a-f][0-9a-f]|[\udc80-\udcff])")
"""Backslashes before a byte that is no text, or before two digits that are written like one."""
_KEPT: Final = 1 << 25
"""Most bytes of a file that is read once, to be hashed and decoded: 32 MiB are nothing beside what it unpacks to."""

_log = logging.getLogger(__name__)

_MACHINE_ERRORS: Final = frozenset(
    {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN}
)
"""Errors of reading that have their cause in the machine or its store, not in the file."""


@dataclass(frozen=True, eq=False, slots=True)
class SourcePicture:
    """A source picture as it was read.

    - `picture`: (H, W, 3) uint8, sRGB codes; of several crops the first.
    - `sha256`: hash of the file's bytes; None where there is no file.
    - `profile`: how its colour profile was treated, in words; None where there is no file.
    - `cuts`: the crops, where several were asked for.
    - `weight`: by which it was drawn; None where pictures were not drawn by weights.
    - `black_taken`: share of the print's black, 0 … 1, that is taken out of its images; None where options say it.
    - `notes`: as those of `picture.Reading`.
    """

    picture: Picture
    sha256: str | None = None
    profile: str | None = None
    cuts: tuple[Cut, ...] = ()
    weight: float | None = None
    black_taken: float | None = None
    notes: tuple[str, ...] = ()


class Source(Protocol):
    """One picture that can be read, from wherever."""

    @property
    def name(self) -> str:
        """The picture's name in the dataset."""
        ...

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; a FormatError says why it cannot be read."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Return as a JSON object how the picture is made or read, without the place of a file."""
        ...


@dataclass(frozen=True, slots=True)
class PictureFile:
    """A file on this machine, or on a store that fsspec knows.

    - `root`: folder it was found in, as a path or URL; the file itself where it was named.
    - `below`: path below the root with forward slashes; empty where the file was named itself.
    - `preparation`: how it is prepared.
    """

    root: str
    below: str
    preparation: Preparation = UNPREPARED

    @property
    def name(self) -> str:
        r"""Its name in the dataset: its path below the folder, with \xNN for bytes that are no text.

        No two paths have one name: backslashes before such a byte, or before what reads like one, stand twice.
        """
        name = self.below or PurePosixPath(masked(self.root).replace(os.sep, "/")).name
        name = _LIKE_A_BYTE.sub(lambda found: 2 * found[0], name)
        text = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
        # Many readers of CSV end a line at a carriage return, quoted or not.
        return text.replace("\r", "\\r")

    def to_json(self) -> dict[str, Any]:
        """Return its name and its preparation as a JSON object."""
        return {"picture": self.name, **self.preparation.describe()}

    @property
    def location(self) -> str:
        """The file's path or URL."""
        return f"{self.root.rstrip('/')}/{self.below}" if self.below else self.root

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; see `picture.open_picture`."""
        with _local_file(self.location) as path:
            try:
                sha256, data = _hashed(path)
                reading = open_picture(path, self.preparation, self.name, data)
            except FormatError as error:
                raise FormatError(str(error).replace(str(path), self.location)) from error
            except OSError as error:
                raise _unreadable(self.location, error, _is_of_the_file(path, error)) from error
            except MemoryError as error:
                raise InputError(
                    f"there is not enough memory to read {self.location}; use fewer workers, or leave it out"
                ) from error
        return SourcePicture(reading.picture, sha256, reading.profile, reading.cuts, notes=reading.notes)


def hash_since(source: Source, moment: float) -> str | None:
    """Return the SHA-256 of a source's file if that is on this machine and was changed after a moment.

    Returns none where there is no such file, or it was not changed. A file that was removed has an empty hash.
    """
    file: object = getattr(source, "source", source)
    if not isinstance(file, PictureFile) or is_remote(file.location):
        return None
    try:
        status = Path(file.location).stat()
        # The second changes with every change of the first, and no program sets it back.
        return file_sha256(Path(file.location)) if max(status.st_mtime, status.st_ctime) > moment else None
    except OSError:
        return ""


@contextmanager
def _local_file(location: str) -> Generator[Path]:
    """Yield the path of a file of this machine; one of a store is copied, and the copy removed at the end."""
    if not is_remote(location):
        yield Path(location)
        return
    store, path = filesystem(location)
    try:
        copy = tempfile.NamedTemporaryFile(prefix="crop-", suffix=PurePosixPath(location).suffix)  # noqa: SIM115
    except OSError as error:
        raise _unreadable(location, error, of_the_file=False) from error
    with copy:
        try:
            store.get_file(path, copy.name)
        except Exception as error:
            # Every store raises errors of its own.
            gone = isinstance(error, FileNotFoundError)
            raise _unreadable(location, error, of_the_file=gone and _folder_is_there(store, path)) from error
        yield Path(copy.name)


def _hashed(path: Path) -> tuple[str, bytes | None]:
    """Return the SHA-256 of a file, and its bytes where they are few enough to be kept until they are decoded."""
    # Without a buffer of Python's own, which asks the system four questions about each file.
    with path.open("rb", buffering=0) as stream:
        if os.fstat(stream.fileno()).st_size > _KEPT:
            return stream_sha256(stream), None
        data = stream.read()
    return sha256_of(data), data


def _is_of_the_file(path: Path, error: OSError) -> bool:
    """Return whether the cause of the error is the file itself, not the machine or the disk."""
    if error.errno in _MACHINE_ERRORS:
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


def _unreadable(location: str, error: Exception, of_the_file: bool) -> FormatError | StorageError:
    """Return the exception for a picture that cannot be read, whether the cause is the file itself or not."""
    reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split()).rstrip(".")
    if of_the_file:
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

    - `number`: 0 … 2³² − 1; scenes of different numbers are independent.
    - `width`, `height`: size, px.
    - `seed`: 0 … 2⁶⁴ − 1.
    """

    number: int
    width: int
    height: int
    seed: int = 0

    @property
    def name(self) -> str:
        """The picture's name in the dataset."""
        return f"random-{self.number:06d}"

    def to_json(self) -> dict[str, Any]:
        """Return its number, size and seed as a JSON object."""
        return {"random": self.number, "size": [self.width, self.height], "seed": self.seed}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8."""
        places = np.arange((self.width + 3) // 4)
        rows = np.arange(self.height)[:, None]
        four = philox.words(self.seed, places, rows, self.number, philox.SCENES)
        words = np.stack(four, axis=-1).reshape(self.height, -1)[:, : self.width]
        codes = np.stack([words >> np.uint32(24), words >> np.uint32(16), words >> np.uint32(8)], axis=-1)
        return SourcePicture(codes.astype(np.uint8))


def random_scenes(count: int, width: int, height: int, seed: int = 0) -> tuple[RandomScene, ...]:
    """Return `count` random scenes of `width` × `height` px, numbered from 0.

    Examples
    --------
    >>> first, second = random_scenes(2, width=4, height=3)
    >>> second.name, second.read().picture.shape
    ('random-000001', (3, 4, 3))
    """
    if count < 1:
        raise InputError(f"{count} random scenes were asked for, expected 1 or more")
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"random scenes of {width}x{height} were asked for, expected sides of 1 to {LARGEST_SIDE} px")
    return tuple(RandomScene(number, width, height, seed) for number in range(count))


def find_pictures(
    places: Sequence[Path | str] | Path | str, preparation: Preparation = UNPREPARED
) -> tuple[PictureFile, ...]:
    """Return the pictures of folders and files.

    A folder is searched with all folders below it, except hidden ones and data sets, for files whose names end in one
    of `SUFFIXES`. A link to a folder is followed, unless that is searched already or holds what is searched, so that
    no picture comes twice and no search goes round in a circle. Pictures are sorted by their path below the folder,
    code point by code point; the order of `places` is kept. No file is opened; a million of them take about 0.2 GB of
    memory. A warning is logged of pictures that cannot be read (`UNREADABLE`).

    Parameters
    ----------
    places
        Paths of this machine, or URLs that fsspec knows, such as ``s3://bucket/folder``; or a single one.
    preparation
        How each is prepared.

    Raises
    ------
    InputError
        A place is missing or neither file nor folder, a folder holds no picture, or two pictures would have one name.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("b.png", "a.JPG", "notes.txt"):
    ...         Path(folder, name).touch()
    ...     [picture.name for picture in find_pictures(folder)]
    ['a.JPG', 'b.png']
    """
    found: list[PictureFile] = []
    named = (places,) if isinstance(places, Path | str) else places
    for place in named:
        remote = is_remote(str(place))
        # Absolute, since a worker may have been started in another folder.
        root = str(place) if remote else os.path.abspath(local_path(place))  # noqa: PTH100  keeps no link's target
        if not remote and not os.path.lexists(root):
            raise InputError(f"there is no {place}; name a picture or a folder of pictures")
        if not remote and Path(root).exists() and not (Path(root).is_dir() or Path(root).is_file()):
            raise InputError(f"{place} is a device or a pipe; name a picture or a folder of pictures")
        if not remote and not Path(root).is_dir():
            found.append(PictureFile(root, "", preparation))
            continue
        before = len(found)
        search = _Search(root)
        below = _below_url(root, search) if remote else _below_folder(root, search)
        found += [PictureFile(root, name, preparation) for name in below]
        told = search.sentence(masked(root))
        if len(found) == before:
            expected = f"expected files that end in one of {' '.join(sorted(SUFFIXES))}"
            raise InputError(told or f"{root} holds no picture; {expected}")
        if told:
            _log.warning(told)
    if len(named) > 1:
        _refuse_names(found)
    return tuple(found)


def _refuse_names(found: Sequence[PictureFile]) -> None:
    """Raise an InputError that names two pictures of one name, if there are any."""
    seen: dict[str, PictureFile] = {}
    for picture in found:
        if (other := seen.setdefault(picture.name, picture)) is not picture:
            raise InputError(
                f"two pictures would be called {picture.name}: {other.location} and {picture.location}; name a folder "
                "that holds both, or rename one"
            )


def _is_unreadable(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in UNREADABLE  # noqa: PTH122  as below


def _is_picture(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in SUFFIXES  # noqa: PTH122  a million Path objects take a minute


class _Search:
    """What a search for pictures has followed and passed over."""

    def __init__(self, root: str) -> None:
        self._searched = [root if is_remote(root) else os.path.realpath(root)]
        self._unreadable = 0
        self._first = ""

    def follows(self, link: str) -> bool:
        """Return whether a link to a folder is followed: what is, or holds, what is searched already is not."""
        target = os.path.realpath(link)
        for folder in self._searched:
            if os.path.commonpath([folder, target]) in (folder, target):
                _log.info("%s is not followed: it leads to %s, which is searched already or holds it", link, target)
                return False
        self._searched.append(target)
        return True

    def pass_over(self, name: str) -> None:
        """Count a picture that cannot be read."""
        self._unreadable += 1
        self._first = self._first or name

    def sentence(self, place: str) -> str | None:
        """Return what is to be told of pictures that cannot be read; None if there are none."""
        if not self._unreadable:
            return None
        others = f" and {self._unreadable - 1} more" if self._unreadable > 1 else ""
        return (
            f"{place} holds {self._first}{others}, which {'are' if others else 'is'} left out: HEIC is not read; "
            "convert to JPEG, PNG or AVIF"
        )


def _below_folder(folder: str, search: _Search, prefix: str = "") -> Iterator[str]:
    """Yield the pictures below a folder in the order of their paths, with one folder's list in memory at a time."""
    links: set[str] = set()
    try:
        with os.scandir(folder) as entries:
            listed: list[str] = []
            for entry in entries:
                name = entry.name
                if name.startswith("."):
                    continue
                if _is(entry.is_dir):
                    # A folder is sorted with the slash that follows it in a path.
                    listed.append(f"{name}/")
                    if entry.is_symlink():
                        links.add(f"{name}/")
                elif name == DESCRIPTION or (_is_picture(name) and _is(entry.is_file)) or _is_unreadable(name):
                    listed.append(name)
            listed.sort()
    except OSError as error:
        raise InputError(f"cannot look into {folder}: {error.strerror}; name a folder that may be read") from error
    if DESCRIPTION in listed:
        # A data set among the pictures, perhaps the one that is made of them: its images are no sources.
        if prefix:
            return
        listed.remove(DESCRIPTION)
    for name in listed:
        if name.endswith("/"):
            path = f"{folder.rstrip('/')}/{name[:-1]}"
            if name not in links or search.follows(path):
                yield from _below_folder(path, search, prefix + name)
        elif _is_unreadable(name):
            search.pass_over(prefix + name)
        else:
            yield prefix + name


def _is(asked: Callable[[], bool]) -> bool:
    """Return what an entry says of itself, a link of what it leads to; a link in a circle of links leads nowhere."""
    try:
        return asked()
    except OSError as error:
        if error.errno == errno.ELOOP:
            return False
        raise


def _below_url(url: str, search: _Search) -> list[str]:
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
    seen = sorted(
        path.as_posix()
        for path in listed
        if not any(part.startswith(".") for part in path.parts) and datasets.isdisjoint(path.parents)
    )
    for name in filter(_is_unreadable, seen):
        search.pass_over(name)
    return list(filter(_is_picture, seen))
