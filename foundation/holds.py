"""Holds on what only one program may use at a time and nothing locks by itself: a display, a lab.

A hold is a socket in Linux's abstract namespace (unix(7)): there is no file that could be left behind, or that another
user could not open, it goes with its process however that ends, and who asks is told which process has it. Other
systems have no such namespace: there nothing is held, and nothing refused.
"""

from __future__ import annotations

import hashlib
import os
import socket
import struct
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress

from foundation.errors import DeviceRefused

_WAITING = 128  # Programs that may ask for the holder at a time; one more is not told the process


@contextmanager
def hold(what: str, key: str) -> Generator[None]:
    """Hold `what` against other processes while the block runs; DeviceRefused names the process that has it already.

    `key`: tells it from others of this machine. A process that holds it already may hold it again.
    """
    if sys.platform != "linux":
        yield
        return
    name = b"\0croplab-" + hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest().encode()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as own:
        try:
            own.bind(name)
            own.listen(_WAITING)
        except OSError as error:
            holder = _holder(name)
            if holder != os.getpid():
                who = "" if holder is None else f" (process {holder})"
                raise DeviceRefused(
                    f"another command of CroP{who} is at work with {what}",
                    remedy="wait until it has ended, or end it",
                    value=holder,
                ) from error
        yield


def _holder(name: bytes) -> int | None:
    """Return the process that listens at a name; None if it does not say."""
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as link:
        link.setblocking(False)
        link.connect(name)
        pid, _, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
        return int(pid)
    return None
