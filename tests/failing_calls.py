"""A disk that fails at any one system call: the kernel asks us before each call of a thread, and may be told an error.

Nothing of the program is replaced: what Python, its C code and SQLite ask of the kernel is seen alike. A thread
installs a filter for itself alone (seccomp, `SECCOMP_FILTER_FLAG_NEW_LISTENER`); another process answers each of its
calls that concerns a file below a folder, one of them with an error. Linux on x86-64 and ARM64.

Sources: seccomp(2), seccomp_unotify(2), <linux/seccomp.h>, <linux/filter.h>; numbers of calls: <asm/unistd.h>.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
import platform
import select
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# What a disk answers that breaks, is full, read-only, used up, pulled out, or on a server that was started anew.
DISK_FAULTS = (errno.EIO, errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.ENODEV, errno.ESTALE)

# What asks a disk (lseek does not, nor the locks of fcntl that SQLite takes), by number on x86-64 and on ARM64, and by
# what names the file: a file descriptor, a path, or a folder's descriptor with a path ("at").
_CALLS: dict[str, tuple[int | None, int | None, str]] = {
    "read": (0, 63, "fd"),
    "write": (1, 64, "fd"),
    "close": (3, 57, "fd"),
    "stat": (4, None, "path"),
    "fstat": (5, 80, "fd"),
    "lstat": (6, None, "path"),
    "pread64": (17, 67, "fd"),
    "pwrite64": (18, 68, "fd"),
    "access": (21, None, "path"),
    "flock": (73, 32, "fd"),
    "fsync": (74, 82, "fd"),
    "fdatasync": (75, 83, "fd"),
    "ftruncate": (77, 46, "fd"),
    "rename": (82, None, "path"),
    "mkdir": (83, None, "path"),
    "rmdir": (84, None, "path"),
    "unlink": (87, None, "path"),
    "readlink": (89, None, "path"),
    "getdents64": (217, 61, "fd"),
    "openat": (257, 56, "at"),
    "mkdirat": (258, 34, "at"),
    "newfstatat": (262, 79, "at"),
    "unlinkat": (263, 35, "at"),
    "renameat": (264, 38, "at"),
    "faccessat": (269, 48, "at"),
    "fallocate": (285, 47, "fd"),
    "renameat2": (316, 276, "at"),
    "statx": (332, 291, "at"),
    "faccessat2": (439, 439, "at"),
}
_MACHINES = {"x86_64": 0, "aarch64": 1}
_SECCOMP = (317, 277)
_NEW_LISTENER, _FILTER, _NOTIFY, _ALLOW = 8, 1, 0x7FC00000, 0x7FFF0000
_RECEIVE, _SEND, _CONTINUE = 0xC0502100, 0xC0182101, 1
_NO_NEW_PRIVILEGES, _SET_PTRACER = 38, 0x59616D61
_NOTICE, _ANSWER = struct.Struct("QIIiIQ6Q"), struct.Struct("Qqii")
_AT_FDCWD = 0xFFFFFF9C


@dataclass(frozen=True)
class Ran:
    """What came of an action: the calls that it made, the one that failed, and how it ended.

    Attributes
    ----------
    calls
        Name and file of each call below the folder, in order.
    failed
        That which got the error; None where the action made fewer.
    result
        What it returned.
    error
        What it raised.
    """

    calls: tuple[str, ...]
    failed: str | None
    result: Any
    error: BaseException | None


class FailingCalls:
    """Runs actions in threads whose calls to files below `folder` fail; given by `failing_calls`."""

    def __init__(self, folder: Path, answering: socket.socket, pid: int) -> None:
        self._folder = folder
        self._answering = answering
        self._pid = pid

    def run(
        self,
        action: Callable[[], Any],
        at: int | None = None,
        number: int = errno.EIO,
        *,
        lasting: bool = False,
        calls: tuple[str, ...] = (),
    ) -> Ran:
        """Run `action` in a thread of its own.

        Parameters
        ----------
        at
            Which of its calls fails, from 0; None: none does.
        number
            With which error.
        lasting
            Whether all calls after it fail, too, until the action has ended.
        calls
            Names of the calls that count; all where empty.
        """
        outcome: dict[str, Any] = {}
        listener: list[int] = []

        def work() -> None:
            libc = ctypes.CDLL(None, use_errno=True)
            # Where processes may look into their children only, the one that answers is allowed to look at us.
            libc.prctl(_SET_PTRACER, self._pid, 0, 0, 0)
            order = {"folder": str(self._folder), "at": at, "errno": number, "lasting": lasting, "calls": calls}
            listener.append(_listen(libc))
            socket.send_fds(self._answering, [json.dumps(order).encode()], listener)
            try:
                outcome["result"] = action()
            except BaseException as error:
                outcome["error"] = error
            finally:
                self._answering.send(b"done")
                self._answering.recv(4)

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        if listener:
            os.close(listener[0])
        size = struct.unpack("I", _exactly(self._answering, 4))[0]
        said = json.loads(_exactly(self._answering, size))
        for handle in said["unclosed"]:
            with suppress(OSError):
                os.close(handle)
        return Ran(tuple(said["calls"]), said["failed"], outcome.get("result"), outcome.get("error"))


@contextmanager
def failing_calls(folder: Path) -> Generator[FailingCalls]:
    """Start the process that answers; it ends with the block."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    with ours:
        with theirs:
            command = [sys.executable, "-SE", __file__, str(theirs.fileno())]
            process = subprocess.Popen(command, pass_fds=[theirs.fileno()])
        try:
            yield FailingCalls(folder.resolve(), ours, process.pid)
        finally:
            ours.close()
            process.wait()


