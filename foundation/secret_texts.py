"""Mask passwords and tokens in texts, and escape control characters.

Sessions, data sets, reports and logs are copied and published, so they must not contain secrets. Code that writes or
prints an address masks it first.
"""

from __future__ import annotations

import re
import shlex
from typing import Any, Final, cast
from urllib.parse import urlsplit

MASK: Final = "…"  # Replaces a secret

# User name and password of a URL (RFC 3986, 3.2.1). They end at the last @ before the path, as passwords may contain @.
_USER = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]*://)[^\s/?#'\"<>]+@")

# Parameters of a URL that may be secret: signatures of object stores (``X-Amz-Signature``, ``sig``,
# ``X-Goog-Credential``), and tokens, which have other names in each service.
_PARAMETER = re.compile(
    r"(?P<name>[?&;](?:[^=&;\s'\"]*(?:auth|credential|key|passw|secret|sig|token)[^=&;\s'\"]*)=)[^&;\s'\"<>]+",
    re.IGNORECASE,
)

# Control characters (Unicode category Cc), line separators, and marks that change the text direction. Also lone
# surrogates, which Python uses for bytes of file names that are not UTF-8.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


# Host name with a dot, followed by a path or a port. Names of commands do not have this form.
_ADDRESS = re.compile(r"[A-Za-z0-9-]+(?:\.[A-Za-z0-9-]+)+(?::\d+)?/\S*|[A-Za-z0-9.-]+\.[a-z]{2,}:\d+")


def masked(text: str) -> str:
    """Replace user name, password and secret parameters of all URLs in a text by `MASK`.

    Examples
    --------
    >>> masked("cannot read ftp://lab:s3cret@store.example/table: refused")
    'cannot read ftp://…@store.example/table: refused'
    >>> masked("https://store.example/a.png?versionId=3&X-Amz-Signature=1f4a")
    'https://store.example/a.png?versionId=3&X-Amz-Signature=…'
    """
    if "://" not in text:
        return text
    return _PARAMETER.sub(rf"\g<name>{MASK}", _USER.sub(rf"\g<scheme>{MASK}@", text))


def masked_values(value: Any) -> Any:
    """Apply `masked` to all texts in a JSON value except its keys."""
    if isinstance(value, str):
        return masked(value)
    if isinstance(value, dict):
        return {key: masked_values(inner) for key, inner in cast("dict[Any, Any]", value).items()}
    if isinstance(value, (list, tuple)):
        return [masked_values(inner) for inner in cast("list[Any]", value)]
    return value


def printable(text: str) -> str:
    r"""Replace control characters and lone surrogates by escapes, except tabs and line ends.

    Examples
    --------
    >>> printable("no\x1b[2J.png is missing")
    'no\\x1b[2J.png is missing'
    """
    return _UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


def is_webhook(target: str) -> bool:
    """Return whether a target of notifications is a URL. Other targets are commands."""
    return target.lower().startswith(("http://", "https://"))


def is_address(target: str) -> bool:
    """Return whether a target of notifications has the form of a URL without ``https://``.

    Examples
    --------
    >>> [is_address(target) for target in ("ntfy.sh/my-lab", "lab.example:80", "/usr/bin/tell", "./tell.sh", "tell x")]
    [True, True, False, False, False]
    """
    return _ADDRESS.fullmatch(target) is not None


def target_label(target: str) -> str:
    """Return the public part of a target of notifications: scheme and host of a URL, or the first word of a command.

    The other parts may be secret: path, user name and query of a URL, or the arguments of a command.

    Examples
    --------
    >>> target_label("https://user:word@ntfy.example/lab?auth=tk_1"), target_label("curl -H 'Authorization: x' y")
    ('https://ntfy.example/…', 'curl …')
    """
    if is_webhook(target):
        parts = urlsplit(target)
        return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}/{MASK}"
    if is_address(target):
        return f"{target.partition('/')[0]}/{MASK}"
    words = shlex.split(target)
    return " ".join([*words[:1], *([MASK] if words[1:] else [])])
