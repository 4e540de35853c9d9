"""Access to object stores by URL through fsspec, and errors with remedies.

The library of a store takes the address of the server and the keys from the environment; see docs/clusters.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from foundation.errors import RUN_AGAIN, FormatError, InputError, StorageError
from foundation.secret_texts import masked

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem

# Classes of errors that are raised if a server does not answer: of botocore, aiohttp, requests and Python.
_UNREACHABLE: Final = frozenset(
    {"HTTPClientError", "ClientConnectionError", "ConnectionError", "TimeoutError", "FSTimeoutError", "gaierror"}
)


def is_remote(location: str) -> bool:
    """Return whether `location` is the URL of a store; file:// is a path of this machine."""
    scheme, separator, _ = location.partition("://")
    return bool(separator) and scheme not in ("file", "local")


def filesystem(url: str) -> tuple[AbstractFileSystem, str]:
    """Return the fsspec file system of a URL, and the path in it."""
    from fsspec.asyn import AsyncFileSystem
    from fsspec.core import url_to_fs

    try:
        files, path = url_to_fs(url)
    except Exception as error:
        # A store may connect here and raise its own errors; errors of ftplib are not OSError.
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(
            f"cannot open the store {url}: {reason}; use a store that fsspec supports, and install its library (s3://: "
            "s3fs, gs://: gcsfs, az://: adlfs)"
        ) from error
    # A kept listing would hide files that other programs have written since. Threads share an asynchronous file system,
    # and clearing its listings at each use would disturb them.
    if isinstance(files, AsyncFileSystem) and files.dircache.use_listings_cache:
        files.dircache.use_listings_cache = False
        files.dircache.clear()
    elif not isinstance(files, AsyncFileSystem):
        files.invalidate_cache()
    return files, path


def remote_error(
    error: Exception, action: str, location: str, remedy: str = "check the address"
) -> FormatError | StorageError:
    """Return the error for a failed `action` on a store; `remedy` is used if the cause is unknown.

    It is a FormatError for wrong addresses and unreadable files, and a StorageError otherwise.
    """
    # Each store has its own errors, so they are recognised by the names of their classes.
    classes = {base.__name__ for base in type(error).__mro__}
    is_unreachable = not classes.isdisjoint(_UNREACHABLE)
    variables = (
        ("AWS_ENDPOINT_URL, ", "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, ") if "s3://" in location else ("", "")
    )
    if is_unreachable:
        remedy = f"check the server's address ({variables[0]}docs/clusters.md) and the network, {RUN_AGAIN}"
    elif "PermissionError" in classes or any("Credential" in name or "Auth" in name for name in classes):
        remedy = f"check the keys ({variables[1]}docs/clusters.md) and your permission to {action} there"
    elif "FileNotFoundError" in classes:
        remedy = "check the address, or make the bucket"
    is_input = "FileNotFoundError" in classes or (action != "write" and not is_unreachable)
    reason = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")
    return (FormatError if is_input else StorageError)(
        f"cannot {action} {masked(location)}: {masked(reason)}", remedy=remedy
    )
