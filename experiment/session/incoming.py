"""A raw file on its way into a session: downloaded in one thread, and made whole in another.

The order on the disk is that of every file that counts: written, flushed, renamed; only then may the journal say that
it is there.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from drivers.camera import CapturedFrame
from foundation.errors import DeviceError
from foundation.files import whole_file
from foundation.hashing import stream_sha256


@dataclass(frozen=True)
class ReceivedFile:
    """A raw file that is complete on the disk, not yet counted."""

    path: Path
    size: int
    sha256: str
    captured: CapturedFrame


class _Abandoned(Exception):
    """Ends a file that is not wanted."""


class IncomingFile:
    """A raw file in the making under a hidden name; gone at the end of a `with` block unless it was completed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._final = path
        # A folder that is gone means a disk that was unmounted: what lies under its name is another one.
        self._file = whole_file(path, lambda: self._final, make=False)
        self._open = True
        self.stream: BinaryIO = self._file.__enter__()

    def __enter__(self) -> IncomingFile:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if error is None:
            self.abandon()
        else:
            self._leave(kind, error, trace)

    def complete(self, captured: CapturedFrame) -> ReceivedFile:
        """Check the size, hash, flush and rename the file; from any thread."""
        try:
            size = self.stream.seek(0, 2)
            if size != captured.size or size == 0:
                raise DeviceError(
                    f"{captured.name}: the camera says {captured.size} bytes, {size} arrived; the frame is taken again"
                )
            self.stream.seek(0)
            sha256 = stream_sha256(self.stream)
            self._final = self._path.with_name(self._path.name + Path(captured.name).suffix.lower())
        except BaseException:
            self._leave(*sys.exc_info())
            raise
        self._leave(None, None, None)
        return ReceivedFile(self._final, size, sha256, captured)

    def abandon(self) -> None:
        """Remove the file unless it was completed; a second call does nothing."""
        self._leave(_Abandoned, _Abandoned(), None)

    def _leave(self, kind: Any, error: Any, trace: Any) -> None:
        if self._open:
            self._open = False
            self._file.__exit__(kind, error, trace)
