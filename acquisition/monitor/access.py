"""Who may look at a session over the network, and at what: decided from a request's text alone.

A page on this machine's loopback needs no token: who is logged in here may read the folder anyway. Two things are still
refused there: names that another site has made to point here (DNS rebinding, by which a web page could read what
answers on loopback), and everything that is not one of four addresses.

For other machines the address itself holds a token, as its first part, so that the page's relative addresses carry it
on and nothing has to be typed.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass
from typing import Literal
from urllib.parse import parse_qs

TOKEN_BYTES = 16
"""Random bytes of a token: 128 bits cannot be guessed, and still make a QR code that a terminal has room for."""

_FRAME = re.compile(r"frame/([1-9][0-9]{0,8})\.jpg")


@dataclass(frozen=True)
class Request:
    """What is asked for: the page, its state since a cursor, the picture of an attempt, or the old summary."""

    what: Literal["page", "state", "frame", "status"]
    since: str = ""
    attempt: int = 0


@dataclass(frozen=True)
class Refusal:
    """Why a request is not answered: HTTP status and sentence."""

    status: int
    sentence: str


@dataclass(frozen=True)
class Access:
    """The rule of one server: the token that addresses must begin with, empty on loopback, and the names it goes by."""

    token: str
    names: frozenset[str]

    @classmethod
    def to(cls, host: str) -> Access:
        """Return the rule of a server that listens on `host`, with a new token unless that is loopback."""
        own = socket.gethostname().lower()
        names = frozenset({"localhost", host.lower(), own, f"{own}.local"})
        return cls("" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES), names)

    def judge(self, target: str, host: str | None) -> Request | Refusal:
        """Return what a request asks for, or why it is refused.

        `host`: the Host header; None if there is none.
        """
        if not self._knows(host):
            return Refusal(421, "this server does not go by that name; open the address that acquire monitor printed")
        path, _, query = target.removeprefix("/").partition("?")
        if self.token:
            token, slash, path = path.partition("/")
            if not slash or not hmac.compare_digest(token.encode(), self.token.encode()):
                return Refusal(403, "the address lacks its token; open the one that acquire monitor printed, whole")
        since = parse_qs(query).get("since", [""])[0]
        if path == "":
            return Request("page")
        if path == "state.json":
            return Request("state", since=since)
        if path == "status.json":
            return Request("status")
        if found := _FRAME.fullmatch(path):
            return Request("frame", attempt=int(found[1]))
        return Refusal(404, "here are /, /state.json, /status.json and /frame/ATTEMPT.jpg")

    def _knows(self, host: str | None) -> bool:
        """Return whether a Host header (RFC 9110, 7.2) names this server: an address by number cannot be rebound."""
        if not host:
            return False
        name = host.lower()
        name = name[1 : name.index("]")] if name.startswith("[") and "]" in name else name.partition(":")[0]
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self.names
        return True


def is_loopback(host: str) -> bool:
    """Return whether a host to listen on can be reached from this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def reachable_addresses(host: str) -> tuple[str, ...]:
    """Return the names and numbers, for a URL, under which others reach a server that listens on `host`.

    For a server on all interfaces: the address with which this machine would send into its network (nothing is sent),
    else its name.
    """
    try:
        number = ipaddress.ip_address(host)
    except ValueError:
        return (host,)
    if not number.is_unspecified:
        return (f"[{host}]" if number.version == 6 else host,)
    found: list[str] = []
    # TEST-NET-1 (RFC 5737) and its counterpart (RFC 3849): addresses of nobody, reached by the default route.
    for family, nobody in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        if family == socket.AF_INET6 and number.version == 4:
            continue
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.connect((nobody, 9))
                own = str(probe.getsockname()[0])
        except OSError:
            continue
        found.append(f"[{own}]" if ":" in own else own)
    return tuple(found) or (socket.gethostname(),)
