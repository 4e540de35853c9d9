"""Mixtures of cells that were computed before, kept in the user's folder for such things.

A file is named after all that its content depends on: the table, the light, the matrix, and the code that computed
it. It holds its own hash. A file that is damaged, of another kind, or unreadable is as good as none, and where
nothing can be written nothing is kept: a second of work is no reason to fail. Whoever wants the room may delete the
folder.
"""

from __future__ import annotations

import contextlib
import os
import sys
import uuid
from pathlib import Path
from typing import Final

import numpy as np

from foundation.errors import CropError
from foundation.files import whole_file
from foundation.hashing import sha256_of
from generator.rendering.cell_mixtures import SLOTS, CellMixtures

_MAGIC: Final = b"CroP cell mixtures 1\n"
"""First bytes of a file."""

_DIGEST: Final = 64
"""Bytes of the hash in hexadecimal digits that follow them (FIPS 180-4)."""

_SUFFIX: Final = ".mixtures"


def cache_folder() -> Path | None:
    r"""Return the user's folder for what can be computed again, or None if there is no home.

    `$XDG_CACHE_HOME/croplab` or `~/.cache/croplab` (XDG Base Directory Specification 0.8), on macOS
    `~/Library/Caches/croplab`, on Windows `%LOCALAPPDATA%\croplab\Cache`. A relative `XDG_CACHE_HOME` is ignored, as
    that specification says.
    """
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if given.is_absolute():
        return given / "croplab"
    local = os.environ.get("LOCALAPPDATA")
    if sys.platform == "win32" and local:
        return Path(local) / "croplab" / "Cache"
    try:
        home = Path.home()
    except RuntimeError:
        return None
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "croplab"


def load_mixtures(key: str, nodes: int, folder: Path | None = None) -> CellMixtures | None:
    """Return mixtures that were kept, or None if there are none or they are damaged.

    Parameters
    ----------
    key
        What they were kept under.
    nodes
        How many there are to be.
    folder
        Where they lie; None for `cache_folder`.
    """
    folder = folder or cache_folder()
    if folder is None:
        return None
    try:
        content = (folder / f"{key}{_SUFFIX}").read_bytes()
    except OSError:
        return None
    head, payload = content[: len(_MAGIC) + _DIGEST], content[len(_MAGIC) + _DIGEST :]
    sizes = [nodes * SLOTS * 2, nodes * 4, nodes, nodes * 12, nodes * 12]
    if head != _head(payload) or len(payload) != sum(sizes):
        return None
    ends = np.cumsum([0, *sizes])
    cells, distance, outside, colours, wanted = (payload[ends[i] : ends[i + 1]] for i in range(len(sizes)))
    return CellMixtures(
        np.frombuffer(cells, "<u2").astype(np.uint16).reshape(nodes, SLOTS),
        np.frombuffer(distance, "<f4").astype(np.float32),
        np.frombuffer(outside, np.uint8) != 0,
        np.frombuffer(colours, "<f4").astype(np.float32).reshape(nodes, 3),
        np.frombuffer(wanted, "<f4").astype(np.float32).reshape(nodes, 3),
    )


def keep_mixtures(key: str, mixtures: CellMixtures, folder: Path | None = None) -> None:
    """Keep mixtures for the next time; does nothing where that cannot be.

    Parameters
    ----------
    key
        What to keep them under: hexadecimal digits.
    mixtures
        The mixtures.
    folder
        Where to; None for `cache_folder`.
    """
    folder = folder or cache_folder()
    if folder is None:
        return
    arrays = (
        mixtures.cells.astype("<u2"),
        mixtures.distance.astype("<f4"),
        mixtures.outside.astype(np.uint8),
        mixtures.colours.astype("<f4"),
        mixtures.wanted.astype("<f4"),
    )
    payload = b"".join(array.tobytes() for array in arrays)
    path = folder / f"{key}{_SUFFIX}"
    # Workers may come here at the same time: each writes a file of its own, and the last to finish names it.
    own = path.with_name(f"{key}-{uuid.uuid4().hex}")
    with contextlib.suppress(CropError, OSError), whole_file(own, lambda: path) as stream:
        stream.write(_head(payload) + payload)


def _head(payload: bytes) -> bytes:
    return _MAGIC + sha256_of(payload).encode()
