"""Locks for resources that only one process may use at a time, such as a display.

A lock is a socket in the abstract namespace of Linux (unix(7)). It needs no file, ends with its process, and gives
other processes the number of that process. Other systems have no such namespace, so nothing is locked there.
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

# Number of refused processes that can get the process number of the owner. Later processes get no number.
_QUEUE_LENGTH = 128


@contextmanager
def hold(noun: str, key: str) -> Generator[None]:
    """Lock a resource against other processes while the block runs; a process may lock it several times.

    `noun` names the resource in messages, and `key` identifies it on this machine. If another process has the lock, a
    DeviceRefused is raised. Its `value` is the number of that process, None if unknown.
    """
    if sys.platform != "linux":
        yield
        return
    name = b"\0croplab-" + hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest().encode()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as lock:
        try:
            lock.bind(name)
            lock.listen(_QUEUE_LENGTH)
        except OSError as error:
            owner = _find_owner(name)
            if owner != os.getpid():
                process = "" if owner is None else f" (process {owner})"
                raise DeviceRefused(
                    f"another command of CroP{process} is using {noun}",
                    remedy="wait until it has ended, or end it",
                    value=owner,
                ) from error
        yield


def _find_owner(name: bytes) -> int | None:
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as link:
        link.setblocking(False)
        link.connect(name)
        pid, _, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
        return int(pid)
    return None
