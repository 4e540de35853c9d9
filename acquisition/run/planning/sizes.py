"""How many bytes a run needs, and how many there are."""

from __future__ import annotations

import errno
import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from foundation.files import storage_error

RETAKEN_SHARE: Final = 0.1
"""Frames taken again for which there must be space, as a share of the plan: chosen; disturbances of an hour's run."""
BESIDE_BYTES: Final = 150_000
"""Of each frame: a preview of 640 px, and its rows in the journal."""
SPARE_BYTES: Final = 500_000_000
"""What is left free beside: the disk's other users, and file systems that slow down when they are full."""
BYTES_PER_PIXEL: Final = 1.5
"""Of lossless raw files of 14 bits: 1.34 at ISO 100 (EOS 550D, 25 MB; EOS 6D Mark II, 36 MB), more with noise."""
LOOSE_BYTES_PER_PIXEL: Final = 2.0
"""Of bodies that may write every photosite in 16 bits (Sony)."""
UNKNOWN_BYTES: Final = 60_000_000
"""Assumed of a body that is not known: 40 million photosites."""
_MODELS: Final = (
    (18.7, "EOS 550D, EOS REBEL T2i, EOS Kiss X4, EOS 650D, EOS 700D, EOS REBEL T4i, EOS REBEL T5i, "
           "EOS 100D"),
    (19.0, "EOS 600D, EOS REBEL T3i, EOS Kiss X5, EOS 60D, EOS 7D, EOS 1300D, EOS REBEL T6"),
    (22.1, "EOS 5D Mark II, EOS-1Ds Mark III, EOS R6, EOS-1D X Mark III"),
    (23.4, "EOS 5D Mark III"),
    (25.0, "EOS 70D, EOS 6D, EOS 7D Mark II, EOS-1D X, EOS-1D X Mark II, EOS R3, EOS 750D, EOS 760D, "
           "EOS 77D, EOS 80D, EOS 800D, EOS 2000D, EOS REBEL T7, EOS 200D, EOS 250D, EOS R100, EOS R50, "
           "EOS R10, D750, D610, D600, D780, D5600, D7200, Z 5, Z 6, Z 6II, ILCE-7M3, ILCE-6400"),
    (26.9, "EOS 6D Mark II, EOS RP, EOS R8"),
    (31.9, "EOS 5D Mark IV, EOS R"),
    (34.5, "EOS 90D, EOS M6 Mark II, EOS R7, ILCE-7M4"),
    (43.0, "D800, D800E, D810, ILCE-7RM2"),
    (47.4, "EOS R5, D850, Z 7, Z 7II, Z 8, Z 9"),
    (53.5, "EOS 5DS, EOS 5DS R"),
    (62.0, "ILCE-7RM3, ILCE-7RM4, ILCE-7RM5"),
)  # fmt: skip
"""Photosites in millions, and the bodies that have no more: the makers' numbers, about a twentieth added for masked
borders. From general knowledge but for the EOS 550D, 6D Mark II, 5D Mark II, 5DS and 1Ds Mark III."""

MEGAPIXELS: Final = {model: size for size, models in _MODELS for model in models.split(", ")}
"""Photosites of the bodies that are known, in millions."""


@dataclass(frozen=True)
class Estimate:
    """A number, what it rests on, and whether that is more than a guess."""

    value: float
    basis: str
    sure: bool


def frame_bytes(largest: int | None, model: str, given: int | None = None) -> Estimate:
    """Return the size of a raw file, bytes.

    `largest`: of the session so far; None if nothing was taken. `model`: as the body names itself; empty if it could
    not be asked.
    """
    if largest is not None:
        return Estimate(largest, "the largest of the session so far", True)
    if given is not None:
        return Estimate(given, "as the simulated camera writes them", True)
    known = MEGAPIXELS.get(model.removeprefix("Canon ").removeprefix("NIKON "))
    if known is None:
        whom = f"the size of {model} is not known" if model else "the camera is not known"
        return Estimate(UNKNOWN_BYTES, f"assumed: {whom}", False)
    each = LOOSE_BYTES_PER_PIXEL if model.startswith("ILCE") else BYTES_PER_PIXEL
    return Estimate(known * 1e6 * each, f"{known:.1f} million photosites, {each:g} bytes each", True)


def needed_bytes(frames: int, frame_bytes: float) -> int:
    """Return the space for `frames` raw files of `frame_bytes`, retakes and a reserve included; 0 for none."""
    if not frames:
        return 0
    return math.ceil(frames * (1 + RETAKEN_SHARE) * (frame_bytes + BESIDE_BYTES)) + SPARE_BYTES


def free_bytes_at(folder: Path) -> int:
    """Return the free space where `folder` is or would be made, bytes."""
    place = folder.absolute()
    try:
        while not place.is_dir() and place != place.parent:
            place = place.parent
        if os.statvfs(place).f_flag & os.ST_RDONLY:
            raise storage_error(folder, OSError(errno.EROFS, os.strerror(errno.EROFS)))
        if not os.access(place, os.W_OK | os.X_OK):
            raise storage_error(folder, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
        return shutil.disk_usage(place).free
    except OSError as error:
        raise storage_error(folder, error, "look at") from error


def bytes_text(number: float, up: bool = False) -> str:
    """Return bytes as GB or MB with a digit; rounded `up` where they are missing.

    Examples
    --------
    >>> bytes_text(25_340_000), bytes_text(1.01e9), bytes_text(1.01e9, up=True)
    ('25.3 MB', '1.0 GB', '1.1 GB')
    """
    unit, name = (1e9, "GB") if number >= 1e9 else (1e6, "MB")
    tenths = number / unit * 10
    return f"{(math.ceil(tenths) if up else round(tenths)) / 10:.1f} {name}"
