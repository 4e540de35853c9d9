"""Locks for things such as a display: only one process may use them at a time, but the system does not lock them.

A lock is a socket in the abstract namespace of Linux (unix(7)). It leaves no file, ends with its process, and reports
the process that holds it. Other systems have no such namespace, so nothing is locked or refused on them.
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

# Most processes that can wait for the process number of the holder; further processes do not get this number.
_QUEUE_LENGTH = 128


@contextmanager
def hold(noun: str, key: str) -> Generator[None]:
    """Lock a thing against other processes while the block runs; a process may lock it several times.

    `noun` names the thing in messages, `key` identifies it on this machine. If another process holds the lock, the
    DeviceRefused has its process number as `value`, None if unknown.
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
            holder = _holder(name)
            if holder != os.getpid():
                process = "" if holder is None else f" (process {holder})"
                raise DeviceRefused(
                    f"another command of CroP{process} is using {noun}",
                    remedy="wait until it has ended, or end it",
                    value=holder,
                ) from error
        yield


def _holder(name: bytes) -> int | None:
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as link:
        link.setblocking(False)
        link.connect(name)
        pid, _, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
        return int(pid)
    return None