def why_not() -> str:
    """Return why calls cannot be made to fail here; empty where they can."""
    if platform.machine() not in _MACHINES or not sys.platform.startswith("linux"):
        return "only on Linux on x86-64 and ARM64"
    failed: list[str] = []

    def install() -> None:
        try:
            os.close(_listen(ctypes.CDLL(None, use_errno=True), nothing=True))
        except OSError as error:
            failed.append(f"seccomp cannot be used here: {error.strerror}")

    thread = threading.Thread(target=install)
    thread.start()
    thread.join()
    return "".join(failed)


def _listen(libc: ctypes.CDLL, nothing: bool = False) -> int:
    """Let the calls of this thread be asked for; return the file descriptor that they come from."""
    machine = _MACHINES[platform.machine()]
    numbers = [] if nothing else [number for call in _CALLS.values() if (number := call[:2][machine]) is not None]
    # Load the number; for each of ours jump to the last instruction, else go on; allow; ask.
    program = [struct.pack("HBBI", 0x20, 0, 0, 0)]
    for place, number in enumerate(numbers):
        program.append(struct.pack("HBBI", 0x15, len(numbers) - place, 0, number))
    program.append(struct.pack("HBBI", 0x06, 0, 0, _ALLOW))
    program.append(struct.pack("HBBI", 0x06, 0, 0, _NOTIFY))
    code = ctypes.create_string_buffer(b"".join(program))
    described = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program), ctypes.addressof(code)))
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    handle = libc.syscall(_SECCOMP[machine], _FILTER, _NEW_LISTENER, described)
    if handle < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return int(handle)


def _exactly(stream: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := stream.recv(size - len(data))):
        data += more
    return data


def _answer(control: socket.socket) -> None:
    """Answer the calls of one thread after another, until the other end is closed."""
    machine = _MACHINES[platform.machine()]
    known = {call[:2][machine]: (name, call[2]) for name, call in _CALLS.items()}
    while True:
        text, handles, _, _ = socket.recv_fds(control, 4096, 1)
        if not text:
            return
        order = json.loads(text)
        said = _answer_thread(control, handles[0], order, known)
        os.close(handles[0])
        data = json.dumps(said).encode()
        control.sendall(struct.pack("I", len(data)) + data)


def _answer_thread(
    control: socket.socket, listener: int, order: dict[str, Any], known: dict[int | None, tuple[str, str]]
) -> dict[str, Any]:
    calls: list[str] = []
    unclosed: list[int] = []
    failed: str | None = None
    ended = False
    poll = select.poll()
    poll.register(listener, select.POLLIN)
    poll.register(control, select.POLLIN)
    while True:
        ready = dict(poll.poll())
        if control.fileno() in ready:
            assert control.recv(4) == b"done"
            ended = True
            poll.unregister(control)
            control.send(b"well")
        if ready.get(listener, 0) & select.POLLIN:
            notice = bytearray(_NOTICE.size)
            try:
                fcntl.ioctl(listener, _RECEIVE, notice)
            except OSError:
                continue  # The call was interrupted before it was asked for.
            id_, pid, _, number, _, _, *arguments = _NOTICE.unpack(notice)
            name, kind = known[number]
            about = _about(pid, kind, arguments)
            fails = False
            counts = about.startswith(order["folder"]) and (not order["calls"] or name in order["calls"])
            if counts and not ended:
                at = order["at"]
                fails = at is not None and (len(calls) >= at if order["lasting"] else len(calls) == at)
                calls.append(f"{name} {about.removeprefix(order['folder'])}")
                if fails:
                    failed = failed or calls[-1]
                    if name == "close":
                        unclosed.append(arguments[0])
            answer = _ANSWER.pack(id_, 0, -order["errno"], 0) if fails else _ANSWER.pack(id_, 0, 0, _CONTINUE)
            with suppress(OSError):
                fcntl.ioctl(listener, _SEND, bytearray(answer))
        elif ready.get(listener, 0) & select.POLLHUP:
            return {"calls": calls, "failed": failed, "unclosed": unclosed}


def _about(pid: int, kind: str, arguments: list[int]) -> str:
    """Return the file that a call is about, as the thread `pid` names it."""
    with suppress(OSError):
        if kind == "fd":
            return str(Path(f"/proc/{pid}/fd/{arguments[0]}").readlink())
        name = _text(pid, arguments[0 if kind == "path" else 1])
        folder = arguments[0] & 0xFFFFFFFF
        if kind == "path" or name.startswith("/") or folder == _AT_FDCWD:
            return str(Path(f"/proc/{pid}/cwd").readlink() / name)
        return str(Path(f"/proc/{pid}/fd/{folder}").readlink() / name)
    return ""


def _text(pid: int, address: int) -> str:
    with Path(f"/proc/{pid}/mem").open("rb", buffering=0) as memory:
        memory.seek(address)
        # A page boundary may lie behind the text.
        data = memory.read(min(4096, 4096 - address % 4096))
        while b"\0" not in data and (more := memory.read(4096)):
            data += more
    return os.fsdecode(data.split(b"\0", 1)[0])


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as end:
        _answer(end)
