"""What may be shown of a text: addresses without their secrets, foreign names without what a terminal obeys.

A session, a data set, a report and a terminal's log are copied, shown and published. So no password and no token gets
into any of them: whoever writes or prints an address masks it first, and `foundation.console` masks every error once
more.
"""

from __future__ import annotations

import re
import shlex
from typing import Any, Final, cast
from urllib.parse import urlsplit

MASK: Final = "…"  # What stands for a secret

# User name and password of a URL (RFC 3986, 3.2.1), the last @ before the path: passwords may hold one.
_USER = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]*://)[^\s/?#'\"<>]+@")

# Parameters of a URL that prove who asks: those of signed addresses of object stores (``X-Amz-Signature``, ``sig``,
# ``X-Goog-Credential``), and what services call their tokens.
_PARAMETER = re.compile(
    r"(?P<name>[?&;](?:[^=&;\s'\"]*(?:auth|credential|key|passw|secret|sig|token)[^=&;\s'\"]*)=)[^&;\s'\"<>]+",
    re.IGNORECASE,
)

# Control characters (Unicode category Cc), separators and marks that reorder a line, and halves of surrogates, as
# names have them whose bytes are no UTF-8.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


# A host with a dot and a path or a port: no command has such a name.
_ADDRESS = re.compile(r"[A-Za-z0-9-]+(?:\.[A-Za-z0-9-]+)+(?::\d+)?/\S*|[A-Za-z0-9.-]+\.[a-z]{2,}:\d+")


def masked(text: str) -> str:
    """Return a text with the user, the password and the secret parameters of every URL in it masked.

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
    """Return a value for JSON with `masked` applied to every text in it, keys left as they are."""
    if isinstance(value, str):
        return masked(value)
    if isinstance(value, dict):
        return {key: masked_values(inner) for key, inner in cast("dict[Any, Any]", value).items()}
    if isinstance(value, (list, tuple)):
        return [masked_values(inner) for inner in cast("list[Any]", value)]
    return value


def printable(text: str) -> str:
    r"""Return a text with control characters and lone surrogates as escapes; tabs and line ends stay.

    Examples
    --------
    >>> printable("no\x1b[2J.png is missing")
    'no\\x1b[2J.png is missing'
    """
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def is_webhook(target: str) -> bool:
    """Return whether a target is a URL to post to, rather than a command."""
    return target.lower().startswith(("http://", "https://"))


def is_address(target: str) -> bool:
    """Return whether a target that is no URL looks like one without its scheme.

    Examples
    --------
    >>> [is_address(target) for target in ("ntfy.sh/my-lab", "lab.example:80", "/usr/bin/tell", "./tell.sh", "tell x")]
    [True, True, False, False, False]
    """
    return _ADDRESS.fullmatch(target) is not None


def target_label(target: str) -> str:
    """Return what may be shown of a target: a URL's scheme and host, also where that lacks, or a command's first word.

    The rest may be a secret: a webhook's path is one, and so are user names, queries and most arguments.

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
