"""The page as one HTML text: style, script and, for a report, data stand in it, so that it needs nothing else.

The policy that goes with it (Content Security Policy, level 3) lets a browser run this script and no other, so that a
name or a sentence out of a session cannot become code even if it reached the page as markup.
"""

from __future__ import annotations

import base64
import hashlib
import html
import re
from dataclasses import dataclass
from functools import cache
from importlib import resources

from acquisition.monitor.encoding import Json, to_bytes

SCRIPTS = ("plots.js", "head.js", "series.js", "page.js")
"""Files that make up the page's script, in the order in which they stand in it; the last one begins."""

_PLACE = re.compile(r"\{(title|plain|policy|data|style|script)\}")


@dataclass(frozen=True)
class Page:
    """A page: its text, and the policy that a server sends along."""

    text: str
    policy: str


def live_page(name: str) -> Page:
    """Return the page that asks its server for the session's state; `name` is shown until that has answered."""
    policy = _policy("connect-src 'self'; img-src 'self' data:; frame-ancestors 'none'")
    plain = "This page shows the session by a script, which the browser does not run. See acquire status instead."
    return Page(_filled(title=name, plain=plain, policy="", data=""), policy)


def still_page(name: str, plain: str, state: Json) -> Page:
    """Return a page that holds a state, and asks nobody."""
    policy = _policy("img-src data:")
    data = f'<script type="application/json" id="embedded">{to_bytes(state).decode()}</script>'
    header = f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    return Page(_filled(title=name, plain=plain, policy=header, data=data), policy)


def _filled(*, title: str, plain: str, policy: str, data: str) -> str:
    values = {
        "title": html.escape(title),
        "plain": html.escape(plain),
        "policy": policy,
        "data": data,
        "style": _style(),
        "script": _script(),
    }
    # In one pass: what is put in is not looked through for further places.
    return _PLACE.sub(lambda found: values[found[1]], _part("page.html"))


@cache
def _part(name: str) -> str:
    return (resources.files("acquisition.monitor") / "web" / name).read_text(encoding="utf-8")


def _script() -> str:
    return "".join(map(_part, SCRIPTS))


def _style() -> str:
    return _part("page.css")


def _policy(more: str) -> str:
    return (
        f"default-src 'none'; script-src {_hash(_script())}; style-src {_hash(_style())}; "
        f"base-uri 'none'; form-action 'none'; {more}"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
