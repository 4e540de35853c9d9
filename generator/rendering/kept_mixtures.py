"""Mixtures of cells that were computed before, kept in the user's folder for such things.

A file is named after all that its content depends on: the table, the light, the matrix, and the code that computed
it. It holds its own hash. A file that is damaged, of another kind, or unreadable is as good as none, and where
nothing can be written nothing is kept: a second of work is no reason to fail. Whoever wants the room may delete the
folder.
"""

from __future__ import annotations

import contextlib
import uuid
import zlib
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import CropError
from foundation.files import cache_folder, whole_file
from foundation.hashing import sha256_of
from generator.rendering.cell_mixtures import SLOTS, CellMixtures

_MAGIC: Final = b"CroP cell mixtures 1\n"
"""First bytes of a file."""

_DIGEST: Final = 64
"""Bytes of the hash in hexadecimal digits that follow them (FIPS 180-4)."""

_SUFFIX: Final = ".mixtures"

_LEVEL: Final = 1
"""Of zlib: a file becomes a quarter, in a twentieth of a second; higher levels gain a tenth and take a second."""

MOST_BYTES: Final = 1 << 30
"""Room that kept mixtures may take, bytes: those of all 707 lights of a table with one matrix and more."""


def load_mixtures(key: str, nodes: int, folder: Path | None = None) -> CellMixtures | None:
    """Return mixtures that were kept, or None if there are none or they are damaged.

    `folder`: where they lie; None for `cache_folder`.
    """
    folder = folder or cache_folder()
    if folder is None:
        return None
    try:
        content = (folder / f"{key}{_SUFFIX}").read_bytes()
    except OSError:
        return None
    head, payload = content[: len(_MAGIC) + _DIGEST], content[len(_MAGIC) + _DIGEST :]
    if head != _head(payload):
        return None
    # What has its own hash was written by `keep_mixtures`, so it can be decompressed.
    plain = zlib.decompress(payload)
    sizes = [nodes * SLOTS * 2, nodes * 3 * 4, nodes * 3 * 4]
    if len(plain) != sum(sizes):
        return None
    steps, colours, wanted = (
        np.frombuffer(plain, kind, count=size // np.dtype(kind).itemsize, offset=sum(sizes[:part]))
        for part, (kind, size) in enumerate(zip(("<u2", "<f4", "<f4"), sizes, strict=True))
    )
    cells = np.cumsum(steps.reshape(SLOTS, nodes), axis=0, dtype=np.uint16).T
    return CellMixtures(np.ascontiguousarray(cells), _rows(colours), _rows(wanted))


def are_kept(key: str, folder: Path | None = None) -> bool:
    """Return whether there is a file of such mixtures, whatever its state; arguments as of `load_mixtures`."""
    folder = folder or cache_folder()
    return folder is not None and (folder / f"{key}{_SUFFIX}").is_file()


def keep_mixtures(key: str, mixtures: CellMixtures, folder: Path | None = None) -> None:
    """Keep mixtures for the next time; does nothing where that cannot be.

    Where all that is kept takes more than `MOST_BYTES`, what was written first is removed.

    `folder`: where to; None for `cache_folder`.
    """
    folder = folder or cache_folder()
    if folder is None:
        return
    # Cells ascend: steps from one to the next are mostly 0.
    steps = np.diff(mixtures.cells.T, axis=0, prepend=np.uint16(0)).astype("<u2")
    arrays = steps, mixtures.colours.astype("<f4"), mixtures.wanted.astype("<f4")
    payload = zlib.compress(b"".join(array.tobytes() for array in arrays), _LEVEL)
    path = folder / f"{key}{_SUFFIX}"
    # Workers may come here at the same time: each writes a file of its own, and the last to finish names it.
    own = path.with_name(f"{key}-{uuid.uuid4().hex}")
    with contextlib.suppress(CropError, OSError):
        with whole_file(own, lambda: path) as stream:
            stream.write(_head(payload) + payload)
        _make_room(folder)


def _make_room(folder: Path) -> None:
    """Remove what was written first until the rest takes no more than `MOST_BYTES`."""
    files = [(path.stat(), path) for path in folder.glob(f"*{_SUFFIX}")]
    total = sum(status.st_size for status, _ in files)
    for status, path in sorted(files, key=lambda file: (file[0].st_mtime_ns, file[1].name)):
        if total <= MOST_BYTES:
            return
        path.unlink(missing_ok=True)
        total -= status.st_size


def _rows(numbers: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return numbers.reshape(-1, 3).astype(np.float32)


def _head(payload: bytes) -> bytes:
    return _MAGIC + sha256_of(payload).encode()
