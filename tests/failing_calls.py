"""Make single system calls of a thread fail as a failing disk would.

Nothing in the program is replaced: calls of Python, its C code and SQLite are treated alike. A thread installs a
seccomp filter for itself (`SECCOMP_FILTER_FLAG_NEW_LISTENER`). A helper process answers each of its calls on files
below a folder, one of them with an error. It works on Linux on x86-64 and ARM64.

Sources: seccomp(2), seccomp_unotify(2), <linux/seccomp.h>, <linux/filter.h>; call numbers: <asm/unistd.h>.
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

# Errors of a disk that is broken, full, read-only, over quota, removed, or on a restarted server.
DISK_FAULTS = (errno.EIO, errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.ENODEV, errno.ESTALE)

# Calls that access a disk (not lseek, nor the fcntl locks of SQLite): number on x86-64 and on ARM64, and how the file
# is given: file descriptor, path, or folder descriptor with path ("at").
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
    """Result of an action."""

    calls: tuple[str, ...]  # name and file of each call below the folder, in order
    failed: str | None  # the call that failed; None if the action made fewer calls
    result: Any  # returned value
    error: BaseException | None  # raised error


class FailingCalls:
    """Runs actions in threads with failing calls on files below `folder`; made by `failing_calls`."""

    def __init__(self, folder: Path, helper: socket.socket, pid: int) -> None:
        self._folder = folder
        self._helper = helper
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
        """Run `action` in a separate thread.

        Parameters
        ----------
        at
            index of the failing call, from 0; None: no call fails
        number
            error number
        lasting
            whether all later calls of the action fail too
        calls
            names of the calls that count; empty: all
        """
        outcome: dict[str, Any] = {}
        listener: list[int] = []

        def work() -> None:
            libc = ctypes.CDLL(None, use_errno=True)
            # If processes may trace only their children, permit the helper to trace this one.
            libc.prctl(_SET_PTRACER, self._pid, 0, 0, 0)
            request = {"folder": str(self._folder), "at": at, "errno": number, "lasting": lasting, "calls": calls}
            listener.append(_listen(libc))
            socket.send_fds(self._helper, [json.dumps(request).encode()], listener)
            try:
                outcome["result"] = action()
            except BaseException as error:
                outcome["error"] = error
            finally:
                self._helper.send(b"done")
                self._helper.recv(4)

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        if listener:
            os.close(listener[0])
        size = struct.unpack("I", _exactly(self._helper, 4))[0]
        report = json.loads(_exactly(self._helper, size))
        for handle in report["unclosed"]:
            with suppress(OSError):
                os.close(handle)
        return Ran(tuple(report["calls"]), report["failed"], outcome.get("result"), outcome.get("error"))


@contextmanager
def failing_calls(folder: Path) -> Generator[FailingCalls]:
    """Start the helper process; it ends with the block."""
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
    """Return why calls cannot be made to fail here; empty if they can."""
    if platform.machine() not in _MACHINES or not sys.platform.startswith("linux"):
        return "failing calls need Linux on x86-64 or ARM64"
    failed: list[str] = []

    def install() -> None:
        try:
            os.close(_listen(ctypes.CDLL(None, use_errno=True), is_empty=True))
        except OSError as error:
            failed.append(f"seccomp is not available: {error.strerror}")

    thread = threading.Thread(target=install)
    thread.start()
    thread.join()
    return "".join(failed)


def _listen(libc: ctypes.CDLL, is_empty: bool = False) -> int:
    """Request notifications of this thread's calls; return the file descriptor of the notifications."""
    machine = _MACHINES[platform.machine()]
    numbers = [] if is_empty else [number for call in _CALLS.values() if (number := call[:2][machine]) is not None]
    # Load the call number; jump from each listed number to the last instruction; allow others; notify.
    program = [struct.pack("HBBI", 0x20, 0, 0, 0)]
    for index, number in enumerate(numbers):
        program.append(struct.pack("HBBI", 0x15, len(numbers) - index, 0, number))
    program.append(struct.pack("HBBI", 0x06, 0, 0, _ALLOW))
    program.append(struct.pack("HBBI", 0x06, 0, 0, _NOTIFY))
    code = ctypes.create_string_buffer(b"".join(program))
    header = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program), ctypes.addressof(code)))
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    handle = libc.syscall(_SECCOMP[machine], _FILTER, _NEW_LISTENER, header)
    if handle < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return int(handle)


def _exactly(stream: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (chunk := stream.recv(size - len(data))):
        data += chunk
    return data


def _answer(control: socket.socket) -> None:
    """Answer the calls of one thread after another until the other end closes."""
    machine = _MACHINES[platform.machine()]
    call_names = {call[:2][machine]: (name, call[2]) for name, call in _CALLS.items()}
    while True:
        message, handles, _, _ = socket.recv_fds(control, 4096, 1)
        if not message:
            return
        request = json.loads(message)
        report = _answer_thread(control, handles[0], request, call_names)
        os.close(handles[0])
        data = json.dumps(report).encode()
        control.sendall(struct.pack("I", len(data)) + data)


def _answer_thread(
    control: socket.socket, listener: int, request: dict[str, Any], call_names: dict[int | None, tuple[str, str]]
) -> dict[str, Any]:
    calls: list[str] = []
    unclosed: list[int] = []
    failed: str | None = None
    has_ended = False
    poll = select.poll()
    poll.register(listener, select.POLLIN)
    poll.register(control, select.POLLIN)
    while True:
        ready = dict(poll.poll())
        if control.fileno() in ready:
            assert control.recv(4) == b"done"
            has_ended = True
            poll.unregister(control)
            control.send(b"well")
        if ready.get(listener, 0) & select.POLLIN:
            notice = bytearray(_NOTICE.size)
            try:
                fcntl.ioctl(listener, _RECEIVE, notice)
            except OSError:
                continue  # The call was interrupted before its notification was read.
            id_, pid, _, number, _, _, *arguments = _NOTICE.unpack(notice)
            name, kind = call_names[number]
            file = _file_of(pid, kind, arguments)
            fails = False
            counts = file.startswith(request["folder"]) and (not request["calls"] or name in request["calls"])
            if counts and not has_ended:
                at = request["at"]
                fails = at is not None and (len(calls) >= at if request["lasting"] else len(calls) == at)
                calls.append(f"{name} {file.removeprefix(request['folder'])}")
                if fails:
                    failed = failed or calls[-1]
                    if name == "close":
                        unclosed.append(arguments[0])
            answer = _ANSWER.pack(id_, 0, -request["errno"], 0) if fails else _ANSWER.pack(id_, 0, 0, _CONTINUE)
            with suppress(OSError):
                fcntl.ioctl(listener, _SEND, bytearray(answer))
        elif ready.get(listener, 0) & select.POLLHUP:
            return {"calls": calls, "failed": failed, "unclosed": unclosed}


def _file_of(pid: int, kind: str, arguments: list[int]) -> str:
    """Return the file of a call, as the thread `pid` names it."""
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
        # The text may end before a page boundary.
        data = memory.read(min(4096, 4096 - address % 4096))
        while b"\0" not in data and (chunk := memory.read(4096)):
            data += chunk
    return os.fsdecode(data.split(b"\0", 1)[0])


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as end:
        _answer(end)
