"""Locks for things that only one process may use at a time but no system locks, such as a display.

A lock is a socket in the abstract namespace of Linux (unix(7)). It leaves no file behind, ends with its process, and
reports the process that holds it. Other systems have no such namespace; there, nothing is locked or refused.
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

# Length of the queue of processes that ask for the holder; a process beyond it gets no process number.
_QUEUE_LENGTH = 128


@contextmanager
def hold(noun: str, key: str) -> Generator[None]:
    """Lock a thing against other processes while the block runs; a process may lock it several times.

    `noun` names the thing in messages, `key` identifies it on this machine. The DeviceRefused has the
    number of the locking process as `value`, None if unknown.
    """
    if sys.platform != "linux":
        yield
        return
    name = b"\0croplab-" + hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest().encode()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as own:
        try:
            own.bind(name)
            own.listen(_QUEUE_LENGTH)
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
