"""Places as a user writes them: a path of this machine, or the URL of an object store that fsspec reaches."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from foundation.errors import InputError

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem

DESCRIPTION: Final = "dataset.json"
"""Name of the file that marks a place as a complete dataset; it is written last."""


def is_remote(place: str) -> bool:
    """Return whether `place` is a URL of a store and not a path of this machine (file:// is a path).

    Examples
    --------
    >>> is_remote("s3://bucket/dataset"), is_remote("file:///data/dataset"), is_remote("dataset")
    (True, False, False)
    """
    scheme, found, _ = place.partition("://")
    return bool(found) and scheme not in ("file", "local")


def local_path(place: str | Path) -> Path:
    """Return the path of a place of this machine, of which file:// may be the first part; it ends in a name.

    Examples
    --------
    >>> local_path("file:///data/dataset").as_posix()
    '/data/dataset'
    """
    text = str(place)
    for scheme in ("file://", "local://"):
        text = text.removeprefix(scheme)
    path = Path(text)
    if text and path.name in ("", ".."):
        path = path.resolve()
    if not path.name:
        raise InputError(f"{str(place)!r} names no place; name a folder, such as dataset")
    return path


def filesystem(url: str) -> tuple[AbstractFileSystem, str]:
    """Return the store of a URL, by fsspec, and the path in it."""
    from fsspec.core import url_to_fs

    try:
        return url_to_fs(url)
    except Exception as error:
        # A store may connect here, and has errors of its own (ftplib's are no OSError).
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"cannot reach {url}: {reason}; name a store that fsspec knows, and install its library (s3://: s3fs, "
            "gs://: gcsfs, az://: adlfs)"
        ) from error
